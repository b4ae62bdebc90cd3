//! Adds frames to a scan: checks them against the scene, fuses them and merges them into its cloud.
//!
//! The newest measurement wins. Points that new frames see through are removed. A surface with no
//! known point nearby is added. Everything else stays unchanged, so that superpoints, their
//! visibility in frames, and the instances built from them can stay unchanged as well.

use super::IngestError;
use super::fusion;
use super::load::frame_refs;
use super::reprojection::{self, CheckedConvention, SourceConvention};
use super::scan::Scan;
use nalgebra::{Rotation3, Translation3, UnitQuaternion};
use rayon::prelude::*;
use uniground_geometry::progress::Progress;
use uniground_geometry::scene::{
    Addition, FrameIndex, FrameRef, FreeSpaceVotes, PointCloud, SourceToScene, count_free_space,
    viewing_distance_m,
};
use uniground_geometry::voxels::{NEIGHBORS_26, VoxelKey, VoxelMap};
use uniground_geometry::{Isometry3, Matrix3, Point3, Vector3};
use uniground_types::findings::Finding;
use uniground_types::scene::detail_at;
use uniground_types::settings::ImportSettings;

/// A new surface this close to a known one counts as the same surface, meters. Pose drift and depth
/// noise are about this large.
const SAME_SURFACE_M: f32 = 0.04;
/// Number of frames that must see through a point before it is removed, if that many frames exist.
const ENOUGH_LOOKS: usize = 2;
/// Minimum share of the scene's points in view that must agree with the frames' depth. Below this,
/// the frames show another place, or their poses belong to another world. Merging them would carve
/// the scene away.
const BELONGS: f32 = 0.2;
/// Number of the scene's points that the frames are compared with.
const COMPARED_POINTS: usize = 50_000;

/// Frames that were found to belong to a scene.
#[derive(Debug)]
pub struct FitReport {
    /// The frames, with poses in the scene's world.
    pub frames: Vec<FrameRef>,
    /// Share of the scene's points in view that agree with the frames' depth.
    pub agreement: f32,
    /// What was found while reading and comparing them.
    pub findings: Vec<Finding>,
}

/// Transforms the frames of a scan into a scene's world and checks that they agree with the scene.
/// Frames are numbered from `first` on.
///
/// # Errors
/// Returns [`IngestError::DoesNotBelong`], or an error for the scan's poses or pictures.
pub fn check_fit(
    mut scan: Scan,
    to_scene: &SourceToScene,
    known: &PointCloud,
    first: u32,
) -> Result<FitReport, IngestError> {
    if scan.frames.is_empty() {
        let reason = "a scene can only be extended with frames (pictures with depth and poses), not with a cloud alone".to_owned();
        return Err(IngestError::NoUsableFrames { reason });
    }
    let world = SourceFrame::near_scene(to_scene);
    scan.origin = world.origin;
    let mut findings = std::mem::take(&mut scan.findings);
    let declared = SourceConvention {
        pose: scan.pose,
        axes: scan.camera_axes,
        depth_scale_m: scan.depth_scale_m,
        metres_per_unit: to_scene.metres_per_unit,
    };
    let frames = frame_refs(&scan, &declared)?;
    let back = world.turn.inverse();
    let sample = known.positions.iter().step_by(known.len().div_ceil(COMPARED_POINTS).max(1));
    let positions: Vec<Point3<f32>> = sample.map(|p| back * p).collect();
    let sample = PointCloud { colors: vec![[0; 3]; positions.len()], positions };
    let CheckedConvention { reading, agreement } =
        reprojection::check(&scan, declared, Some(&sample), &frames, &mut findings).map_err(
            |error| match error {
                IngestError::NothingFits { agreement, .. } => {
                    IngestError::DoesNotBelong { agreement }
                }
                other => other,
            },
        )?;
    // Frames that see none of the known points can show any place.
    let agreement = agreement.unwrap_or(0.0);
    if agreement < BELONGS {
        return Err(IngestError::DoesNotBelong { agreement: agreement * 100.0 });
    }
    let frames = if reading == declared { frames } else { frame_refs(&scan, &reading)? };
    let placed = |frame: FrameRef| FrameRef {
        index: FrameIndex(first + frame.index.0),
        camera_to_world: world.turn * frame.camera_to_world,
        ..frame
    };
    Ok(FitReport { frames: frames.into_iter().map(placed).collect(), agreement, findings })
}

