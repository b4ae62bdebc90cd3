//! Affinity between neighbouring superpoints (paper, Eq. 1).
//!
//! Two superpoints belong together when the cameras that see both also put them in the same 2D
//! masks. Input: the visibility tables of [`lifting`](super::lifting). Output: one weight per edge
//! of the superpoint graph, in 0..=1, which [`merging`](super::merging) grows regions along.
//!
//! The printed equation averages `visibility * consistency` and so never exceeds the mean
//! visibility; [`Normalisation::Normalised`] divides by the summed visibility instead and is the
//! default. Where no camera sees both, geometry alone decides: neighbours of one colour on one even
//! surface belong together.

use super::lifting::{FrameVisibility, VisibleSuperpoint};
use super::superpoints::Patch;
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::collections::btree_map::Entry;
use uniground_geometry::progress::{Cancelled, Progress};
use uniground_types::settings::Normalisation;

/// An edge of the graph with its affinity, `a < b`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Edge {
    /// The lower superpoint, or region in later stages of merging.
    pub a: u32,
    /// The higher one.
    pub b: u32,
    /// Borders crossed on the way from one to the other: 1 = adjacent.
    pub hop: u32,
    /// `0..=1`, by Eq. 1; by geometry where no frame sees both.
    pub affinity: f32,
}

/// A way from one superpoint to another does not pass through one with more neighbours than this:
/// over the floor everything would be near everything.
const HUB: usize = 64;

/// The edges `(a, b, hop)` of a graph over `0..count`: all pairs up to `max_hop` borders apart, `a
/// < b`, sorted.
///
/// # Errors
/// [`Cancelled`].
pub fn pairs_within(
    adjacent: &[(u32, u32)],
    count: usize,
    max_hop: u32,
    progress: &Progress,
) -> Result<Vec<(u32, u32, u32)>, Cancelled> {
    let mut neighbours = vec![Vec::new(); count];
    for &(a, b) in adjacent {
        neighbours[a as usize].push(b);
        neighbours[b as usize].push(a);
    }
    let around: Vec<Vec<(u32, u32, u32)>> = (0..count as u32)
        .into_par_iter()
        .map(|start| {
            progress.check()?;
            let mut hops: BTreeMap<u32, u32> = BTreeMap::from([(start, 0)]);
            let mut ring = vec![start];
            for hop in 1..=max_hop {
                let ways =
                    ring.iter().filter(|&&n| n == start || neighbours[n as usize].len() <= HUB);
                let reached: Vec<u32> =
                    ways.flat_map(|&n| neighbours[n as usize].iter().copied()).collect();
                ring.clear();
                for n in reached {
                    if let Entry::Vacant(slot) = hops.entry(n) {
                        slot.insert(hop);
                        ring.push(n);
                    }
                }
            }
            Ok(hops
                .into_iter()
                .filter(|&(n, _)| n > start)
                .map(|(n, hop)| (start, n, hop))
                .collect())
        })
        .collect::<Result<_, Cancelled>>()?;
    Ok(around.concat())
}

/// Eq. (1) for every pair.
///
/// # Errors
/// [`Cancelled`].
pub fn compute(
    pairs: &[(u32, u32, u32)],
    patches: &[Patch],
    tables: &[FrameVisibility],
    normalisation: Normalisation,
    progress: &Progress,
) -> Result<Vec<Edge>, Cancelled> {
    // Row of each superpoint per frame, so that a pair is two look-ups.
    const ABSENT: u32 = u32::MAX;
    let rows: Vec<Vec<u32>> = tables
        .par_iter()
        .map(|table| {
            let mut row_of = vec![ABSENT; patches.len()];
            for (i, row) in table.rows.iter().enumerate() {
                row_of[row.superpoint as usize] = i as u32;
            }
            row_of
        })
        .collect();
    pairs
        .par_iter()
        .map(|&(a, b, hop)| {
            progress.check()?;
            let (mut consistent, mut weight, mut frames) = (0.0, 0.0, 0.0_f32);
            for (table, row_of) in tables.iter().zip(&rows) {
                let (row_a, row_b) = (row_of[a as usize], row_of[b as usize]);
                if row_a == ABSENT || row_b == ABSENT {
                    continue;
                }
                let (row_a, row_b) = (&table.rows[row_a as usize], &table.rows[row_b as usize]);
                let Some(similarity) = cosine(row_a, row_b) else { continue };
                let share = |row: &VisibleSuperpoint, of: u32| {
                    row.visible as f32 / patches[of as usize].points as f32
                };
                let joint = share(row_a, a) * share(row_b, b);
                consistent += joint * similarity;
                weight += joint;
                frames += 1.0;
            }
            let affinity = match normalisation {
                _ if frames == 0.0 => by_geometry(&patches[a as usize], &patches[b as usize]),
                Normalisation::Normalised => consistent / weight,
                Normalisation::Literal => consistent / frames,
            };
            Ok(Edge { a, b, hop, affinity })
        })
        .collect()
}

