//! A parsed scene in memory as a source for the question pipeline: for evaluation, and for a
//! robot's own process.

use super::names::NameIndex;
use super::picture_cache::PictureCache;
use super::scene_source::{QuestionError, SceneSource};
use image::RgbImage;
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};
use uniground_geometry::boxes::Aabb;
use uniground_geometry::scene::{
    Embeddings, FrameEmbeddings, FrameIndex, FrameRef, Instance, InstanceId, View,
};
use uniground_models::neural::{DualEncoder, Models, Segmenter};
use uniground_parsing::masks::is_builtin;
use uniground_parsing::pointed::{PhotographPoint, PointedObjectFinder};
use uniground_parsing::scan::ParsedScan;
use uniground_render::{RenderScene, Shot};
use uniground_types::settings::ParsingSettings;

/// The data that all questions about a scene share.
pub struct SceneAlbum {
    /// Box of all points, meters, world frame (Z up).
    pub extent: Aabb,
    /// The cloud, ready to be rendered.
    pub render_scene: Arc<RenderScene>,
    /// The encoder that embedded the scene, and its embeddings; `None` without an encoder.
    pub seen: Option<(Arc<DualEncoder>, Embeddings)>,
    /// Whether the instances were made from the built-in masks, not by a segmenter.
    pub has_builtin_masks: bool,
    /// Name and version of the encoder that embedded the instances, or of the built-in attributes
    /// in its place.
    pub encoder: String,
    /// That encoder's embeddings of whole frames, where it computed them.
    pub frame_embeddings: Option<FrameEmbeddings>,
    /// The scan's frames. Their picture files must stay in place as long as a model may be shown
    /// them.
    pub frames: Vec<FrameRef>,
    /// Segments an object that a model saw in a photograph; `None`: the built-in masks are used.
    pub segmenter: Option<Arc<Segmenter>>,
    pictures: PictureCache,
    /// Names that a model gave.
    names: Mutex<BTreeMap<u32, String>>,
}

/// An album with the instances of one question.
pub struct MemoryScene {
    album: Arc<SceneAlbum>,
    instances: Arc<[Instance]>,
    name_index: NameIndex,
}

impl SceneAlbum {
    /// Creates an album without pictures and names; questions add them. The arguments are the
    /// fields of the same names.
    #[must_use]
    pub fn new(
        extent: Aabb,
        render_scene: RenderScene,
        seen: Option<(Arc<DualEncoder>, Embeddings)>,
        encoder: String,
        frames: Vec<FrameRef>,
    ) -> Self {
        let render_scene = Arc::new(render_scene);
        let (pictures, names) = (PictureCache::default(), Mutex::default());
        Self {
            extent,
            render_scene,
            seen,
            has_builtin_masks: true,
            encoder,
            frame_embeddings: None,
            frames,
            segmenter: None,
            pictures,
            names,
        }
    }

    /// Sets the segmenter for objects that a model saw in a photograph.
    #[must_use]
    pub fn with_segmenter(self, segmenter: Option<Arc<Segmenter>>) -> Self {
        Self { segmenter, ..self }
    }

    /// Sets whether the instances were made from the built-in masks. True before.
    #[must_use]
    pub fn with_builtin_masks(self, has_builtin_masks: bool) -> Self {
        Self { has_builtin_masks, ..self }
    }

    /// Sets the encoder's embeddings of whole frames.
    #[must_use]
    pub fn with_frame_embeddings(self, frame_embeddings: Option<FrameEmbeddings>) -> Self {
        Self { frame_embeddings, ..self }
    }

    /// Combines these instances with this album.
    #[must_use]
    pub fn scene(self: &Arc<Self>, instances: Arc<[Instance]>) -> Arc<MemoryScene> {
        Arc::new(MemoryScene {
            album: self.clone(),
            name_index: NameIndex::of(&instances),
            instances,
        })
    }
}

impl MemoryScene {
    fn finder<'a>(&'a self, settings: &'a ParsingSettings) -> PointedObjectFinder<'a> {
        let SceneAlbum { render_scene, frames, segmenter, .. } = &*self.album;
        let (cloud, segmenter) = (&render_scene.cloud, segmenter.as_deref());
        PointedObjectFinder { cloud, frames, segmenter, settings }
    }

