//! Affinity between neighboring superpoints (paper, Eq. 1).
//!
//! Two superpoints belong together when the cameras that see both also put them in the same 2D
//! masks. Input: the visibility tables of [`lifting`](super::lifting). Output: one weight per edge
//! of the superpoint graph, in 0..=1, which [`merging`](super::merging) grows regions along.
//!
//! The printed equation averages `visibility * consistency` and so never exceeds the mean
//! visibility; [`Normalisation::Normalised`] divides by the summed visibility instead and is the
//! default. Where no camera sees both, the weight comes from geometry alone: neighbors of one color
//! on one flat surface get a high weight.

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
    /// The lower superpoint id; a region id in later stages of merging.
    pub a: u32,
    /// The higher id.
    pub b: u32,
    /// Number of borders crossed between the two: 1 = adjacent.
    pub hop: u32,
    /// In `0..=1`: Eq. 1, or geometry where no frame sees both.
    pub affinity: f32,
}

/// Paths between superpoints do not pass through one with more neighbors than this. Otherwise the
/// floor would make everything a neighbor of everything.
const HUB: usize = 64;

/// Returns the edges `(a, b, hop)` of a graph over `0..count`: all pairs up to `max_hop` borders
/// apart, `a < b`, sorted.
///
/// # Errors
/// [`Cancelled`].
pub fn pairs_within(
    adjacent: &[(u32, u32)],
    count: usize,
    max_hop: u32,
    progress: &Progress,
) -> Result<Vec<(u32, u32, u32)>, Cancelled> {
    let mut neighbors = vec![Vec::new(); count];
    for &(a, b) in adjacent {
        neighbors[a as usize].push(b);
        neighbors[b as usize].push(a);
    }
    let around: Vec<Vec<(u32, u32, u32)>> = (0..count as u32)
        .into_par_iter()
        .map(|start| {
            progress.check()?;
            let mut hops: BTreeMap<u32, u32> = BTreeMap::from([(start, 0)]);
            let mut ring = vec![start];
            for hop in 1..=max_hop {
                let ways =
                    ring.iter().filter(|&&n| n == start || neighbors[n as usize].len() <= HUB);
                let reached: Vec<u32> =
                    ways.flat_map(|&n| neighbors[n as usize].iter().copied()).collect();
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

/// Computes Eq. (1) for every pair.
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
    // Row of each superpoint per frame, so that a pair costs two look-ups.
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
                _ if frames == 0.0 => {
                    geometric_affinity(&patches[a as usize], &patches[b as usize])
                }
                Normalisation::Normalised => consistent / weight,
                Normalisation::Literal => consistent / frames,
            };
            Ok(Edge { a, b, hop, affinity })
        })
        .collect()
}

/// Returns the cosine of two mask histograms. `None` when one of them has no masked point, since
/// then there is no evidence.
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

/// CIELAB distance and angle at which geometry alone gives a probability of one half that two
/// patches are different things.
const HALF_COLOR: f32 = 18.0;
const HALF_ANGLE_RAD: f32 = 0.6;

