//! Parts and wholes: regions that masks show in addition to the things of a scene. Not in the
//! paper.
//!
//! No single segmentation suits every question: a bed can be found as blanket and headboard, or a
//! dresser without its drawers. Intermediate regions of merging are candidates for parts. Things
//! inside one mask, and pairs of neighbors, are candidates for wholes. The candidates that masks
//! show best are added beside the things, ranked by the same measure that separates things from
//! leftovers.

use super::consensus::RegionsOfScan;
use super::frame_masks::FrameMasks;
use super::lifting::{FrameVisibility, coarsen};
use super::merging::Regions;
use super::superpoints::Superpoints;
use rayon::prelude::*;
use std::collections::{BTreeMap, BTreeSet};
use uniground_geometry::progress::{Cancelled, Progress};
use uniground_geometry::scene::Level;
use uniground_types::settings::ParsingSettings;

/// A part or a whole that masks show.
#[derive(Debug, Clone, PartialEq)]
pub struct Proposal {
    /// [`Level::Part`] or [`Level::Whole`].
    pub level: Level,
    /// The superpoints it consists of, ascending.
    pub superpoints: Vec<u32>,
    /// For a part: the region it lies in. For a whole: the regions it consists of, ascending.
    pub regions: Vec<u32>,
    /// How well masks show it: IoU of its visible points and the best mask, averaged over frames
    /// weighted by visible points, `0..=1`.
    pub agreement: f32,
}

/// Two candidates with at least this IoU of their points are the same.
const SAME: f32 = 0.85;
/// A mask holds a region when this share of the region's visible points lies in it. Regions fill a
/// mask when this share of the mask's points lies in the regions it holds.
const HELD: f32 = 0.7;
/// A mask that holds more regions than this shows a corner of the room, not a thing.
const MOST_REGIONS: usize = 12;

/// Returns parts and wholes, best shown first: at most as many per region as the settings allow.
///
/// # Errors
/// [`Cancelled`].
pub fn propose(
    scan: &RegionsOfScan,
    settings: &ParsingSettings,
    progress: &Progress,
) -> Result<Vec<Proposal>, Cancelled> {
    let RegionsOfScan { superpoints, planes, levels, tables, region_of, clusters } = scan;
    progress.report("hierarchy", 0.0)?;
    let members = superpoints_by_region(region_of);
    let most = (settings.instances.parts_and_wholes * members.len() as f32) as usize;
    if most == 0 {
        return Ok(Vec::new());
    }
    let mut proposals = find_parts(levels, region_of, tables);
    let from_clusters = parts_from_clusters(clusters, superpoints, region_of, tables);
    let is_cluster: BTreeSet<Vec<u32>> =
        from_clusters.iter().map(|proposal| proposal.superpoints.clone()).collect();
    proposals.extend(from_clusters);
    progress.check()?;
    proposals.extend(find_wholes(superpoints, region_of, &members, tables));
    let size = |set: &[u32]| {
        set.iter().map(|&s| superpoints.patches[s as usize].points as f32).sum::<f32>()
    };
    let planar = |set: &[u32]| set.iter().any(|&s| planes.of_superpoint[s as usize].is_some());
    proposals.retain(|p| {
        p.agreement >= settings.instances.min_agreement
            && size(&p.superpoints) >= settings.merging.min_points as f32
            && (is_cluster.contains(&p.superpoints) || !planar(&p.superpoints))
    });
    proposals.sort_by(|a, b| {
        b.agreement.total_cmp(&a.agreement).then_with(|| a.superpoints.cmp(&b.superpoints))
    });
    let same = |a: &[u32], b: &[u32]| {
        let both = size(&intersection(a, b));
        both >= SAME * (size(a) + size(b) - both)
    };
    let mut kept: Vec<Proposal> = Vec::new();
    for proposal in proposals {
        progress.check()?;
        let own = &proposal.superpoints;
        let is_thing = proposal.regions.iter().any(|&r| same(&members[r as usize], own));
        if !is_thing && kept.iter().all(|other| !same(&other.superpoints, own)) {
            kept.push(proposal);
        }
        if kept.len() >= most {
            break;
        }
    }
    Ok(kept)
}

/// Returns the superpoints of each region, ascending.
fn superpoints_by_region(region_of: &[u32]) -> Vec<Vec<u32>> {
    let mut members = vec![Vec::new(); region_of.iter().max().map_or(0, |&r| r as usize + 1)];
    (0..)
        .zip(region_of)
        .for_each(|(superpoint, &region)| members[region as usize].push(superpoint));
    members
}

/// Returns the intersection of two ascending lists.
fn intersection(a: &[u32], b: &[u32]) -> Vec<u32> {
    a.iter().copied().filter(|s| b.binary_search(s).is_ok()).collect()
}