    /// Creates a scene from a parsed scan and the models used to parse it.
    #[must_use]
    pub fn of(scan: ParsedScan, models: &Models) -> Arc<Self> {
        let ParsedScan { scene, frames, models: used, .. } = scan;
        let seen = models.encoder.clone().zip(scene.embeddings);
        let render_scene = RenderScene::with_building(scene.cloud, &scene.instances);
        let album = SceneAlbum::new(scene.extent, render_scene, seen, used.encoder, frames)
            .with_builtin_masks(is_builtin(&used.masks))
            .with_frame_embeddings(scene.frame_embeddings);
        Arc::new(album.with_segmenter(models.segmenters.first().cloned()))
            .scene(scene.instances.into())
    }
}

impl SceneSource for MemoryScene {
    type Error = QuestionError;

    fn instances(&self) -> &[Instance] {
        &self.instances
    }

    fn name_index(&self) -> &NameIndex {
        &self.name_index
    }

    fn extent(&self) -> Aabb {
        self.album.extent
    }

    fn has_builtin_masks(&self) -> bool {
        self.album.has_builtin_masks
    }

    fn encoder_name(&self) -> String {
        self.album.encoder.clone()
    }

    fn embeddings(&self) -> Result<Option<(&DualEncoder, &Embeddings)>, QuestionError> {
        Ok(self.album.seen.as_ref().map(|(encoder, embeddings)| (encoder.as_ref(), embeddings)))
    }

    fn frame_embeddings(&self) -> Option<&FrameEmbeddings> {
        self.album.frame_embeddings.as_ref()
    }

    fn photograph(&self, frame: FrameIndex) -> Option<RgbImage> {
        self.album.frames.iter().find(|of| of.index == frame)?.decode_color().ok()
    }

    fn frames(&self) -> Result<Vec<FrameRef>, QuestionError> {
        Ok(self.album.frames.clone())
    }

    fn render_scene(&self) -> Result<Arc<RenderScene>, QuestionError> {
        Ok(self.album.render_scene.clone())
    }

    fn photographs(&self, instance: &Instance, most: usize) -> Vec<Shot> {
        let shot = |view: &View| Some(Shot::from_view(self.photograph(view.frame)?, view));
        instance.views.iter().filter_map(shot).take(most).collect()
    }

    fn pictures(&self) -> (&PictureCache, &str) {
        (&self.album.pictures, "")
    }

    async fn names(&self) -> Result<BTreeMap<u32, String>, QuestionError> {
        Ok(self.album.names.lock().unwrap_or_else(PoisonError::into_inner).clone())
    }

    async fn keep_names(&self, names: &BTreeMap<u32, String>) -> Result<(), QuestionError> {
        self.album.names.lock().unwrap_or_else(PoisonError::into_inner).extend(names.clone());
        Ok(())
    }

    fn cut_out(
        &self,
        place: PhotographPoint,
        is_not: &[InstanceId],
    ) -> Result<Option<Instance>, QuestionError> {
        Ok(self.finder(&ParsingSettings::default()).find_at(place, &self.instances, is_not)?)
    }

    fn find_better(
        &self,
        place: PhotographPoint,
        taken: InstanceId,
    ) -> Result<Option<Instance>, QuestionError> {
        Ok(self.finder(&ParsingSettings::default()).find_better(place, &self.instances, taken)?)
    }

    /// Applies to this question only: in an evaluation, an instance found for one question must not
    /// change the answer to another.
    async fn keep_found(
        self: &Arc<Self>,
        found: Instance,
    ) -> Result<(Arc<Self>, InstanceId), QuestionError> {
        let id = found.id;
        let instances: Vec<Instance> = self.instances.iter().cloned().chain([found]).collect();
        Ok((self.album.scene(instances.into()), id))
    }

    /// Runs at once, on the thread that drives the question.
    async fn compute<T: Send + 'static>(
        self: &Arc<Self>,
        work: impl FnOnce(&Self) -> Result<T, QuestionError> + Send + 'static,
    ) -> Result<T, QuestionError> {
        work(self)
    }
}