/// Cosine of two mask histograms; `None` when one of them has no masked point, which says nothing.
fn cosine(a: &VisibleSuperpoint, b: &VisibleSuperpoint) -> Option<f32> {
    let norm = |row: &VisibleSuperpoint| {
        row.masks.iter().map(|&(_, n)| (n as f32).powi(2)).sum::<f32>().sqrt()
    };
    let norms = norm(a) * norm(b);
    if norms == 0.0 {
        return None;
    }
    let (mut i, mut j, mut dot) = (0, 0, 0.0);
    while let (Some(&(mask_a, n_a)), Some(&(mask_b, n_b))) = (a.masks.get(i), b.masks.get(j)) {
        match mask_a.cmp(&mask_b) {
            std::cmp::Ordering::Less => i += 1,
            std::cmp::Ordering::Greater => j += 1,
            std::cmp::Ordering::Equal => {
                dot += n_a as f32 * n_b as f32;
                i += 1;
                j += 1;
            }
        }
    }
    Some((dot / norms).min(1.0))
}

/// CIELAB distance and angle at which geometry alone is half sure that two patches are different
/// things.
const HALF_COLOUR: f32 = 18.0;
const HALF_ANGLE_RAD: f32 = 0.6;

/// Affinity of two patches no camera sees together: high for one colour on one even surface.
fn by_geometry(a: &Patch, b: &Patch) -> f32 {
    let colour = (a.lab - b.lab).norm() / HALF_COLOUR;
    let bend = a.normal.dot(&b.normal).abs().min(1.0).acos() / HALF_ANGLE_RAD;
    1.0 / (1.0 + colour.powi(2) + bend.powi(2))
}

#[cfg(test)]
mod tests {
    use super::*;
    use uniground_geometry::colour::Lab;
    use uniground_geometry::scene::FrameIndex;
    use uniground_geometry::{Point3, Vector3};

    fn patch(points: u32) -> Patch {
        Patch { points, center: Point3::origin(), normal: Vector3::z(), lab: Lab::zeros() }
    }

    type Row<'a> = (u32, u32, &'a [(u16, u32)]);

    fn table(rows: &[Row]) -> FrameVisibility {
        let rows = rows
            .iter()
            .map(|&(superpoint, visible, masks)| VisibleSuperpoint {
                superpoint,
                visible,
                masks: masks.to_vec(),
            })
            .collect();
        FrameVisibility { frame: FrameIndex(0), layer: 0, masks: 2, rows }
    }

    #[test]
    fn equation_one_by_hand() {
        // Frame 1 sees half of 0 and all of 1, in one mask; frame 2 sees all of both, in different
        // masks.
        let tables = [
            table(&[(0, 5, &[(1, 5)]), (1, 10, &[(1, 10)])]),
            table(&[(0, 10, &[(1, 10)]), (1, 10, &[(2, 10)])]),
        ];
        let patches = [patch(10), patch(10)];
        let normalised = compute(
            &[(0, 1, 1)],
            &patches,
            &tables,
            Normalisation::Normalised,
            &Progress::silent(),
        )
        .unwrap()[0]
            .affinity;
        let literal =
            compute(&[(0, 1, 1)], &patches, &tables, Normalisation::Literal, &Progress::silent())
                .unwrap()[0]
                .affinity;
        assert!((normalised - 0.5 / 1.5).abs() < 1e-6, "{normalised}");
        assert!((literal - 0.5 / 2.0).abs() < 1e-6, "{literal}");
    }

    #[test]
    fn frames_without_masks_say_nothing() {
        let tables = [
            table(&[(0, 10, &[(1, 10)]), (1, 10, &[(1, 10)])]),
            table(&[(0, 10, &[]), (1, 10, &[(2, 10)])]),
        ];
        assert_eq!(
            compute(
                &[(0, 1, 1)],
                &[patch(10), patch(10)],
                &tables,
                Normalisation::Normalised,
                &Progress::silent()
            )
            .unwrap()[0]
                .affinity,
            1.0
        );
    }

    #[test]
    fn no_way_leads_through_a_hub() {
        let star = |spokes: u32| (1..=spokes).map(|i| (0, i)).collect::<Vec<_>>();
        let two_hops = |spokes: u32| {
            let pairs =
                pairs_within(&star(spokes), spokes as usize + 1, 2, &Progress::silent()).unwrap();
            assert_eq!(
                pairs.iter().filter(|p| p.2 == 1).count(),
                spokes as usize,
                "the hub keeps its own neighbours"
            );
            pairs.iter().filter(|p| p.2 == 2).count()
        };
        assert_eq!((two_hops(64), two_hops(65)), (64 * 63 / 2, 0));
    }

    #[test]
    fn hops_count_borders() {
        let pairs = pairs_within(&[(0, 1), (1, 2), (2, 3)], 4, 2, &Progress::silent()).unwrap();
        assert_eq!(pairs, [(0, 1, 1), (0, 2, 2), (1, 2, 1), (1, 3, 2), (2, 3, 1)]);
    }
}
