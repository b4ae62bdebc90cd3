//! What the frames of a scan saw: which part of the room, and when each instance last.
//!
//! One pass over the depth pictures after stage 1, because it needs the final ids. At most
//! [`MAX_FRAMES`] frames are read, so that the time is bounded.

use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::time::Instant;
use uniground_geometry::Point3;
use uniground_geometry::progress::{Cancelled, Progress};
use uniground_geometry::scene::{
    Camera, CoverageBuilder, DepthImage, FrameRef, Instance, InstanceId, ParsedScene, RoomCoverage,
    Structure, stream_frames,
};
use uniground_geometry::statistics::quantile;

/// Maximum number of frames that are read: an even sample with the first and the last one.
const MAX_FRAMES: usize = 400;
/// Number of points of an instance that are looked up in every frame.
const POINTS_PER_INSTANCE: usize = 100;
/// A frame shows an instance if it shows this share of its points.
const SHOWN: f32 = 0.1;
/// Number of points that the height of the floor is computed from.
const FLOOR_SAMPLE: usize = 50_000;
/// Where no floor was recognized, this share of the points is below it.
const BELOW_FLOOR: f32 = 0.01;
/// A visible point fits the measured depth: meters, and a share of the depth; the larger one
/// applies.
const MARGIN_M: f32 = 0.05;
const MARGIN: f32 = 0.025;

/// What the frames of a scan saw.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Observation {
    /// Which part of the room was seen. `None` for a scan without frames.
    pub coverage: Option<RoomCoverage>,
    /// Time of the newest frame that shows an instance, seconds since 1970, by instance id. Empty
    /// if frames have no times.
    pub last_seen_s: BTreeMap<u32, f64>,
}

impl Observation {
    /// Returns the same observation with the times of instances that people made by merging others:
    /// the newest time of their members. `instances` are those of the parse, as corrected.
    #[must_use]
    pub fn of_corrected(mut self, instances: &[Instance]) -> Self {
        for instance in instances.iter().filter(|instance| !instance.merged_from.is_empty()) {
            let times = instance.merged_from.iter().filter_map(|id| self.last_seen_s.get(&id.0));
            if let Some(newest) = times.copied().max_by(f64::total_cmp) {
                self.last_seen_s.insert(instance.id.0, newest);
            }
        }
        self
    }
}

/// Reads the depth pictures of a scan. Unreadable ones count as if they were not there: stage 1 has
/// reported them.
///
/// # Errors
/// Returns [`Cancelled`] when the work was cancelled.
pub fn observe(
    scene: &ParsedScene,
    frames: &[FrameRef],
    progress: &Progress,
) -> Result<Observation, Cancelled> {
    let start = Instant::now();
    let frames = sample(frames);
    let positions = &scene.cloud.positions;
    let mut coverage = match frames.is_empty() {
        true => None,
        false => CoverageBuilder::new(positions, floor_height(scene)),
    };
    let is_timed = frames.iter().any(|frame| frame.time_s.is_some());
    let looked_up = if is_timed { points_by_instance(scene) } else { Vec::new() };
    let mut last_seen_s: Vec<Option<f64>> = vec![None; looked_up.len()];
    stream_frames(
        &frames,
        |frame| {
            progress.check()?;
            Ok::<_, Cancelled>(frame.decode_depth().ok())
        },
        |at, depth| {
            let Some(depth) = depth else { return Ok(()) };
            let camera = frames[at].depth_camera();
            if let Some(coverage) = &mut coverage {
                coverage.add_frame(&camera, &depth);
            }
            if let Some(time_s) = frames[at].time_s {
                last_seen_s.par_iter_mut().zip(&looked_up).for_each(|(last, (_, points))| {
                    if last.is_none_or(|last| last < time_s) && shows(&camera, &depth, points) {
                        *last = Some(time_s);
                    }
                });
            }
            Ok(())
        },
    )?;
    tracing::debug!(
        frames = frames.len(),
        seconds = start.elapsed().as_secs_f32(),
        "frames observed"
    );
    let ids = looked_up.iter().map(|(id, _)| id.0);
    Ok(Observation {
        coverage: coverage.and_then(CoverageBuilder::finish),
        last_seen_s: ids.zip(last_seen_s).filter_map(|(id, last)| Some((id, last?))).collect(),
    })
}

