//! Superpoints: small patches that respect object borders (paper: VCCS, then region growing).
//!
//! Works on plain colored points, without mesh or normals. Every point belongs to exactly one
//! superpoint, and the labels depend only on the points and settings.

mod flow;
mod growth;
mod region_growing;
mod voxel_cloud;

pub use growth::grow_superpoints;
use nalgebra::SymmetricEigen;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use uniground_geometry::color::Lab;
use uniground_geometry::progress::{Cancelled, Progress};
use uniground_geometry::scene::PointCloud;
use uniground_geometry::voxels::typical_spacing_m;
use uniground_geometry::{Matrix3, Point3, Vector3};
use uniground_types::settings::SuperpointSettings;
use voxel_cloud::VoxelCloud;
pub(super) use voxel_cloud::WIDEST_RING;

/// Returns the edge of the voxels from which this cloud's superpoints are made, meters.
#[must_use]
pub fn voxel_m(cloud: &PointCloud, settings: &SuperpointSettings) -> f32 {
    coarsen_settings(*settings, typical_spacing_m(&cloud.positions)).voxel_m
}

/// Coarsens the settings to the density of the cloud: voxels smaller than the gaps between points
/// would fall apart into islands.
fn coarsen_settings(settings: SuperpointSettings, spacing_m: f32) -> SuperpointSettings {
    let voxel_m = settings.voxel_m.max(VOXEL_SPACINGS * spacing_m);
    let seed_voxels = (settings.seed_m / settings.voxel_m).min(ENOUGH_SEED_VOXELS);
    SuperpointSettings { voxel_m, seed_m: settings.seed_m.max(seed_voxels * voxel_m), ..settings }
}

/// Maximum distance of seeds in voxels where voxels are coarsened. Seeds otherwise stay as many
/// voxels apart as the settings say. Without this limit, a very fine voxel setting would spread the
/// seeds too far.
const ENOUGH_SEED_VOXELS: f32 = 6.0;

/// Minimum voxel edge in multiples of the typical point spacing.
const VOXEL_SPACINGS: f32 = 1.5;

/// A labeling of the cloud, with facts about each label.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Superpoints {
    /// Superpoint of each point of the cloud, numbered from 0.
    pub of_point: Vec<u32>,
    /// Means over the points of each superpoint, by its number from 0.
    pub patches: Vec<Patch>,
    /// Pairs `(low, high)` of neighbors, sorted.
    pub adjacent: Vec<(u32, u32)>,
    /// By superpoint: root mean square distance of the points to their local plane, meters. On flat
    /// surfaces this is sensor noise.
    pub roughness_m: Vec<f32>,
}

/// Mean properties of a set of points: a voxel, a superpoint, a region.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Patch {
    /// Number of points.
    pub points: u32,
    /// Center of mass, meters, world frame.
    pub center: Point3<f32>,
    /// Unit normal, sign arbitrary.
    pub normal: Vector3<f32>,
    /// Mean color, CIELAB.
    pub lab: Lab,
}

impl Superpoints {
    /// Returns the region of each point, given that of each superpoint.
    #[must_use]
    pub fn regions_of_points(&self, region_of: &[u32]) -> Vec<u32> {
        self.of_point.iter().map(|&superpoint| region_of[superpoint as usize]).collect()
    }
}

impl Patch {
    /// Merges patches by label `0..count`: point-weighted means of `parts`.
    #[must_use]
    pub fn merge_by_label(parts: &[Self], labels: &[u32], count: usize) -> Vec<Self> {
        let mut sums =
            vec![(0_u32, nalgebra::Vector3::<f64>::zeros(), Matrix3::zeros(), Lab::zeros()); count];
        for (part, &label) in parts.iter().zip(labels) {
            let n = part.points as f32;
            let sum = &mut sums[label as usize];
            sum.0 += part.points;
            // A floor has half a million points, perhaps kilometers from the origin: in single
            // precision it would move.
            sum.1 += part.center.coords.cast::<f64>() * f64::from(part.points);
            // Outer products add up regardless of the sign of each normal.
            sum.2 += part.normal * part.normal.transpose() * n;
            sum.3 += part.lab * n;
        }
        sums.into_par_iter()
            .map(|(points, center, spread, lab)| {
                let n = (points as f32).max(1.0);
                let eigen = SymmetricEigen::new(spread);
                let normal = eigen.eigenvectors.column(eigen.eigenvalues.imax()).into_owned();
                Self {
                    points,
                    center: Point3::from((center / f64::from(points.max(1))).cast::<f32>()),
                    normal,
                    lab: lab / n,
                }
            })
            .collect()
    }
}