/// Merges the frames of a scan into a scene whose cloud is `known`.
///
/// # Errors
/// Returns the errors of [`check_fit`], an error for too many frames that cannot be decoded, and
/// cancellation.
pub fn add_scan(
    scan: Scan,
    made_of: String,
    to_scene: &SourceToScene,
    known: &PointCloud,
    first: u32,
    settings: &ImportSettings,
    progress: &Progress,
) -> Result<Addition, IngestError> {
    let (skipped, all) = (scan.frames_skipped, scan.frames.len());
    let FitReport { mut frames, mut findings, .. } = check_fit(scan, to_scene, known, first)?;
    let fusion = settings.fusion.in_detail(detail_at(viewing_distance_m(&frames)));
    let fused = fusion::fuse(&mut frames, &fusion, &mut findings, &progress.sub_range(0.2, 0.7))?;
    let looking = progress.sub_range(0.7, 1.0);
    let looks = count_free_space::<IngestError>(&known.positions, &frames, |i| {
        Ok(looking.report("look_through", i as f32 / all as f32)?)
    })?;
    let enough = ENOUGH_LOOKS.min(frames.len()) as u32;
    let kept = remaining_points(known, &looks, &fused, enough);
    let new = new_surface_points(&fused, known, &kept);
    let frames_skipped = skipped + (all - frames.len()) as u32;
    Ok(Addition { made_of, frames, kept, new, apart_m: SAME_SURFACE_M, frames_skipped, findings })
}

/// Within this distance of removed points, the new frames decide where surfaces are, meters.
const AROUND_GONE_M: f32 = 0.1;
/// A point this close to a fused point lies on its surface, meters.
const ON_SURFACE_M: f32 = 0.027;

/// Returns the points that still exist. When an object is removed, frames do not see through its
/// lowest points, because the floor is barely behind them. Therefore a known point near removed
/// points stays only if it lies on the fused surface.
fn remaining_points(
    known: &PointCloud,
    looks: &[FreeSpaceVotes],
    fused: &PointCloud,
    enough: u32,
) -> Vec<u32> {
    let gone: Vec<Point3<f32>> = known
        .positions
        .iter()
        .zip(looks)
        .filter(|(_, looks)| looks.is_gone(enough))
        .map(|(p, _)| *p)
        .collect();
    let (gone, fused_far) = (
        NearbyPoints::new(&gone, AROUND_GONE_M),
        NearbyPoints::new(&fused.positions, AROUND_GONE_M),
    );
    let fused_near = NearbyPoints::new(&fused.positions, ON_SURFACE_M);
    let replaced = |p: &Point3<f32>| {
        gone.has_point_near(p) && fused_far.has_point_near(p) && !fused_near.has_point_near(p)
    };
    let goes = |point: usize| {
        looks[point].is_gone(enough) || looks[point].hits > 0 && replaced(&known.positions[point])
    };
    (0..known.len())
        .into_par_iter()
        .filter(|&point| !goes(point))
        .map(|point| point as u32)
        .collect()
}

/// A spatial index that finds whether any point is near.
struct NearbyPoints<'a> {
    points: &'a [Point3<f32>],
    within_m: f32,
    by_voxel: VoxelMap<Vec<u32>>,
}

impl<'a> NearbyPoints<'a> {
    fn new(points: &'a [Point3<f32>], within_m: f32) -> Self {
        let mut by_voxel: VoxelMap<Vec<u32>> = VoxelMap::default();
        for (p, i) in points.iter().zip(0..) {
            by_voxel.entry(VoxelKey::containing(p, within_m)).or_default().push(i);
        }
        Self { points, within_m, by_voxel }
    }

    /// Returns whether any indexed point lies within reach of `p`.
    fn has_point_near(&self, p: &Point3<f32>) -> bool {
        let key = VoxelKey::containing(p, self.within_m);
        let around = std::iter::once(key).chain(NEIGHBORS_26.iter().map(|&d| key.offset(d)));
        around
            .filter_map(|key| self.by_voxel.get(&key))
            .flatten()
            .any(|&i| (self.points[i as usize] - p).norm_squared() <= self.within_m * self.within_m)
    }
}