/// Returns an even sample of the frames, with the first and the last one.
fn sample(frames: &[FrameRef]) -> Vec<FrameRef> {
    let count = frames.len().min(MAX_FRAMES);
    let at = |i: usize| i * (frames.len() - 1) / (count - 1).max(1);
    (0..count).map(|i| frames[at(i)].clone()).collect()
}

/// Returns the median height of the floor's points, meters, world frame.
fn floor_height(scene: &ParsedScene) -> f32 {
    let positions = &scene.cloud.positions;
    let is_floor: Vec<bool> = scene
        .instances
        .iter()
        .map(|instance| instance.structure == Some(Structure::Floor))
        .collect();
    let on_floor = positions
        .iter()
        .zip(&scene.instance_of_point)
        .filter(|(_, id)| is_floor.get((id.0 as usize).wrapping_sub(1)) == Some(&true))
        .map(|(p, _)| p.z);
    let step = positions.len().div_ceil(FLOOR_SAMPLE).max(1);
    let mut heights: Vec<f32> = on_floor.step_by(step).collect();
    quantile(&mut heights, 0.5).unwrap_or_else(|| {
        let mut heights: Vec<f32> = positions.iter().step_by(step).map(|p| p.z).collect();
        quantile(&mut heights, BELOW_FLOOR).unwrap_or(0.0)
    })
}

/// Returns an even sample of the points of each instance, in order of id. Parts have those of their
/// object within their box, and wholes those of all their objects.
fn points_by_instance(scene: &ParsedScene) -> Vec<(InstanceId, Vec<Point3<f32>>)> {
    let mut own: Vec<Vec<Point3<f32>>> = vec![Vec::new(); scene.instances.len()];
    for (p, id) in scene.cloud.positions.iter().zip(&scene.instance_of_point) {
        if let Some(points) = own.get_mut((id.0 as usize).wrapping_sub(1)) {
            points.push(*p);
        }
    }
    let of = |instance: &Instance| {
        let thing = |id: &InstanceId| own.get((id.0 as usize).wrapping_sub(1));
        let points = if instance.things.is_empty() {
            thing(&instance.id).cloned().unwrap_or_default()
        } else {
            let all = instance.things.iter().filter_map(thing).flatten();
            all.filter(|p| instance.aabb.contains(p)).copied().collect()
        };
        let step = points.len().div_ceil(POINTS_PER_INSTANCE).max(1);
        (instance.id, points.into_iter().step_by(step).collect())
    };
    scene.instances.par_iter().map(of).collect()
}

/// Returns whether a frame shows enough of the points.
fn shows(camera: &Camera, depth: &DepthImage, points: &[Point3<f32>]) -> bool {
    let is_visible = |p: &&Point3<f32>| {
        camera.project(p).is_some_and(|pixel| {
            let measured_m = depth.at(pixel.cell());
            measured_m > 0.0
                && (measured_m - pixel.z_m).abs() <= (MARGIN * measured_m).max(MARGIN_M)
        })
    };
    let visible = points.iter().filter(is_visible).count();
    visible > 0 && visible as f32 >= SHOWN * points.len() as f32
}

#[cfg(test)]
mod tests {
    use super::*;
    use camino::Utf8Path;
    use uniground_geometry::Vector3;
    use uniground_geometry::boxes::Aabb;
    use uniground_geometry::scene::{FrameIndex, Intrinsics, ParseReport, PointCloud, Support};
    use uniground_testing::{flat_frame, thing};

    const CAMERA: Intrinsics =
        Intrinsics { width: 32, height: 24, fx: 16.0, fy: 16.0, cx: 15.5, cy: 11.5 };

