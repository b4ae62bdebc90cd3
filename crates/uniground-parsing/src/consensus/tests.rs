use super::clusters::cluster_masks;
use super::cuts::cut_superpoints;
use super::observations::ObservedFrame;
use super::*;
use crate::lifting::VisibleSuperpoint;
use crate::superpoints::Patch;
use uniground_geometry::color::Lab;
use uniground_geometry::{Point3, Vector3};

/// Frames that show all samples, given the masks of the samples in each.
fn observations(masks: &[Vec<u16>]) -> MaskObservations {
    let frames = masks.iter().map(|masks| ObservedFrame {
        samples: (0..masks.len() as u32).collect(),
        masks: vec![masks.clone()],
    });
    MaskObservations { frames: frames.collect(), layers: 1, samples: masks[0].len() }
}

/// A tray of 80 samples on a table of 220, in masks with these ids. 0: one mask shows both.
fn table_with_tray(tray: u16, table: u16) -> Vec<u16> {
    (0..300).map(|sample| if sample < 80 && tray != 0 { tray } else { table }).collect()
}

fn found(masks: &[Vec<u16>]) -> Vec<(Vec<u32>, usize)> {
    let clusters = cluster_masks(&observations(masks), 0, &Progress::silent()).unwrap();
    clusters.into_iter().map(|cluster| (cluster.samples, cluster.masks)).collect()
}

#[test]
fn masks_that_most_views_have_in_one_mask_are_one_cluster() {
    let apart = [table_with_tray(1, 2), table_with_tray(7, 3), table_with_tray(4, 9)];
    let (tray, table): (Vec<u32>, Vec<u32>) = (0..300).partition(|sample| *sample < 80);
    assert_eq!(found(&apart), [(tray.clone(), 3), (table.clone(), 3)]);
    // One view of ten has both in one mask, which the others split.
    let views: Vec<_> = (0..10).map(|i| table_with_tray(u16::from(i != 4), 2)).collect();
    assert_eq!(found(&views), [(tray, 9), (table, 9)]);
    // Most views have both in one mask.
    let views: Vec<_> = (0..30).map(|i| table_with_tray(u16::from(i == 4), 2)).collect();
    assert_eq!(found(&views)[0].0, (0..300).collect::<Vec<_>>());
}

#[test]
fn one_view_or_a_few_samples_are_no_cluster() {
    assert_eq!(found(&[table_with_tray(1, 2)]), []);
    let speck = |id| (0..300).map(|sample| if sample < 11 { id } else { 0 }).collect::<Vec<u16>>();
    assert_eq!(found(&[speck(1), speck(1), speck(1)]), []);
}

#[test]
fn cancellation_stops_clustering() {
    let cancelled = Progress::new(|_, _| {}, || true);
    let views = observations(&[table_with_tray(1, 2), table_with_tray(1, 2)]);
    assert_eq!(cluster_masks(&views, 0, &cancelled), Err(Cancelled));
}

/// A cloud with a point every centimeter along X, and superpoints of 100 points each.
fn row_of_superpoints(count: u32) -> (PointCloud, Superpoints) {
    let positions: Vec<_> =
        (0..count * 100).map(|i| Point3::new(i as f32 * 0.01, 0.0, 0.0)).collect();
    let patch = |i: u32| Patch {
        points: 100,
        center: Point3::new(i as f32 + 0.495, 0.0, 0.0),
        normal: Vector3::z(),
        lab: Lab::zeros(),
    };
    let superpoints = Superpoints {
        of_point: (0..count * 100).map(|point| point / 100).collect(),
        patches: (0..count).map(patch).collect(),
        adjacent: (1..count).map(|i| (i - 1, i)).collect(),
        roughness_m: vec![0.001; count as usize],
    };
    (PointCloud { colors: vec![[9; 3]; positions.len()], positions }, superpoints)
}

/// Counts, in one frame that shows all points, the points of each superpoint by mask.
fn table_of(of_point: &[u32], mask_of_point: &[u16]) -> FrameVisibility {
    let mut rows: BTreeMap<u32, BTreeMap<u16, u32>> = BTreeMap::new();
    for (&superpoint, &mask) in of_point.iter().zip(mask_of_point) {
        *rows.entry(superpoint).or_default().entry(mask).or_default() += 1;
    }
    let rows = rows.into_iter().map(|(superpoint, masks)| VisibleSuperpoint {
        superpoint,
        visible: masks.values().sum(),
        masks: masks.into_iter().filter(|(mask, _)| *mask != 0).collect(),
    });
    FrameVisibility { frame: FrameIndex(0), layer: 0, masks: 2, rows: rows.collect() }
}