/// Divides the cloud into superpoints.
///
/// # Errors
/// [`Cancelled`].
pub fn compute(
    cloud: &PointCloud,
    settings: &SuperpointSettings,
    progress: &Progress,
) -> Result<Superpoints, Cancelled> {
    progress.report("superpoints", 0.0)?;
    let settings = &coarsen_settings(*settings, typical_spacing_m(&cloud.positions));
    let voxels = VoxelCloud::new(cloud, settings.voxel_m, progress)?;
    progress.report("superpoints", 0.4)?;
    let labels = flow::grow(&voxels, settings, &progress.sub_range(0.4, 0.8))?;
    progress.report("superpoints", 0.8)?;
    let adjacent = voxels.adjacent_labels(&labels);
    progress.check()?;
    let region_of = region_growing::join(&voxels, &labels, &adjacent, settings);
    let labels: Vec<u32> = labels.into_iter().map(|l| region_of[l as usize]).collect();
    progress.report("superpoints", 0.95)?;
    let count = region_of.iter().max().map_or(0, |&r| r as usize + 1);
    let patches = Patch::merge_by_label(&voxels.patches, &labels, count);
    let adjacent = relabel_pairs(&adjacent, &region_of);
    let of_point = voxels.grid.of_point.iter().map(|&v| labels[v as usize]).collect();
    let roughness_m = mean_per_label(&labels, &voxels.roughness_m, count);
    Ok(Superpoints { of_point, patches, adjacent, roughness_m })
}

/// Returns the pairs `(low, high)` of neighbors after `label_of` has joined some of them, sorted.
pub(super) fn relabel_pairs(adjacent: &[(u32, u32)], label_of: &[u32]) -> Vec<(u32, u32)> {
    let mut pairs: Vec<(u32, u32)> = adjacent
        .iter()
        .map(|&(a, b)| (label_of[a as usize], label_of[b as usize]))
        .map(|(a, b)| (a.min(b), a.max(b)))
        .filter(|(a, b)| a != b)
        .collect();
    pairs.sort_unstable();
    pairs.dedup();
    pairs
}

