//! What the question pipeline needs of a scene, wherever it comes from.

use super::names::NameIndex;
use super::picture_cache::PictureCache;
use image::RgbImage;
use std::collections::BTreeMap;
use std::fmt::Display;
use std::sync::Arc;
use uniground_geometry::boxes::Aabb;
use uniground_geometry::scene::{Embeddings, FrameEmbeddings, FrameIndex, Instance, InstanceId};
use uniground_models::chat::AskError;
use uniground_models::neural::{DualEncoder, ModelError};
use uniground_parsing::ParseError;
use uniground_parsing::pointed::PhotographPoint;
use uniground_render::{RenderScene, Shot, close_ups};

/// Where a question finds its scene: a stored parse of the service, the album of an evaluation, a
/// scene in memory.
pub trait SceneSource: Send + Sync + Sized + 'static {
    /// Why there is no answer: the source's own failures, and [`QuestionError`].
    type Error: From<QuestionError> + Display + Send + 'static;

    /// In order of id, which counts from 1.
    fn instances(&self) -> &[Instance];

    /// The names the instances were given, read.
    fn name_index(&self) -> &NameIndex;

    /// Box of all points, metres, world frame.
    fn extent(&self) -> Aabb;

    /// Name and version of the encoder that has seen the instances, or of the built-in attributes
    /// in its place.
    fn encoder_name(&self) -> String;

    /// What an encoder has seen of the instances, and that encoder; `None` where only measures were
    /// taken.
    ///
    /// # Errors
    /// The encoder that has seen the scene is not at hand.
    fn embeddings(&self) -> Result<Option<(&DualEncoder, &Embeddings)>, Self::Error>;

    /// What frames look like as a whole, to the encoder that has seen the instances; `None` where
    /// it has not looked at them.
    fn frame_embeddings(&self) -> Option<&FrameEmbeddings>;

    /// A frame's picture as it was taken; `None` where it can not be read.
    fn photograph(&self, frame: FrameIndex) -> Option<RgbImage>;

    /// The cloud, ready to be drawn.
    ///
    /// # Errors
    /// It can not be read.
    fn render_scene(&self) -> Result<Arc<RenderScene>, Self::Error>;

    /// At most `most` photographs that show an instance, best first. One that can not be read gives
    /// its place to the next.
    fn photographs(&self, instance: &Instance, most: usize) -> Vec<Shot>;

    /// The cache of pictures drawn for earlier questions, and what this scene is called in it.
    fn pictures(&self) -> (&PictureCache, &str);

    /// Names that the reviewing model gave before without having heard a question, by id; "" for
    /// what it could not name.
    fn names(&self) -> impl Future<Output = Result<BTreeMap<u32, String>, Self::Error>> + Send;

    /// Keeps such names; those given before stay.
    fn keep_names(
        &self,
        names: &BTreeMap<u32, String>,
    ) -> impl Future<Output = Result<(), Self::Error>> + Send;

    /// What lies at a place of a photograph, cut out as the next of the instances, and is none of
    /// these; `None` where nothing can be.
    ///
    /// # Errors
    /// A photograph can not be read, or a segmenter fails.
    fn cut_out(
        &self,
        place: PhotographPoint,
        is_not: &[InstanceId],
    ) -> Result<Option<Instance>, Self::Error>;

    /// Keeps an instance that was found for a question: the scene with it, in which it is the last,
    /// or the one that was kept for the same thing meanwhile; and its id.
    fn keep_found(
        self: &Arc<Self>,
        found: Instance,
    ) -> impl Future<Output = Result<(Arc<Self>, InstanceId), Self::Error>> + Send;

    /// Runs a step of computing, on a thread that it may keep busy.
    ///
    /// # Errors
    /// Those of `work`, or that it could not be run.
    fn compute<T: Send + 'static>(
        self: &Arc<Self>,
        work: impl FnOnce(&Self) -> Result<T, Self::Error> + Send + 'static,
    ) -> impl Future<Output = Result<T, Self::Error>> + Send;

    /// At most `most` photographs of an instance, or views of the cloud where there are none.
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

/// Why there is no answer, whatever the scene comes from.
#[derive(Debug, thiserror::Error)]
pub enum QuestionError {
    /// The encoder failed.
    #[error(transparent)]
    Encoder(#[from] ModelError),
    /// What a model saw in a photograph could not be looked up.
    #[error(transparent)]
    Photograph(#[from] ParseError),
    /// The reviewing model could not be asked.
    #[error(transparent)]
    Review(#[from] AskError),
    /// The model that should have read the question could not be asked.
    #[error("the question could not be read: {0}")]
    Unread(String),
}
