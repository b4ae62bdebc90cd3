//! Answers in the coordinates of the uploaded files, or of the map that a scene lies in.

use crate::error::Error;
use jiff::Timestamp;
use uniground_storage::SceneRow;
use uniground_types::answer::Target;
use uniground_types::approach::{PlacedPose, PosesInFrame, StandingPose};
use uniground_types::placement::{FrameChoice, InFrame, SceneToFrame, Stamp};
use uniground_types::problem::FieldError;
use uniground_types::question::Region;
use uniground_types::scene::SourceToScene;

/// A coordinate frame other than the scene's own.
pub struct CoordinateFrameView {
    choice: FrameChoice,
    id: Option<String>,
    pub from_scene: SceneToFrame,
}

impl CoordinateFrameView {
    /// Returns the chosen frame, or `None` for the scene's own.
    ///
    /// # Errors
    /// [`Error::NoMap`], [`Error::NoSourceFrame`].
    pub fn resolve(
        choice: FrameChoice,
        scene: &SceneRow,
        source_to_scene: Option<SourceToScene>,
    ) -> Result<Option<Self>, Error> {
        let (id, from_scene) = match choice {
            FrameChoice::Scene => return Ok(None),
            FrameChoice::Source => {
                let source = source_to_scene
                    .ok_or_else(|| Error::NoSourceFrame { scene_id: scene.id.clone() })?;
                (None, SceneToFrame::scene_to_source(&source))
            }
            FrameChoice::Map => {
                let map = scene
                    .scene_to_map
                    .ok_or_else(|| Error::NoMap { scene_id: scene.id.clone() })?;
                (scene.map_frame_id.clone(), SceneToFrame::scene_to_map(&map))
            }
        };
        Ok(Some(Self { choice, id, from_scene }))
    }

    /// Returns a region of this frame in the scene's own.
    ///
    /// # Errors
    /// [`FieldError`] if the vertical axes of the two frames differ.
    pub fn region_to_scene(&self, region: &Region) -> Result<Region, FieldError> {
        /// Largest deviation from the vertical over one meter, meters.
        const LEVEL_M: f64 = 1e-3;
        let [x, y, z] = self.from_scene.invert([0.0; 3]);
        let [above_x, above_y, above_z] = self.from_scene.invert([0.0, 0.0, 1.0]);
        if (above_x - x).hypot(above_y - y) > LEVEL_M || above_z < z {
            return Err(FieldError::new(
                "/within",
                "the frame's z axis is not the vertical; use frame \"scene\"",
            ));
        }
        let to_scene = |point: [f64; 3]| self.from_scene.invert(point);
        Ok(Region {
            polygon: region.polygon.as_ref().map(|corners| {
                corners
                    .iter()
                    .map(|[x, y]| to_scene([*x, *y, 0.0]))
                    .map(|[x, y, _]| [x, y])
                    .collect()
            }),
            min_z: region.min_z.map(|z| to_scene([0.0, 0.0, z])[2]),
            max_z: region.max_z.map(|z| to_scene([0.0, 0.0, z])[2]),
        })
    }

    /// Returns the boxes of these targets in this frame.
    pub fn with_targets(self, targets: &[Target]) -> InFrame {
        let boxes = targets
            .iter()
            .map(|target| self.from_scene.transform_box(target.id, &target.oriented_box))
            .collect();
        InFrame {
            frame: self.choice,
            frame_id: self.id,
            stamp: Some(stamp()),
            scene_to_frame: self.from_scene,
            boxes,
        }
    }

    /// Returns these standing poses in this frame.
    pub fn with_poses(self, poses: &[StandingPose]) -> PosesInFrame {
        let poses =
            poses.iter().map(|pose| PlacedPose::from_pose(pose, &self.from_scene)).collect();
        PosesInFrame {
            frame: self.choice,
            frame_id: self.id,
            stamp: stamp(),
            scene_to_frame: self.from_scene,
            poses,
        }
    }
}

fn stamp() -> Stamp {
    let now = Timestamp::now();
    Stamp { sec: now.as_second(), nanosec: u32::try_from(now.subsec_nanosecond()).unwrap_or(0) }
}
