//! Answers in the coordinates of the files that were uploaded, or of the map that a scene lies in.

use crate::error::Error;
use crate::store::SceneRow;
use uniground_types::answer::Target;
use uniground_types::placement::{FrameChoice, InFrame, SceneToFrame};
use uniground_types::scene::SourceToScene;

/// Coordinates other than the scene's.
pub(super) struct Frame {
    frame: FrameChoice,
    frame_id: Option<String>,
    pub to_frame: SceneToFrame,
}

impl Frame {
    /// Those that were chosen; `None` for the scene's own.
    ///
    /// # Errors
    /// [`Error::NoMap`], [`Error::NoSourceFrame`].
    pub fn of(choice: FrameChoice, scene: &SceneRow, source_to_scene: Option<SourceToScene>) -> Result<Option<Self>, Error> {
        let (frame_id, to_frame) = match choice {
            FrameChoice::Scene => return Ok(None),
            FrameChoice::Source => {
                let source = source_to_scene.ok_or_else(|| Error::NoSourceFrame { scene_id: scene.id.clone() })?;
                (None, SceneToFrame::to_source(&source))
            }
            FrameChoice::Map => {
                let map = scene.scene_to_map.ok_or_else(|| Error::NoMap { scene_id: scene.id.clone() })?;
                (scene.map_frame_id.clone(), SceneToFrame::to_map(&map))
            }
        };
        Ok(Some(Self { frame: choice, frame_id, to_frame }))
    }

    /// With the boxes of these.
    pub fn holding(self, targets: &[Target]) -> InFrame {
        let boxes = targets.iter().map(|target| self.to_frame.place(target.id, &target.oriented_box)).collect();
        InFrame { frame: self.frame, frame_id: self.frame_id, scene_to_frame: self.to_frame, boxes }
    }
}