/// Returns intermediate regions that lie inside one region of `region_of`. Not all do: things that
/// stood on a piece of furniture can be split off later.
fn find_parts(levels: &Regions, region_of: &[u32], tables: &[FrameVisibility]) -> Vec<Proposal> {
    let mut found: BTreeMap<Vec<u32>, f32> = BTreeMap::new();
    for level in &levels.levels {
        let coarse: Vec<FrameVisibility> =
            tables.par_iter().map(|table| coarsen(table, level)).collect();
        let members = superpoints_by_region(level);
        let alone = (0..members.len() as u32).map(|region| vec![region]).collect::<Vec<_>>();
        let agreements = agreements(&coarse, &alone);
        found.extend(members.into_iter().zip(agreements));
    }
    let of = |(superpoints, agreement): (Vec<u32>, f32)| {
        let regions = vec![region_of[*superpoints.first()? as usize]];
        let lies_in_it = superpoints.iter().all(|&s| region_of[s as usize] == regions[0]);
        lies_in_it.then_some(Proposal { level: Level::Part, superpoints, regions, agreement })
    };
    found.into_iter().filter_map(of).collect()
}

/// Returns clusters of masks as parts of the regions that hold most of them.
fn parts_from_clusters(
    clusters: &[Vec<u32>],
    superpoints: &Superpoints,
    region_of: &[u32],
    tables: &[FrameVisibility],
) -> Vec<Proposal> {
    let mut sets: BTreeMap<Vec<u32>, u32> = BTreeMap::new();
    for cluster in clusters {
        let mut votes: BTreeMap<u32, u32> = BTreeMap::new();
        for &s in cluster {
            *votes.entry(region_of[s as usize]).or_default() +=
                superpoints.patches[s as usize].points;
        }
        let all: u32 = votes.values().sum();
        let most = votes.into_iter().max_by_key(|&(region, n)| (n, std::cmp::Reverse(region)));
        if let Some((region, _)) = most.filter(|(_, n)| *n as f32 >= HELD * all as f32) {
            let inside = |s: &u32| region_of[*s as usize] == region;
            sets.insert(cluster.iter().copied().filter(inside).collect(), region);
        }
    }
    let (sets, regions): (Vec<Vec<u32>>, Vec<u32>) = sets.into_iter().unzip();
    let agreements = agreements(tables, &sets);
    sets.into_iter()
        .zip(regions)
        .zip(agreements)
        .map(|((superpoints, region), agreement)| Proposal {
            level: Level::Part,
            superpoints,
            regions: vec![region],
            agreement,
        })
        .collect()
}

/// Returns the sets of regions that one mask holds and that fill it, and pairs of neighbors.
fn find_wholes(
    superpoints: &Superpoints,
    region_of: &[u32],
    members: &[Vec<u32>],
    tables: &[FrameVisibility],
) -> Vec<Proposal> {
    let coarse: Vec<FrameVisibility> =
        tables.par_iter().map(|table| coarsen(table, region_of)).collect();
    let mut unions: BTreeSet<Vec<u32>> =
        coarse.par_iter().map(regions_held_by_masks).flatten_iter().collect();
    let neighbors =
        superpoints.adjacent.iter().map(|&(a, b)| (region_of[a as usize], region_of[b as usize]));
    unions.extend(neighbors.filter(|(a, b)| a != b).map(|(a, b)| vec![a.min(b), a.max(b)]));
    let unions: Vec<Vec<u32>> = unions.into_iter().collect();
    let agreements = agreements(&coarse, &unions);
    let whole = |(regions, agreement): (Vec<u32>, f32)| {
        let mut superpoints: Vec<u32> =
            regions.iter().flat_map(|&r| members[r as usize].iter().copied()).collect();
        superpoints.sort_unstable();
        Proposal { level: Level::Whole, superpoints, regions, agreement }
    };
    unions.into_iter().zip(agreements).map(whole).collect()
}

/// Returns, for each mask, the regions it holds, if they fill it.
fn regions_held_by_masks(table: &FrameVisibility) -> Vec<Vec<u32>> {
    // Per mask: its points, the points of the regions it holds, and these regions.
    let mut of_mask: BTreeMap<u16, (u32, u32, Vec<u32>)> = BTreeMap::new();
    for row in &table.rows {
        for &(mask, n) in &row.masks {
            let (all, filled, regions) = of_mask.entry(mask).or_default();
            *all += n;
            if n as f32 >= HELD * row.visible as f32 {
                *filled += n;
                regions.push(row.superpoint);
            }
        }
    }
    let filled =
        of_mask.into_values().filter(|(all, filled, _)| *filled as f32 >= HELD * *all as f32);
    filled
        .map(|(_, _, regions)| regions)
        .filter(|regions| (2..=MOST_REGIONS).contains(&regions.len()))
        .collect()
}