/// Returns the points of `fused` that have no remaining known point nearby.
fn new_surface_points(fused: &PointCloud, known: &PointCloud, kept: &[u32]) -> PointCloud {
    let kept: Vec<Point3<f32>> =
        kept.iter().map(|&point| known.positions[point as usize]).collect();
    let near = NearbyPoints::new(&kept, SAME_SURFACE_M);
    let is_known = |p: &Point3<f32>| near.has_point_near(p);
    let new: Vec<usize> =
        (0..fused.len()).into_par_iter().filter(|&i| !is_known(&fused.positions[i])).collect();
    PointCloud {
        positions: new.iter().map(|&i| fused.positions[i]).collect(),
        colors: new.iter().map(|&i| fused.colors[i]).collect(),
    }
}

/// The world that the poses of the files are given in.
struct SourceFrame {
    /// The point of that world that becomes the scene's origin, in that world's units.
    origin: [f64; 3],
    /// Transform from meters around that point to the scene.
    turn: Isometry3<f32>,
}

impl SourceFrame {
    fn near_scene(to_scene: &SourceToScene) -> Self {
        let rotation = Matrix3::from_fn(|row, column| to_scene.rotation[row][column] as f32);
        let rotation =
            UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(rotation));
        let turn = Isometry3::from_parts(Translation3::from(Vector3::zeros()), rotation);
        Self { origin: to_scene.invert([0.0; 3]), turn }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cloud(positions: impl IntoIterator<Item = [f32; 3]>) -> PointCloud {
        let positions: Vec<Point3<f32>> = positions.into_iter().map(Point3::from).collect();
        PointCloud { colors: vec![[9; 3]; positions.len()], positions }
    }

    #[test]
    fn only_points_far_from_known_points_are_new() {
        let known = cloud((0..100).map(|i| [i as f32 * 0.01, 0.0, 0.0]));
        let fused =
            cloud([[0.5, 0.03, 0.0], [0.5, 0.05, 0.0], [1.5, 0.0, 0.0], [-0.039, 0.0, 0.0]]);
        let all: Vec<u32> = (0..100).collect();
        let new = new_surface_points(&fused, &known, &all);
        assert_eq!(new.positions, [Point3::new(0.5, 0.05, 0.0), Point3::new(1.5, 0.0, 0.0)]);
        // Where known points were removed, the measured surface is new.
        assert_eq!(new_surface_points(&fused, &known, &all[..1]).len(), 3);
    }

    #[test]
    fn the_lowest_points_of_a_removed_object_are_removed_too() {
        // A post on a floor. Frames see through it down to eight centimeters above the floor.
        let known = cloud(
            (0..50)
                .map(|i| [0.0, 0.0, i as f32 * 0.01])
                .chain((1..50).map(|i| [i as f32 * 0.01, 0.0, 0.0])),
        );
        let looks: Vec<FreeSpaceVotes> = known
            .positions
            .iter()
            .map(|p| {
                if p.z > 0.08 {
                    FreeSpaceVotes { hits: 0, through: 3 }
                } else {
                    FreeSpaceVotes { hits: 3, through: 0 }
                }
            })
            .collect();
        let fused = cloud((0..50).map(|i| [i as f32 * 0.01, 0.0, 0.0]));
        let kept: Vec<Point3<f32>> = remaining_points(&known, &looks, &fused, 2)
            .iter()
            .map(|&i| known.positions[i as usize])
            .collect();
        assert!(kept.iter().all(|p| p.z < 0.03) && kept.len() >= 50, "{kept:?}");
        // A point that no frame has seen stays, however near it is.
        let hidden: Vec<FreeSpaceVotes> = looks
            .iter()
            .map(|looks| if looks.hits > 0 { FreeSpaceVotes::default() } else { *looks })
            .collect();
        assert_eq!(remaining_points(&known, &hidden, &fused, 2).len(), 58);
    }

    #[test]
    fn map_coordinates_are_transformed_to_the_scene() {
        // A quarter turn about Z, centimeters, far away.
        let to_scene = SourceToScene {
            rotation: [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]],
            translation_m: [4_000.0, -5_000_000.0, 1.5],
            metres_per_unit: 0.01,
        };
        let SourceFrame { origin, turn } = SourceFrame::near_scene(&to_scene);
        let source = [500_000_012.0, 399_950.0, -140.0];
        let near = Point3::from(std::array::from_fn::<f32, 3, _>(|i| {
            ((source[i] - origin[i]) * 0.01) as f32
        }));
        let expected = to_scene.apply(source).map(|c| c as f32);
        assert!(
            (turn * near - Point3::from(expected)).norm() < 1e-3,
            "{} against {expected:?}",
            turn * near
        );
    }
}