#[test]
fn superpoints_are_cut_where_a_cluster_ends() {
    let (cloud, superpoints) = row_of_superpoints(4);
    // Points 0 to 139: superpoint 0, and 40 points of superpoint 1.
    let mask_of_point: Vec<u16> = (0..400).map(|point| if point < 140 { 1 } else { 2 }).collect();
    let tables = [table_of(&superpoints.of_point, &mask_of_point)];
    let seen = observations(&[mask_of_point.iter().copied().step_by(2).collect()]);
    let cluster = MaskCluster { samples: (0..70).collect(), masks: 3 };
    let again = MaskCluster { samples: (0..60).collect(), masks: 2 };
    let cut = cut_superpoints(
        &cloud,
        &superpoints,
        (&tables, &[FrameIndex(0)], &seen),
        &[cluster, again],
    );
    assert_eq!(cut.cut_off, [1, 4], "the second cluster cuts what was cut off");
    assert_eq!(cut.clusters, [vec![0, 4, 5], vec![0, 5]]);
    // Points between samples can go to either side of the border.
    let of_samples: Vec<u32> = cut.superpoints.of_point.iter().copied().step_by(2).collect();
    let expected: Vec<u32> = [(0, 50), (5, 10), (4, 10), (1, 30), (2, 50), (3, 50)]
        .into_iter()
        .flat_map(|(superpoint, count)| std::iter::repeat_n(superpoint, count))
        .collect();
    assert_eq!(of_samples, expected);
    let counts: Vec<u32> = cut.superpoints.patches.iter().map(|patch| patch.points).collect();
    assert_eq!(counts.iter().sum::<u32>(), 400);
    assert!(counts[4].abs_diff(20) <= 2 && counts[5].abs_diff(20) <= 2, "{counts:?}");
    assert!((cut.superpoints.patches[4].center.x - 1.295).abs() < 0.02);
    let twice = |samples: &[u32]| samples.iter().flat_map(|&s| [s, s]).collect::<Vec<_>>();
    assert_eq!(cut.tables, [table_of(&twice(&of_samples), &mask_of_point)]);
    assert_eq!(cut.extend(&[10, 11, 12, 13]), [10, 11, 12, 13, 11, 11]);
    assert!(cut.superpoints.adjacent.contains(&(1, 4)));
    assert!(cut.superpoints.adjacent.is_sorted());
}

/// Regroups four superpoints of 100 points in frames with these masks by superpoint.
fn regrouped(clusters: &[Vec<u32>], region_of: &[u32], frames: &[[u16; 4]]) -> Vec<u32> {
    let (_, superpoints) = row_of_superpoints(4);
    let tables: Vec<FrameVisibility> = (0..)
        .zip(frames)
        .map(|(frame, masks)| {
            let of_point: Vec<u16> =
                superpoints.of_point.iter().map(|&s| masks[s as usize]).collect();
            FrameVisibility {
                frame: FrameIndex(frame),
                ..table_of(&superpoints.of_point, &of_point)
            }
        })
        .collect();
    let rules = Regrouping {
        superpoints: &superpoints,
        tables: &tables,
        min_points: 50,
        min_agreement: 0.2,
    };
    rules.apply(clusters, region_of, &Progress::silent()).unwrap()
}

#[test]
fn cluster_becomes_a_region_where_masks_leave_it_out() {
    let book = [vec![3]];
    let desk = [1, 1, 1, 2];
    assert_eq!(regrouped(&book, &[0; 4], &[desk; 3]), [0, 0, 0, 1]);
    // Masks that show the drawer alone are rarer than those that include it.
    let whole = [1, 1, 1, 1];
    assert_eq!(regrouped(&book, &[0; 4], &[desk, whole, whole]), [0; 4]);
}

#[test]
fn halves_are_joined_and_taken_from_several_regions() {
    // A door in two regions, one of them with a piece of wall.
    assert_eq!(regrouped(&[vec![0, 1, 2]], &[0, 1, 1, 1], &[[1, 1, 1, 2]; 2]), [2, 2, 2, 1]);
    assert_eq!(regrouped(&[vec![0, 1]], &[0, 1, 2, 2], &[[1, 1, 2, 2]; 2]), [3, 3, 2, 2]);
}

#[test]
fn cluster_that_is_a_region_changes_nothing() {
    assert_eq!(regrouped(&[vec![0, 1]], &[0, 0, 1, 1], &[[1, 1, 2, 2]; 2]), [0, 0, 1, 1]);
    assert_eq!(regrouped(&[], &[0, 0, 1, 1], &[[1, 1, 2, 2]; 2]), [0, 0, 1, 1]);
}

#[test]
fn clusters_that_are_a_region_already_are_left_out() {
    let views = observations(&[vec![0; 200]]);
    // Region 0 has the samples 0 to 99.
    let region_of_point: Vec<u32> = (0..400).map(|point| u32::from(point >= 200)).collect();
    let cluster =
        |samples: std::ops::Range<u32>| MaskCluster { samples: samples.collect(), masks: 2 };
    let mut clusters = vec![cluster(0..80), cluster(0..70), cluster(60..140)];
    retain_new(&mut clusters, &region_of_point, &views);
    assert_eq!(clusters, [cluster(0..70), cluster(60..140)]);
}

#[test]
fn clusters_are_divided_into_connected_pieces() {
    let (cloud, _) = row_of_superpoints(4);
    // Samples are 2 cm apart; 10 cm are missing.
    let samples: Vec<u32> = (0..40).chain(45..100).collect();
    let pieces = connected_pieces(&cloud, &samples);
    assert_eq!(pieces, [(45..100).collect::<Vec<_>>(), (0..40).collect()]);
}

#[test]
fn regions_are_numbered_without_gaps() {
    assert_eq!(without_gaps(&[4, 0, 9, 4]), [1, 0, 2, 1]);
}