/// Returns how well masks show each union of rows of the tables, `0..=1`.
fn agreements(tables: &[FrameVisibility], unions: &[Vec<u32>]) -> Vec<f32> {
    let frames = FrameMasks::of_all(tables);
    let agreement = |union: &Vec<u32>| {
        let seen = frames.iter().map(|frame| frame.agreement(union));
        let (sum, weight) =
            seen.fold((0.0, 0.0), |(sum, weight), (iou, n)| (sum + iou * n, weight + n));
        if weight > 0.0 { sum / weight } else { 0.0 }
    };
    unions.par_iter().map(agreement).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lifting::VisibleSuperpoint;
    use crate::planes::Planes;
    use crate::superpoints::Patch;
    use uniground_geometry::scene::FrameIndex;
    use uniground_geometry::{Point3, Vector3};
    use uniground_types::settings::InstanceSettings;

    /// A chest of two superpoints with a lamp on it. One mask shows the drawer, superpoint 1;
    /// another shows chest and lamp together.
    #[test]
    fn parts_and_wholes_shown_by_masks_are_proposed() {
        let patch = Patch {
            points: 100,
            center: Point3::origin(),
            normal: Vector3::z(),
            lab: Vector3::zeros(),
        };
        let superpoints = Superpoints {
            of_point: Vec::new(),
            patches: vec![patch; 3],
            adjacent: vec![(0, 1), (0, 2)],
            roughness_m: vec![0.0; 3],
        };
        let planes = Planes::new(Vec::new(), vec![None; 3]);
        let region_of = vec![0, 0, 1];
        let levels = Regions { levels: vec![vec![0, 1, 2], region_of.clone()] };
        let table = |layer, masks: [&[(u16, u32)]; 3]| FrameVisibility {
            frame: FrameIndex(0),
            layer,
            masks: 2,
            rows: (0..)
                .zip(masks)
                .map(|(superpoint, masks)| VisibleSuperpoint {
                    superpoint,
                    visible: 100,
                    masks: masks.to_vec(),
                })
                .collect(),
        };
        let tables = vec![
            table(0, [&[(1, 10)], &[(2, 90)], &[]]),
            table(1, [&[(7, 95)], &[(7, 100)], &[(7, 80)]]),
        ];
        let scan =
            RegionsOfScan { superpoints, planes, levels, tables, region_of, clusters: Vec::new() };
        let proposed = |parts_and_wholes| {
            let instances = InstanceSettings { parts_and_wholes, ..InstanceSettings::default() };
            let settings = ParsingSettings { instances, ..ParsingSettings::default() };
            propose(&scan, &settings, &Progress::silent()).unwrap()
        };
        let told: Vec<_> = proposed(1.5)
            .into_iter()
            .map(|p| (p.level, p.superpoints, p.regions, (p.agreement * 100.0).round()))
            .collect();
        let whole = (Level::Whole, vec![0, 1, 2], vec![0, 1], 92.0);
        let drawer = (Level::Part, vec![1], vec![0], 90.0);
        // Superpoint 0 alone is shown by a third of the large mask.
        let rest = (Level::Part, vec![0], vec![0], 34.0);
        assert_eq!(told, [whole, drawer, rest]);
        assert_eq!((proposed(0.5).len(), proposed(0.0).len()), (1, 0));
    }

    /// A rug on a floor, superpoints 1 and 0 of a plane, and a cluster that lies in two regions.
    #[test]
    fn clusters_are_parts_of_their_region_even_on_a_plane() {
        let patch = Patch {
            points: 100,
            center: Point3::origin(),
            normal: Vector3::z(),
            lab: Vector3::zeros(),
        };
        let row = |superpoint, mask| VisibleSuperpoint {
            superpoint,
            visible: 100,
            masks: vec![(mask, 100)],
        };
        let scan = RegionsOfScan {
            superpoints: Superpoints {
                of_point: Vec::new(),
                patches: vec![patch; 3],
                adjacent: vec![(0, 1)],
                roughness_m: vec![0.0; 3],
            },
            planes: Planes::new(Vec::new(), vec![Some(0), Some(0), None]),
            levels: Regions { levels: vec![vec![0, 0, 1]] },
            tables: vec![FrameVisibility {
                frame: FrameIndex(0),
                layer: 0,
                masks: 3,
                rows: vec![row(0, 1), row(1, 2), row(2, 3)],
            }],
            region_of: vec![0, 0, 1],
            clusters: vec![vec![1], vec![1, 2]],
        };
        let found = |clusters: Vec<Vec<u32>>| {
            let scan = RegionsOfScan { clusters, ..scan.clone() };
            propose(&scan, &ParsingSettings::default(), &Progress::silent()).unwrap()
        };
        let rug =
            Proposal { level: Level::Part, superpoints: vec![1], regions: vec![0], agreement: 1.0 };
        assert_eq!(found(scan.clusters.clone()), [rug]);
        assert_eq!(found(Vec::new()), []);
    }
}
