//! The instances each point belongs to: at most one thing, and the parts and wholes that contain
//! it.

use super::hierarchy::Proposal;
use super::superpoints::Superpoints;
use std::borrow::Cow;
use uniground_geometry::scene::{InstanceId, Level};

/// A part of a thing, or a whole made of several; see [`hierarchy`](super::hierarchy).
#[derive(Debug, Clone, PartialEq)]
pub struct Compound {
    /// [`Level::Part`] or [`Level::Whole`].
    pub level: Level,
    /// For a part: the thing it lies in. For a whole: the things it consists of. Ascending.
    pub things: Vec<InstanceId>,
    /// Superpoints of a part, ascending; its points are those that belong to its thing. Empty for a
    /// whole, which has all points of its things.
    pub superpoints: Vec<u32>,
}

/// The instances of each point. Ids number the things from 1, then the compounds in order.
#[derive(Debug, Clone)]
pub struct Labels<'a> {
    /// The thing of each point; 0: none.
    pub thing_of_point: Cow<'a, [InstanceId]>,
    /// Parts and wholes.
    pub compounds: Vec<Compound>,
    /// Number of things, which is the id of the last one.
    pub things: u32,
    superpoint_of_point: &'a [u32],
    /// By superpoint: a thing, and its part at this superpoint.
    parts_at: Vec<Vec<(InstanceId, InstanceId)>>,
    /// By thing id.
    wholes_of: Vec<Vec<InstanceId>>,
}

impl<'a> Labels<'a> {
    /// Creates labels with things only, one id per point; 0: none.
    #[must_use]
    pub fn from_things(thing_of_point: &'a [InstanceId]) -> Self {
        Self::new(Cow::Borrowed(thing_of_point), &[], Vec::new())
    }

    fn new(
        thing_of_point: Cow<'a, [InstanceId]>,
        superpoint_of_point: &'a [u32],
        compounds: Vec<Compound>,
    ) -> Self {
        let things = thing_of_point.iter().max().map_or(0, |id| id.0);
        let superpoints = compounds
            .iter()
            .filter_map(|c| c.superpoints.last())
            .max()
            .map_or(0, |&s| s as usize + 1);
        let (mut parts_at, mut wholes_of) =
            (vec![Vec::new(); superpoints], vec![Vec::new(); things as usize + 1]);
        for (compound, id) in compounds.iter().zip(things + 1..) {
            match compound.level {
                Level::Thing => {}
                Level::Part => {
                    for &superpoint in &compound.superpoints {
                        parts_at[superpoint as usize].push((compound.things[0], InstanceId(id)));
                    }
                }
                Level::Whole => compound
                    .things
                    .iter()
                    .for_each(|thing| wholes_of[thing.0 as usize].push(InstanceId(id))),
            }
        }
        Self { thing_of_point, compounds, things, superpoint_of_point, parts_at, wholes_of }
    }

    /// Numbers regions as candidate things, with their parts and wholes. Ids count from 1 in
    /// descending order of points; ties are broken by the region's first point.
    #[must_use]
    pub fn from_regions(
        region_of: &[u32],
        superpoints: &'a Superpoints,
        proposals: Vec<Proposal>,
    ) -> Self {
        let count = region_of.iter().max().map_or(0, |&r| r as usize + 1);
        // Number of points of each region, and its first point.
        let mut sizes = vec![(0_u32, 0_u32); count];
        for (i, &region) in region_of.iter().enumerate().rev() {
            let (points, first) = &mut sizes[region as usize];
            (*points, *first) = (*points + 1, i as u32);
        }
        let mut order: Vec<usize> = (0..count).filter(|&region| sizes[region].0 > 0).collect();
        order.sort_by_key(|&region| (std::cmp::Reverse(sizes[region].0), sizes[region].1));
        let mut ids = vec![InstanceId(0); count];
        (1..).zip(order).for_each(|(id, region)| ids[region] = InstanceId(id));
        let compound = |Proposal { level, superpoints, regions, .. }: Proposal| {
            // A region can lose its last point to others after the proposal.
            let id = |&r: &u32| ids.get(r as usize).copied().filter(|id| id.0 != 0);
            let mut things: Vec<InstanceId> = regions.iter().map(id).collect::<Option<_>>()?;
            things.sort_unstable();
            let superpoints = if level == Level::Part { superpoints } else { Vec::new() };
            Some(Compound { level, things, superpoints })
        };
        let compounds = proposals.into_iter().filter_map(compound).collect();
        Self::new(
            region_of.iter().map(|&region| ids[region as usize]).collect(),
            &superpoints.of_point,
            compounds,
        )
    }