    fn frame(folder: &Utf8Path, index: u32, depth_m: f32, time_s: Option<f64>) -> FrameRef {
        FrameRef { time_s, ..flat_frame(folder, index, CAMERA, depth_m) }
    }

    /// Two walls in front of the camera: one instance at two meters, one at three.
    fn scene() -> ParsedScene {
        let wall = |z: f32| {
            (0..400).map(move |i| {
                Point3::new((i % 20) as f32 * 0.1 - 1.0, (i / 20) as f32 * 0.1 - 1.0, z)
            })
        };
        let positions: Vec<Point3<f32>> = wall(2.0).chain(wall(3.0)).collect();
        let instance_of_point = (0..800).map(|i| InstanceId(1 + i / 400)).collect();
        let at = |id| thing(id, [0.0, 0.0], [2.0; 3], 0.0, Support::Floor, [90; 3]);
        ParsedScene {
            cloud: PointCloud { colors: vec![[0; 3]; positions.len()], positions },
            instance_of_point,
            superpoint_of_point: vec![0; 800],
            instances: vec![at(1), at(2)],
            embeddings: None,
            frame_embeddings: None,
            extent: Aabb { center: Point3::new(0.0, 0.0, 2.5), size: Vector3::new(2.0, 2.0, 1.0) },
            report: ParseReport::default(),
        }
    }

    #[test]
    fn an_instance_was_last_seen_in_the_newest_frame_that_shows_it() {
        let folder = tempfile::tempdir().unwrap();
        let folder = Utf8Path::from_path(folder.path()).unwrap();
        let frames = [
            frame(folder, 0, 2.0, Some(1.5e9 + 2.0)),
            frame(folder, 1, 2.0, Some(1.5e9)),
            frame(folder, 2, 3.0, Some(1.5e9 + 1.0)),
            frame(folder, 3, 2.0, None),
        ];
        let seen = |frames: &[FrameRef]| {
            observe(&scene(), frames, &Progress::silent()).unwrap().last_seen_s
        };
        assert_eq!(seen(&frames), BTreeMap::from([(1, 1.5e9 + 2.0), (2, 1.5e9 + 1.0)]));
        assert_eq!(seen(&frames[3..]), BTreeMap::new());
        let nothing = observe(&scene(), &[], &Progress::silent()).unwrap();
        assert_eq!(nothing, Observation::default());
    }

    #[test]
    fn an_observation_is_read_back_with_times_of_merged_instances() {
        let stored =
            Observation { coverage: None, last_seen_s: BTreeMap::from([(1, 1.25e9), (2, 1.5e9)]) };
        let json = serde_json::to_vec(&stored).unwrap();
        let mut merged = scene().instances;
        merged.push(Instance {
            id: InstanceId(3),
            merged_from: vec![InstanceId(1), InstanceId(2)],
            ..merged[0].clone()
        });
        let read: Observation = serde_json::from_slice(&json).unwrap();
        assert_eq!(read.of_corrected(&merged).last_seen_s.get(&3), Some(&1.5e9));
    }

    #[test]
    fn long_scans_are_sampled_with_their_first_and_last_frame() {
        let folder = tempfile::tempdir().unwrap();
        let one = frame(Utf8Path::from_path(folder.path()).unwrap(), 0, 2.0, None);
        for count in [1, 2, 399, 400, 401, 5_000] {
            let frames: Vec<FrameRef> =
                (0..count).map(|i| FrameRef { index: FrameIndex(i), ..one.clone() }).collect();
            let sample: Vec<u32> = sample(&frames).iter().map(|frame| frame.index.0).collect();
            assert!(sample.len() == (count as usize).min(MAX_FRAMES) && sample.is_sorted());
            assert_eq!((sample[0], *sample.last().unwrap()), (0, count - 1));
            assert!(sample.windows(2).all(|two| two[0] < two[1]));
        }
    }
}