/// Returns the mean of the values that share a label, for labels `0..count`.
fn mean_per_label(labels: &[u32], values: &[f32], count: usize) -> Vec<f32> {
    let mut sums = vec![(0.0_f32, 0.0_f32); count];
    for (&label, &value) in labels.iter().zip(values) {
        sums[label as usize].0 += value;
        sums[label as usize].1 += 1.0;
    }
    sums.into_iter().map(|(sum, n)| sum / n.max(1.0)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn compute_silently(cloud: &PointCloud) -> Superpoints {
        compute(cloud, &SuperpointSettings::default(), &Progress::silent()).unwrap()
    }

    /// Returns two colored squares that meet at a right angle.
    fn corner() -> PointCloud {
        let mut cloud = PointCloud::default();
        for i in 0..50 {
            for j in 0..50 {
                let (a, b) = (i as f32 * 0.01, j as f32 * 0.01);
                cloud.positions.push(Point3::new(a, b, 0.0));
                cloud.colors.push([200, 40, 40]);
                cloud.positions.push(Point3::new(a, 0.0, b + 0.01));
                cloud.colors.push([40, 40, 200]);
            }
        }
        cloud
    }

    #[test]
    fn superpoints_do_not_cross_a_colored_corner() {
        let cloud = corner();
        let superpoints = compute_silently(&cloud);
        let mut red = vec![0_u32; superpoints.patches.len()];
        let mut all = red.clone();
        for (label, color) in superpoints.of_point.iter().zip(&cloud.colors) {
            all[*label as usize] += 1;
            red[*label as usize] += u32::from(color[0] > 100);
        }
        let pure: u32 = red.iter().zip(&all).map(|(&r, &n)| r.max(n - r)).sum();
        let purity = pure as f32 / cloud.len() as f32;
        assert!(purity > 0.96, "purity {purity} with {} superpoints", all.len());
        assert!(!superpoints.adjacent.is_empty());
    }

    #[test]
    fn neighbors_reach_across_small_gaps_only() {
        // A thin pole in two pieces.
        let tied_over = |gap_m: f32| {
            let piece = |from: f32| {
                (0..200).map(move |i| {
                    Point3::new((i % 4) as f32 * 0.005, 0.0, from + (i / 4) as f32 * 0.01)
                })
            };
            let positions: Vec<_> = piece(0.0).chain(piece(0.5 + gap_m)).collect();
            let superpoints =
                compute_silently(&PointCloud { colors: vec![[90; 3]; positions.len()], positions });
            let (lower, upper) = (superpoints.of_point[199], superpoints.of_point[200]);
            // Neighbors that continue each other become one superpoint.
            lower == upper || superpoints.adjacent.contains(&(lower.min(upper), lower.max(upper)))
        };
        assert!(tied_over(0.06) && !tied_over(0.3));
    }

    #[test]
    fn settings_finer_than_the_cloud_are_coarsened_to_its_density() {
        let asked = |voxel_m: f32| SuperpointSettings { voxel_m, ..SuperpointSettings::default() };
        let (fine, default) =
            (coarsen_settings(asked(0.002), 0.02), coarsen_settings(asked(0.025), 0.02));
        assert_eq!((fine.voxel_m, fine.seed_m), (default.voxel_m, default.seed_m));
        assert!(
            (fine.voxel_m - 0.03).abs() < 1e-6 && (fine.seed_m - 0.18).abs() < 1e-6,
            "{fine:?}"
        );
        assert_eq!(
            coarsen_settings(asked(0.05), 0.02),
            asked(0.05),
            "settings coarse enough for the cloud do not change"
        );
    }

    #[test]
    fn degenerate_clouds_are_labeled() {
        let same = PointCloud {
            positions: vec![Point3::new(1.0, 2.0, 3.0); 100],
            colors: vec![[9; 3]; 100],
        };
        assert_eq!(compute_silently(&same).patches.len(), 1);
        let one = PointCloud { positions: vec![Point3::origin()], colors: vec![[0; 3]] };
        assert_eq!(compute_silently(&one).of_point, [0]);
        let none = compute_silently(&PointCloud::default());
        assert!(none.of_point.is_empty() && none.patches.is_empty());
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(24))]
        /// Every point has a label, every label has points, and the counts add up.
        #[test]
        fn labels_are_a_partition(points in prop::collection::vec((-1.0_f32..1.0, -1.0_f32..1.0, -0.2_f32..0.2), 1..400)) {
            let positions: Vec<_> = points.into_iter().map(|(x, y, z)| Point3::new(x, y, z)).collect();
            let cloud = PointCloud { colors: vec![[120, 90, 60]; positions.len()], positions };
            let superpoints = compute_silently(&cloud);
            let mut counts = vec![0; superpoints.patches.len()];
            superpoints.of_point.iter().for_each(|&l| counts[l as usize] += 1);
            prop_assert!(counts.iter().zip(&superpoints.patches).all(|(&n, p)| n > 0 && n == p.points));
            prop_assert!(superpoints.adjacent.iter().all(|&(a, b)| a < b && (b as usize) < counts.len()));
        }

        #[test]
        fn threads_do_not_change_labels(threads in 1_usize..5) {
            let cloud = corner();
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            prop_assert_eq!(pool.install(|| compute_silently(&cloud).of_point), compute_silently(&cloud).of_point);
        }
    }
}