    /// Returns the instances a point belongs to: its thing, the wholes of that thing, its parts at
    /// this point.
    pub fn instances_of_point(&self, point: usize) -> impl Iterator<Item = InstanceId> + '_ {
        let thing = self.thing_of_point[point];
        let wholes = self.wholes_of.get(thing.0 as usize).into_iter().flatten().copied();
        let superpoint = self.superpoint_of_point.get(point);
        let parts = superpoint.and_then(|&s| self.parts_at.get(s as usize)).into_iter().flatten();
        let parts = parts.filter(move |(of, _)| *of == thing).map(|&(_, part)| part);
        (thing.0 != 0).then_some(thing).into_iter().chain(wholes).chain(parts)
    }

    /// Returns the number of the chosen points that each instance has, by id minus 1.
    #[must_use]
    pub fn counts(&self, chosen: impl Fn(u32) -> bool) -> Vec<u32> {
        let mut counts = vec![0; self.len()];
        for point in (0..self.thing_of_point.len()).filter(|&point| chosen(point as u32)) {
            self.instances_of_point(point).for_each(|id| counts[id.0 as usize - 1] += 1);
        }
        counts
    }

    /// Returns the number of instances.
    #[must_use]
    pub fn len(&self) -> usize {
        self.things as usize + self.compounds.len()
    }

    /// Returns whether there are none.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Returns the labels with new ids, by old one; 0: dropped. The remaining ones must keep their
    /// order. A compound remains only with all its things.
    #[must_use]
    pub fn renumber(self, new_id: &[InstanceId]) -> Self {
        let renamed = |id: &InstanceId| new_id[id.0 as usize];
        let thing_of_point = self.thing_of_point.iter().map(renamed).collect();
        let kept = self
            .compounds
            .into_iter()
            .zip(&new_id[self.things as usize + 1..])
            .filter(|(_, id)| id.0 != 0);
        let compounds = kept
            .map(|(c, _)| Compound { things: c.things.iter().map(renamed).collect(), ..c })
            .collect();
        Self::new(thing_of_point, self.superpoint_of_point, compounds)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn regions_are_numbered_by_size_then_by_first_point() {
        let superpoints = Superpoints {
            of_point: vec![0; 7],
            patches: Vec::new(),
            adjacent: Vec::new(),
            roughness_m: Vec::new(),
        };
        let labels = Labels::from_regions(&[7, 2, 2, 0, 2, 0, 5], &superpoints, Vec::new());
        assert_eq!(
            labels.thing_of_point.iter().map(|id| id.0).collect::<Vec<_>>(),
            [3, 1, 1, 2, 1, 2, 4]
        );
        assert_eq!((labels.things, labels.len()), (4, 4));
    }

    /// Three regions over four superpoints: a whole of the first two, a part of the last, and a
    /// part of a region that no longer exists.
    #[test]
    fn point_belongs_to_its_thing_with_its_wholes_and_parts() {
        let superpoints = Superpoints {
            of_point: vec![0, 0, 0, 1, 1, 2, 3],
            patches: Vec::new(),
            adjacent: Vec::new(),
            roughness_m: Vec::new(),
        };
        let proposal = |level, regions: &[u32], superpoints: &[u32]| {
            let (regions, superpoints) = (regions.to_vec(), superpoints.to_vec());
            Proposal { level, regions, superpoints, agreement: 0.5 }
        };
        let proposals = vec![
            proposal(Level::Whole, &[0, 1], &[0, 1]),
            proposal(Level::Part, &[2], &[3]),
            proposal(Level::Whole, &[0, 9], &[0, 7]),
        ];
        // The last point of superpoint 1 moved to region 2 during refinement.
        let labels = Labels::from_regions(&[0, 0, 0, 1, 2, 2, 2], &superpoints, proposals);
        let of = |labels: &Labels, point| {
            labels.instances_of_point(point).map(|id| id.0).collect::<Vec<_>>()
        };
        assert_eq!((labels.things, labels.compounds.len()), (3, 2));
        assert_eq!(
            [of(&labels, 0), of(&labels, 3), of(&labels, 4), of(&labels, 6)],
            [vec![1, 4], vec![3, 4], vec![2], vec![2, 5]]
        );
        let renamed = labels.renumber(&[0, 1, 2, 0, 0, 3].map(InstanceId));
        assert_eq!(
            [of(&renamed, 0), of(&renamed, 3), of(&renamed, 6)],
            [vec![1], vec![], vec![2, 3]]
        );
    }
}
