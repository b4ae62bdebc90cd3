//! A stored parse as the question pipeline's source of instances and pictures.

use crate::ParsedScenes;
use crate::error::Error;
use crate::parses::{LoadedParse, ParseFile, photograph, read_frames, read_photograph, view};
use camino::{Utf8Path, Utf8PathBuf};
use image::RgbImage;
use std::collections::BTreeMap;
use std::fs;
use std::sync::Arc;
use uniground_geometry::boxes::Aabb;
use uniground_geometry::lru_cache::LruCache;
use uniground_geometry::scene::{
    Embeddings, FrameEmbeddings, FrameIndex, FrameRef, Instance, InstanceId, RoomCoverage, View,
};
use uniground_grounding::approach::Occupancy;
use uniground_grounding::pipeline::SceneSource;
use uniground_grounding::{NameIndex, PictureCache};
use uniground_ingest::IngestError;
use uniground_models::neural::{DualEncoder, Role};
use uniground_models::{attributes, with_causes};
use uniground_parsing::ParseError;
use uniground_parsing::evidence::Picture;
use uniground_parsing::masks::is_builtin;
use uniground_parsing::pointed::{PhotographPoint, PointedObjectFinder};
use uniground_render::{RenderScene, Shot};
use uniground_storage::{Blobs, PinnedPath, Scratch};
use uniground_types::settings::ParsingSettings;

/// The maximum number of instances that questions may add to a parse.
const MAX_POINTED_INSTANCES: usize = 500;

/// A loaded parse, with the service that stores its files and rows.
pub struct StoredScene {
    scenes: Arc<ParsedScenes>,
    pub parse: Arc<LoadedParse>,
}

impl StoredScene {
    pub fn new(scenes: Arc<ParsedScenes>, parse: Arc<LoadedParse>) -> Arc<Self> {
        Arc::new(Self { scenes, parse })
    }

    /// Pins a file of the parse after checking that it is as it was written.
    pub fn pin_checked_file(&self, file: &Utf8Path) -> Result<PinnedPath, Error> {
        self.scenes.check_file(&self.parse.id, file)
    }

    /// Creates a temporary folder. It is deleted when its handle is dropped.
    pub fn scratch(&self) -> Result<Scratch, Error> {
        Ok(self.scenes.blobs.scratch()?)
    }

    /// Returns the cached occupancy of recently used parses.
    pub fn known_occupancies(&self) -> &LruCache<Arc<Occupancy>> {
        &self.scenes.parse_cache.occupancies
    }

    pub fn blobs(&self) -> &Blobs {
        &self.scenes.blobs
    }

    pub fn folder(&self) -> Utf8PathBuf {
        self.scenes.blobs.parse(&self.parse.id)
    }

    /// Looks an object up in the scan's photographs, with the masks of the parse. Returns `None`
    /// without photographs.
    fn look_up(
        &self,
        find: impl FnOnce(&PointedObjectFinder) -> Result<Option<Instance>, ParseError>,
    ) -> Result<Option<Instance>, Error> {
        let blobs = &self.scenes.blobs;
        let Some(frames) = read_frames(blobs, &self.folder(), &self.parse.content)? else {
            return Ok(None);
        };
        // Pins the whole scan, because any of its frames may show the place.
        let _scan = blobs.pin_folder(&self.parse.content)?;
        let (render_scene, settings) = (self.render_scene()?, ParsingSettings::default());
        // Uses the masks of the parse: the same model, or the built-in ones.
        let models = &self.scenes.models;
        let segmenter = models
            .segmenters
            .first()
            .filter(|_| models.label(Role::Masks).as_deref() == Some(&*self.parse.masks));
        let pointing = PointedObjectFinder {
            cloud: &render_scene.cloud,
            frames: &frames,
            segmenter: segmenter.map(|s| &**s),
            settings: &settings,
        };
        match find(&pointing) {
            Ok(found) => Ok(found),
            // An answer does not need the scan's own pictures.
            Err(ParseError::Frame(error)) => {
                tracing::warn!(
                    parse_id = self.parse.id,
                    error = &error as &dyn std::error::Error,
                    "photograph could not be segmented"
                );
                Ok(None)
            }
            Err(error) => Err(error.into()),
        }
    }
}

impl SceneSource for StoredScene {
    type Error = Error;

    fn instances(&self) -> &[Instance] {
        &self.parse.instances
    }

    fn name_index(&self) -> &NameIndex {
        &self.parse.names
    }

    fn extent(&self) -> Aabb {
        self.parse.extent
    }

    fn has_builtin_masks(&self) -> bool {
        is_builtin(&self.parse.masks)
    }

    fn encoder_name(&self) -> String {
        self.parse.encoder.clone()
    }

    fn embeddings(&self) -> Result<Option<(&DualEncoder, &Embeddings)>, Error> {
        let Some(embeddings) = &self.parse.embeddings else { return Ok(None) };
        let models = &self.scenes.models;
        let here = models.label(Role::Encoder).unwrap_or_else(|| attributes::NAME.into());
        match &models.encoder {
            Some(encoder) if here == self.parse.encoder => Ok(Some((encoder, embeddings))),
            _ => Err(Error::EncoderChanged { parsed_with: self.parse.encoder.clone(), here }),
        }
    }

    fn frame_embeddings(&self) -> Option<&FrameEmbeddings> {
        self.parse.frame_embeddings.as_ref()
    }

    fn photograph(&self, frame: FrameIndex) -> Option<RgbImage> {
        read_photograph(&self.scenes.blobs, &self.folder(), &self.parse.content, frame)
    }