/// Returns the affinity of two patches that no camera sees together: high for one color on one flat
/// surface.
fn geometric_affinity(a: &Patch, b: &Patch) -> f32 {
    let color = (a.lab - b.lab).norm() / HALF_COLOR;
    let bend = a.normal.dot(&b.normal).abs().min(1.0).acos() / HALF_ANGLE_RAD;
    1.0 / (1.0 + color.powi(2) + bend.powi(2))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use uniground_geometry::color::Lab;
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
    fn affinities_match_equation_one_computed_by_hand() {
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
    fn frames_where_a_superpoint_has_no_mask_are_ignored() {
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
    fn paths_do_not_pass_through_hubs() {
        let star = |spokes: u32| (1..=spokes).map(|i| (0, i)).collect::<Vec<_>>();
        let two_hops = |spokes: u32| {
            let pairs =
                pairs_within(&star(spokes), spokes as usize + 1, 2, &Progress::silent()).unwrap();
            assert_eq!(
                pairs.iter().filter(|p| p.2 == 1).count(),
                spokes as usize,
                "the hub keeps its own neighbors"
            );
            pairs.iter().filter(|p| p.2 == 2).count()
        };
        assert_eq!((two_hops(64), two_hops(65)), (64 * 63 / 2, 0));
    }

    #[test]
    fn hop_count_is_the_number_of_borders_crossed() {
        let pairs = pairs_within(&[(0, 1), (1, 2), (2, 3)], 4, 2, &Progress::silent()).unwrap();
        assert_eq!(pairs, [(0, 1, 1), (0, 2, 2), (1, 2, 1), (1, 3, 2), (2, 3, 1)]);
    }

    /// Returns the affinity of superpoints 0 and 1.
    fn affinity(points: [u32; 2], tables: &[FrameVisibility], by: Normalisation) -> f32 {
        compute(&[(0, 1, 1)], &points.map(patch), tables, by, &Progress::silent()).unwrap()[0]
            .affinity
    }

    #[track_caller]
    fn assert_near(found: f32, expected: f32, what: &str) {
        assert!((found - expected).abs() < 1e-5, "{what}: {found}, expected {expected}");
    }

    #[test]
    fn affinity_multiplies_both_visibilities() {
        // The frame sees 3 of the 4 points of superpoint 0 and 5 of the 20 of superpoint 1, all in
        // one mask: (3 / 4) (5 / 20) 1 = 3 / 16. Without the first visibility it would be 1 / 4,
        // without the second 3 / 4.
        let tables = [table(&[(0, 3, &[(1, 3)]), (1, 5, &[(1, 5)])])];
        assert_near(affinity([4, 20], &tables, Normalisation::Literal), 3.0 / 16.0, "3/4 of 5/20");
        // Now few points of 0 are visible and almost all of 1: (1 / 4) (18 / 20) 1 = 9 / 40.
        let tables = [table(&[(0, 1, &[(1, 1)]), (1, 18, &[(1, 18)])])];
        assert_near(affinity([4, 20], &tables, Normalisation::Literal), 9.0 / 40.0, "1/4 of 18/20");
        // For a single frame, the normalized affinity is the similarity, however few points are
        // visible.
        assert_near(affinity([4, 20], &tables, Normalisation::Normalised), 1.0, "one mask");
    }

    #[test]
    fn frames_are_weighted_by_both_visibilities() {
        // Frame 1: w = (3 / 4) (5 / 20) = 3 / 16, s = (3, 0) . (3, 4) / (3 * 5) = 3 / 5.
        // Frame 2: w = (4 / 4) (2 / 20) = 1 / 10, s = 1.
        // Normalized: (3/16 * 3/5 + 1/10) / (3/16 + 1/10) = (9/80 + 8/80) / (23/80) = 17 / 23.
        // Literal: (9/80 + 8/80) / 2 = 17 / 160.
        let tables = [
            table(&[(0, 3, &[(1, 3)]), (1, 5, &[(1, 3), (2, 4)])]),
            table(&[(0, 4, &[(7, 4)]), (1, 2, &[(7, 2)])]),
        ];
        assert_near(affinity([4, 20], &tables, Normalisation::Normalised), 17.0 / 23.0, "mean");
        assert_near(affinity([4, 20], &tables, Normalisation::Literal), 17.0 / 160.0, "as printed");
    }

    #[test]
    fn frames_that_see_only_one_superpoint_are_ignored() {
        let both = table(&[(0, 2, &[(1, 2)]), (1, 4, &[(1, 4)])]);
        let alone = [
            table(&[(0, 4, &[(1, 4)])]),
            table(&[(1, 4, &[(1, 4)])]),
            // Superpoint 2 is not part of the pair.
            table(&[(0, 4, &[(1, 4)]), (2, 4, &[(1, 4)])]),
            table(&[]),
        ];
        // (2 / 4) (4 / 4) 1 in one frame. Frames that see only one superpoint do not count.
        for other in alone {
            let tables = [other.clone(), both.clone(), other];
            let patches = [patch(4), patch(4), patch(4)];
            let edges = compute(
                &[(0, 1, 1)],
                &patches,
                &tables,
                Normalisation::Literal,
                &Progress::silent(),
            );
            assert_near(edges.unwrap()[0].affinity, 0.5, &format!("{:?}", tables[0].rows));
        }
    }

    #[test]
    fn edges_keep_the_order_and_the_hops_of_their_pairs() {
        let tables = [table(&[
            (0, 4, &[(1, 4)]),
            (1, 4, &[(1, 3), (2, 4)]),
            // Completely visible, in its own mask.
            (2, 4, &[(3, 4)]),
        ])];
        let edges = compute(
            &[(0, 2, 2), (0, 1, 1), (1, 2, 3)],
            &[patch(4), patch(4), patch(4)],
            &tables,
            Normalisation::Normalised,
            &Progress::silent(),
        )
        .unwrap();
        // (1, 0) and (3 / 5, 4 / 5) have the cosine 3 / 5.
        let expected = [
            Edge { a: 0, b: 2, hop: 2, affinity: 0.0 },
            Edge { a: 0, b: 1, hop: 1, affinity: 0.6 },
            Edge { a: 1, b: 2, hop: 3, affinity: 0.0 },
        ];
        for (edge, expected) in edges.iter().zip(&expected) {
            assert_near(edge.affinity, expected.affinity, &format!("{edge:?}"));
            assert_eq!(Edge { affinity: 0.0, ..*edge }, Edge { affinity: 0.0, ..*expected });
        }
        assert_eq!(edges.len(), 3);
    }

    fn histogram(masks: &[(u16, u32)]) -> VisibleSuperpoint {
        VisibleSuperpoint { superpoint: 0, visible: 1, masks: masks.to_vec() }
    }

    #[test]
    fn similarity_is_the_cosine_of_the_mask_histograms() {
        type Masks = &'static [(u16, u32)];
        let cases: [(Masks, Masks, f32); 7] = [
            // (3 * 12 + 4 * 5) / (5 * 13) = 56 / 65.
            (&[(1, 3), (2, 4)], &[(1, 12), (2, 5)], 56.0 / 65.0),
            // Only mask 2 is common: 4 * 5 / (5 * 13) = 4 / 13.
            (&[(1, 3), (2, 4)], &[(2, 5), (3, 12)], 4.0 / 13.0),
            // Masks 3 and 5 are common: (3 * 2 + 6 * 10) / (7 * 11) = 66 / 77; 7 is the root of
            // 4 + 9 + 36, 11 that of 1 + 4 + 16 + 100.
            (&[(1, 2), (3, 3), (5, 6)], &[(2, 1), (3, 2), (4, 4), (5, 10)], 66.0 / 77.0),
            // No common mask, whichever list ends first.
            (&[(1, 3)], &[(2, 3)], 0.0),
            (&[(1, 3), (9, 1)], &[(2, 3)], 0.0),
            // Only the share per mask counts, not the number of points.
            (&[(4, 1), (6, 2)], &[(4, 100), (6, 200)], 1.0),
            (&[(4, 1)], &[(4, 70_000)], 1.0),
        ];
        for (a, b, expected) in cases {
            let (there, back) =
                (cosine(&histogram(a), &histogram(b)), cosine(&histogram(b), &histogram(a)));
            assert_near(there.unwrap(), expected, &format!("{a:?} and {b:?}"));
            assert_eq!(there, back, "{a:?} and {b:?}");
        }
        for (a, b) in [(&[(1, 3)][..], &[][..]), (&[], &[(1, 3)]), (&[], &[])] {
            assert_eq!(cosine(&histogram(a), &histogram(b)), None, "{a:?} and {b:?}");
        }
    }

    /// Returns a patch with this normal and color.
    fn geometry(normal: Vector3<f32>, lab: Lab) -> Patch {
        Patch { normal, lab, ..patch(1) }
    }

    #[test]
    fn geometric_affinity_depends_on_color_distance_and_angle() {
        let lab = Lab::new(50.0, 10.0, -20.0);
        let tilted = |angle: f32| Vector3::new(angle.sin(), 0.0, angle.cos());
        let from = geometry(Vector3::z(), lab);
        // 1 / (1 + (color distance / 18)^2 + (angle / 0.6)^2).
        let cases = [
            (0.0, 0.0, 1.0),
            (18.0, 0.0, 1.0 / 2.0),
            (36.0, 0.0, 1.0 / 5.0),
            (0.0, 0.6, 1.0 / 2.0),
            (0.0, 1.2, 1.0 / 5.0),
            (18.0, 0.6, 1.0 / 3.0),
            // 1 + 1/4 + 4 = 21/4.
            (9.0, 1.2, 4.0 / 21.0),
            // 1 + 1/9 + 1/4 = 49/36.
            (6.0, 0.3, 36.0 / 49.0),
        ];
        for (distance, angle, expected) in cases {
            // Along (2, 2, 1) / 3, so that each axis counts.
            let lab = lab + Lab::new(2.0, 2.0, 1.0) * (distance / 3.0);
            let to = geometry(tilted(angle), lab);
            let what = format!("color distance {distance}, angle {angle}");
            assert!((geometric_affinity(&from, &to) - expected).abs() < 1e-3, "{what}");
            assert_eq!(geometric_affinity(&from, &to), geometric_affinity(&to, &from), "{what}");
            let other_side = Patch { normal: -to.normal, ..to };
            assert_eq!(
                geometric_affinity(&from, &to),
                geometric_affinity(&from, &other_side),
                "{what}: the sign of a normal is arbitrary"
            );
        }
    }

    #[test]
    fn geometric_affinity_is_used_only_without_a_common_masked_frame() {
        // 18 apart on one plane: 1 / 2 by geometry.
        let patches = [patch(4), Patch { lab: Lab::new(18.0, 0.0, 0.0), ..patch(4) }];
        let found = |tables: &[FrameVisibility], by| {
            compute(&[(0, 1, 1)], &patches, tables, by, &Progress::silent()).unwrap()[0].affinity
        };
        let apart = [table(&[(0, 4, &[(1, 4)])]), table(&[(1, 4, &[(1, 4)])])];
        let without_masks = [table(&[(0, 4, &[]), (1, 4, &[(1, 4)])])];
        let seen = [table(&[(0, 4, &[(1, 4)]), (1, 4, &[(2, 4)])])];
        for by in [Normalisation::Normalised, Normalisation::Literal] {
            assert_near(found(&[], by), 0.5, "no frame at all");
            assert_near(found(&apart, by), 0.5, "never in one frame");
            assert_near(found(&without_masks, by), 0.5, "one of them in no mask");
            assert_near(found(&seen, by), 0.0, "seen together, in different masks");
        }
    }

    #[test]
    fn cancellation_stops_pairs_and_affinities() {
        let cancelled = Progress::new(|_, _| {}, || true);
        assert_eq!(pairs_within(&[(0, 1)], 2, 1, &cancelled), Err(Cancelled));
        let patches = [patch(1), patch(1)];
        let edges = compute(&[(0, 1, 1)], &patches, &[], Normalisation::Literal, &cancelled);
        assert_eq!(edges, Err(Cancelled));
    }

    #[test]
    fn hubs_are_path_ends_but_never_intermediate_stops() {
        // 65 neighbors around the last superpoint, and a tail at neighbor 0: 0 .. 64, hub 65, tail
        // 66.
        let mut adjacent: Vec<(u32, u32)> = (0..65).map(|i| (i, 65)).collect();
        adjacent.push((0, 66));
        let pairs = pairs_within(&adjacent, 67, 2, &Progress::silent()).unwrap();
        let hops = |hop: u32| pairs.iter().filter(move |pair| pair.2 == hop).copied();
        assert_eq!(hops(1).count(), 66, "{pairs:?}");
        // The hub reaches the tail through 0. No neighbor reaches another through the hub.
        assert_eq!(hops(2).collect::<Vec<_>>(), [(65, 66, 2)]);
    }

    #[test]
    fn no_hops_or_no_borders_give_no_pairs() {
        assert_eq!(pairs_within(&[(0, 1)], 2, 0, &Progress::silent()), Ok(vec![]));
        assert_eq!(pairs_within(&[], 3, 2, &Progress::silent()), Ok(vec![]));
        assert_eq!(pairs_within(&[], 0, 2, &Progress::silent()), Ok(vec![]));
    }

    /// Generates frames that see two superpoints of 40 points each, in four masks: at most 8 points
    /// in each mask and up to 8 in none.
    fn frames() -> impl Strategy<Value = Vec<FrameVisibility>> {
        let row = || (prop::array::uniform4(0_u32..=8), 0_u32..=8);
        prop::collection::vec((row(), row()), 1..6).prop_map(|frames| {
            let row_of = |superpoint, (counts, bare): ([u32; 4], u32)| {
                let masks: Vec<(u16, u32)> = (1..).zip(counts).filter(|mask| mask.1 > 0).collect();
                let visible = counts.iter().sum::<u32>() + bare;
                VisibleSuperpoint { superpoint, visible, masks }
            };
            let seen = |(a, b)| {
                let rows = vec![row_of(0, a), row_of(1, b)];
                let rows = rows.into_iter().filter(|row| row.visible > 0).collect();
                FrameVisibility { frame: FrameIndex(0), layer: 0, masks: 4, rows }
            };
            frames.into_iter().map(seen).collect()
        })
    }

    /// Swaps the ids of superpoints 0 and 1.
    fn swap_superpoints(tables: &[FrameVisibility]) -> Vec<FrameVisibility> {
        let other = |row: &VisibleSuperpoint| VisibleSuperpoint {
            superpoint: 1 - row.superpoint,
            ..row.clone()
        };
        let of_table = |table: &FrameVisibility| FrameVisibility {
            rows: table.rows.iter().rev().map(other).collect(),
            ..*table
        };
        tables.iter().map(of_table).collect()
    }

    proptest! {
        #[test]
        fn affinity_is_at_most_one_and_literal_never_exceeds_normalized(tables in frames()) {
            let normalized = affinity([40, 40], &tables, Normalisation::Normalised);
            let literal = affinity([40, 40], &tables, Normalisation::Literal);
            prop_assert!((0.0..=1.0 + 1e-5).contains(&normalized), "{normalized}");
            prop_assert!((0.0..=normalized + 1e-5).contains(&literal), "{literal} {normalized}");
        }

        #[test]
        fn affinity_is_symmetric(tables in frames()) {
            for by in [Normalisation::Normalised, Normalisation::Literal] {
                let there = affinity([40, 40], &tables, by);
                prop_assert_eq!(there, affinity([40, 40], &swap_superpoints(&tables), by));
            }
        }

        #[test]
        fn affinity_does_not_depend_on_frame_order(tables in frames()) {
            let reversed: Vec<FrameVisibility> = tables.iter().rev().cloned().collect();
            for by in [Normalisation::Normalised, Normalisation::Literal] {
                let (one, other) =
                    (affinity([40, 40], &tables, by), affinity([40, 40], &reversed, by));
                prop_assert!((one - other).abs() < 1e-5, "{one} {other}");
            }
        }

        /// The literal affinity halves when one superpoint has twice the points and the rest is
        /// unseen.
        #[test]
        fn unseen_points_lower_the_literal_affinity(tables in frames()) {
            let all = affinity([40, 40], &tables, Normalisation::Literal);
            let is_seen = tables.iter().any(|table| {
                table.rows.len() == 2 && table.rows.iter().all(|row| !row.masks.is_empty())
            });
            prop_assume!(is_seen);
            for points in [[80, 40], [40, 80]] {
                let fewer = affinity(points, &tables, Normalisation::Literal);
                prop_assert!((fewer - all / 2.0).abs() < 1e-5, "{fewer} of {all}: {points:?}");
                // The factor is the same in every frame, so it cancels in a weighted mean.
                let (one, other) = (
                    affinity([40, 40], &tables, Normalisation::Normalised),
                    affinity(points, &tables, Normalisation::Normalised),
                );
                prop_assert!((one - other).abs() < 1e-5, "{one} {other}: {points:?}");
            }
        }

        /// Compares with shortest paths found by trying every intermediate stop.
        #[test]
        fn pairs_match_shortest_paths_within_max_hop(
            borders in prop::collection::btree_set((0_usize..9, 0_usize..9), 0..16),
            max_hop in 0_u32..4,
        ) {
            let borders: Vec<(usize, usize)> =
                borders.into_iter().filter(|(a, b)| a < b).collect();
            let mut hops = [[99_u32; 9]; 9];
            for &(a, b) in &borders {
                (hops[a][b], hops[b][a]) = (1, 1);
            }
            for stop in 0..9 {
                for a in 0..9 {
                    for b in 0..9 {
                        hops[a][b] = hops[a][b].min(hops[a][stop] + hops[stop][b]);
                    }
                }
            }
            let mut expected = Vec::new();
            for a in 0..9_u32 {
                for b in a + 1..9 {
                    let hop = hops[a as usize][b as usize];
                    if hop <= max_hop {
                        expected.push((a, b, hop));
                    }
                }
            }
            let mut adjacent: Vec<(u32, u32)> =
                borders.iter().map(|&(a, b)| (a as u32, b as u32)).collect();
            let found = pairs_within(&adjacent, 9, max_hop, &Progress::silent()).unwrap();
            prop_assert_eq!(&found, &expected);
            adjacent.reverse();
            let found = pairs_within(&adjacent, 9, max_hop, &Progress::silent()).unwrap();
            prop_assert_eq!(&found, &expected, "with the borders reversed");
        }
    }
}
