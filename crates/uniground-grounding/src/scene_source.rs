//! The data and operations that the question pipeline needs from a scene, independent of its
//! source.

use super::names::NameIndex;
use super::picture_cache::PictureCache;
use super::{Appearance, SceneView};
use image::RgbImage;
use std::collections::BTreeMap;
use std::fmt::Display;
use std::sync::Arc;
use uniground_geometry::boxes::Aabb;
use uniground_geometry::scene::{
    Embeddings, FrameEmbeddings, FrameIndex, FrameRef, Instance, InstanceId, RoomCoverage,
};
use uniground_models::chat::AskError;
use uniground_models::neural::{DualEncoder, ModelError};
use uniground_parsing::ParseError;
use uniground_parsing::pointed::PhotographPoint;
use uniground_render::{FrameContent, FrameContents, RenderScene, Shot, close_ups};

/// Returns a scene as stage 2 needs it.
pub(super) fn scene_view<'a, S: SceneSource>(
    source: &'a S,
    appearance: Option<&'a Appearance>,
) -> SceneView<'a> {
    SceneView {
        instances: source.instances(),
        extent: source.extent(),
        names: source.name_index(),
        appearance,
    }
}

/// The source of a question's scene: a stored parse of the service, the album of an evaluation, a
/// scene in memory.
pub trait SceneSource: Send + Sync + Sized + 'static {
    /// Why there is no answer: the source's own failures, and [`QuestionError`].
    type Error: From<QuestionError> + Display + Send + 'static;

    /// Returns the instances in order of id; ids count from 1.
    fn instances(&self) -> &[Instance];

    /// Returns the parsed names that the instances were given.
    fn name_index(&self) -> &NameIndex;

    /// Returns the box of all points, meters, world frame.
    fn extent(&self) -> Aabb;

    /// Returns whether the instances were made from the built-in masks, not by a segmenter.
    fn has_builtin_masks(&self) -> bool;

    /// Returns name and version of the encoder that embedded the instances, or of the built-in
    /// attributes in its place.
    fn encoder_name(&self) -> String;

    /// Returns the embeddings of the instances and their encoder; `None` where only measures were
    /// taken.
    ///
    /// # Errors
    /// The encoder that embedded the scene is not available.
    fn embeddings(&self) -> Result<Option<(&DualEncoder, &Embeddings)>, Self::Error>;

    /// Returns that encoder's embeddings of whole frames; `None` where it did not compute them.
    fn frame_embeddings(&self) -> Option<&FrameEmbeddings>;

    /// Returns a frame's original picture; `None` where it cannot be read.
    fn photograph(&self, frame: FrameIndex) -> Option<RgbImage>;

    /// Returns the scan's frames; none where there are no photographs.
    ///
    /// # Errors
    /// The frames cannot be read.
    fn frames(&self) -> Result<Vec<FrameRef>, Self::Error>;

    /// Returns which part of the room the frames saw; `None` for a scan without frames, and where it
    /// was not computed.
    fn coverage(&self) -> Option<&RoomCoverage> {
        None
    }

    /// Returns the cloud, ready to be rendered.
    ///
    /// # Errors
    /// The cloud cannot be read.
    fn render_scene(&self) -> Result<Arc<RenderScene>, Self::Error>;

    /// Returns at most `most` photographs that show an instance, best first. One that cannot be
    /// read is replaced by the next.
    fn photographs(&self, instance: &Instance, most: usize) -> Vec<Shot>;

    /// Returns the cache of rendered pictures, and the key of this scene in it.
    fn pictures(&self) -> (&PictureCache, &str);

    /// Returns the names that the reviewing model gave independently of any question, by id; "" for
    /// an instance that it could not name.
    fn names(&self) -> impl Future<Output = Result<BTreeMap<u32, String>, Self::Error>> + Send;

    /// Stores such names; existing ones stay.
    fn keep_names(
        &self,
        names: &BTreeMap<u32, String>,
    ) -> impl Future<Output = Result<(), Self::Error>> + Send;

    /// Segments the object at a place of a photograph as the next of the instances. It must be none
    /// of `is_not`; `None` where nothing can be segmented.
    ///
    /// # Errors
    /// A photograph cannot be read, or a segmenter fails.
    fn cut_out(
        &self,
        place: PhotographPoint,
        is_not: &[InstanceId],
    ) -> Result<Option<Instance>, Self::Error>;

    /// Returns what fills the object's area in a photograph better than the instance that was taken
    /// for it: an instance of the scene, or the next of them; `None` where nothing does.
    ///
    /// # Errors
    /// As [`cut_out`](Self::cut_out).
    fn find_better(
        &self,
        place: PhotographPoint,
        taken: InstanceId,
    ) -> Result<Option<Instance>, Self::Error>;

    /// Stores an instance that was found for a question. Returns the scene in which it is the last,
    /// or in which the same thing was stored meanwhile; and its id.
    fn keep_found(
        self: &Arc<Self>,
        found: Instance,
    ) -> impl Future<Output = Result<(Arc<Self>, InstanceId), Self::Error>> + Send;

    /// Runs a compute step, on a thread that it may block.
    ///
    /// # Errors
    /// Those of `work`, or that it could not be run.
    fn compute<T: Send + 'static>(
        self: &Arc<Self>,
        work: impl FnOnce(&Self) -> Result<T, Self::Error> + Send + 'static,
    ) -> impl Future<Output = Result<T, Self::Error>> + Send;

    /// Returns which instances the frames show, cached.
    ///
    /// # Errors
    /// The cloud or the frames cannot be read.
    fn frame_contents(&self) -> Result<Arc<FrameContents>, Self::Error> {
        let (cache, scene) = self.pictures();
        // Corrections add instances and dismiss others, and can be undone.
        let dismissed: Vec<u32> =
            self.instances().iter().filter(|i| i.dismissed).map(|i| i.id.0).collect();
        let key = format!("{scene} {} {dismissed:?}", self.instances().len());
        if let Some(known) = cache.contents.get(&key) {
            return Ok(known);
        }
        let (frames, render_scene) = (self.frames()?, self.render_scene()?);
        let contents = Arc::new(FrameContents::of(&render_scene, self.instances(), &frames));
        let size = |frame: &FrameContent| {
            size_of_val(&frame.instances[..]) + frame.cells.len() * size_of::<[i32; 3]>()
        };
        let bytes = contents.frames.iter().map(size).sum();
        cache.contents.put(key, contents.clone(), bytes);
        Ok(contents)
    }

    /// Returns at most `most` photographs of an instance, or views of the cloud where there are
    /// none.
    fn shots(&self, id: InstanceId, most: usize, render_scene: &RenderScene) -> Vec<Shot> {
        let instance = (id.0 as usize).checked_sub(1).and_then(|at| self.instances().get(at));
        let Some(instance) = instance else { return Vec::new() };
        let photographs = self.photographs(instance, most);
        if photographs.is_empty() && !render_scene.cloud.is_empty() {
            close_ups(render_scene, &instance.aabb)
        } else {
            photographs
        }
    }
}

/// Why there is no answer, for any source of the scene.
#[derive(Debug, thiserror::Error)]
pub enum QuestionError {
    /// The encoder failed.
    #[error(transparent)]
    Encoder(#[from] ModelError),
    /// The object that a model saw in a photograph could not be looked up.
    #[error(transparent)]
    Photograph(#[from] ParseError),
    /// The reviewing model could not be asked.
    #[error(transparent)]
    Review(#[from] AskError),
    /// The model that should have parsed the question could not be asked.
    #[error("the question could not be parsed: {0}")]
    Unread(String),
}