    fn frames(&self) -> Result<Vec<FrameRef>, Error> {
        let frames = read_frames(&self.scenes.blobs, &self.folder(), &self.parse.content)?;
        Ok(frames.unwrap_or_default())
    }

    fn coverage(&self) -> Option<&RoomCoverage> {
        self.parse.observation.coverage.as_ref()
    }

    fn render_scene(&self) -> Result<Arc<RenderScene>, Error> {
        let known = &self.scenes.parse_cache.render_scenes;
        if let Some(render_scene) = known.get(&self.parse.id) {
            return Ok(render_scene);
        }
        let file = ParseFile::Cloud.path_in(&self.folder());
        let file = self.pin_checked_file(&file)?;
        // The caller is not at fault: the parse is damaged.
        let damaged = |error| match error {
            IngestError::Io { .. } => Error::Ingest(error),
            error => {
                Error::ParseDamaged { parse_id: self.parse.id.clone(), what: with_causes(&error) }
            }
        };
        let cloud = uniground_ingest::read_cloud(&file).map_err(damaged)?;
        let render_scene = Arc::new(RenderScene::with_building(cloud, &self.parse.instances));
        known.put(self.parse.id.clone(), render_scene.clone(), render_scene.cloud.len());
        Ok(render_scene)
    }

    fn photographs(&self, instance: &Instance, most: usize) -> Vec<Shot> {
        if instance.is_added_after_parse() {
            let shots = instance
                .views
                .iter()
                .filter_map(|view| Some(Shot::from_view(self.photograph(view.frame)?, view)));
            return shots.take(most).collect();
        }
        let folder = self.folder();
        let shots =
            instance.views.iter().enumerate().filter_map(|(k, view)| {
                read_shot(&self.scenes.blobs, &folder, instance.id, k, view)
            });
        shots.take(most).collect()
    }

    fn pictures(&self) -> (&PictureCache, &str) {
        (&self.scenes.picture_cache, &self.parse.id)
    }

    async fn names(&self) -> Result<BTreeMap<u32, String>, Error> {
        let mut names = self.scenes.names_of(&self.parse.id).await?;
        names.extend(self.parse.renamed.clone());
        Ok(names)
    }

    async fn keep_names(&self, names: &BTreeMap<u32, String>) -> Result<(), Error> {
        // The names came with an answer that was paid for. That answer is returned even if the
        // names cannot be stored.
        if let Err(error) = self.scenes.store_names(&self.parse.id, names).await {
            tracing::warn!(
                parse_id = self.parse.id,
                error = &error as &dyn std::error::Error,
                "names given by the model could not be stored"
            );
        }
        Ok(())
    }

    fn cut_out(
        &self,
        place: PhotographPoint,
        is_not: &[InstanceId],
    ) -> Result<Option<Instance>, Error> {
        self.look_up(|finder| finder.find_at(place, &self.parse.instances, is_not))
    }

    fn find_better(
        &self,
        place: PhotographPoint,
        taken: InstanceId,
    ) -> Result<Option<Instance>, Error> {
        self.look_up(|finder| finder.find_better(place, &self.parse.instances, taken))
    }

    async fn keep_found(
        self: &Arc<Self>,
        found: Instance,
    ) -> Result<(Arc<Self>, InstanceId), Error> {
        // In a growing scene, the instance is stored before the next parse continues from this one,
        // or not at all. Otherwise another instance could get the same id.
        let _lock = self.scenes.service_locks.lock_parse_data(&self.parse.id).await?;
        let Some(id) = self
            .scenes
            .parse_repository
            .insert_pointed_instance(&self.parse.id, &found, MAX_POINTED_INSTANCES)
            .await?
        else {
            // The instance is used for this question only.
            let (mut parse, id) = (
                LoadedParse::clone(&self.parse),
                InstanceId(self.parse.instances.len() as u32 + 1),
            );
            parse.instances.push(Instance { id, ..found });
            return Ok((Self::new(self.scenes.clone(), Arc::new(parse)), id));
        };
        Ok((Self::new(self.scenes.clone(), self.scenes.loaded_parse(&self.parse.id).await?), id))
    }

    async fn compute<T: Send + 'static>(
        self: &Arc<Self>,
        work: impl FnOnce(&Self) -> Result<T, Error> + Send + 'static,
    ) -> Result<T, Error> {
        let source = self.clone();
        match self.scenes.question_permits.compute(move || work(&source)).await {
            Err(error) => Err(self.scenes.retire_if_damaged(error).await),
            done => done,
        }
    }
}

/// Reads a stored view. Returns `None` and logs a warning if it cannot be read. Parses of versions
/// that stored no masks have drawn pictures only.
fn read_shot(
    blobs: &Blobs,
    parse: &Utf8Path,
    id: InstanceId,
    at: usize,
    of: &View,
) -> Option<Shot> {
    let read = |file: Utf8PathBuf| {
        let decoded = blobs
            .pin_file(parse, &file)
            .and_then(fs::read)
            .map_err(|e| e.to_string())
            .and_then(|bytes| image::load_from_memory(&bytes).map_err(|e| e.to_string()));
        decoded
            .map(image::DynamicImage::into_rgb8)
            .inspect_err(|error| tracing::warn!(%file, error, "evidence picture could not be read"))
            .ok()
    };
    if of.mask.is_some() {
        return Some(Shot::from_view(read(photograph(parse, of.frame))?, of));
    }
    let drawn = |picture| read(view(parse, id, at, picture));
    Some(Shot::new(drawn(Picture::Crop)?, drawn(Picture::Frame)?, of.box_px))
}
