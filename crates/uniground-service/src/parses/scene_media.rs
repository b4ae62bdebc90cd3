//! Media of a parse for viewers: points, a thumbnail, photographs and their camera poses.

use super::files::draft_points;
use super::{FileDownload, ParseFile, photograph, read_frames, read_photograph, view};
use crate::answers::StoredScene;
use crate::error::Error;
use crate::parses::ParseCache;
use crate::{EvidenceFile, ParsedScenes, SceneLookup};
use bytes::Bytes;
use camino::Utf8PathBuf;
use std::fs::File;
use std::io::BufReader;
use std::sync::Arc;
use tokio::fs::try_exists;
use tokio::sync::Mutex;
use tokio::task::spawn_blocking;
use uniground_geometry::scene::{
    FrameRef, Instance, InstanceId, Intrinsics, Owners, read_instance_of_point, write_even_points,
};
use uniground_grounding::pipeline::SceneSource;
use uniground_parsing::evidence::{self, Picture};
use uniground_parsing::{ParseError, report_pictures};
use uniground_storage::{Blobs, PinnedPath, Scratch};
use uniground_types::scene::{FrameList, FrameView};

/// Returns points, pictures and photographs of a parsed scene.
#[derive(Clone)]
pub struct MediaService {
    pub(crate) scene_lookup: Arc<SceneLookup>,
    pub(crate) parsed_scenes: Arc<ParsedScenes>,
    pub(crate) parse_cache: Arc<ParseCache>,
    pub(crate) drawing_lock: Arc<Mutex<()>>,
    pub(crate) blobs: Blobs,
}

impl MediaService {
    /// Returns the cloud of a scene's current parse. Every prefix of it is an even sample.
    ///
    /// # Errors
    /// [`Error::SceneNotFound`], [`Error::SceneNotReady`], [`Error::ParseDamaged`].
    pub async fn points(&self, scene_id: &str) -> Result<FileDownload, Error> {
        let (_, parse_id) = self.scene_lookup.ready_scene(scene_id).await?;
        if let Some(link) = self.parsed_scenes.public_link(&parse_id, ParseFile::Points).await? {
            return Ok(FileDownload::Redirect(link));
        }
        let (scene, file) = self.pin_parse_file(scene_id, ParseFile::Points).await?;
        if let Some(file) = file {
            return Ok(FileDownload::Local(file));
        }
        let made = self.draw(scene, |service, scene| {
            if let Some(made) = service.parse_cache.points.get(&scene.parse.id) {
                return Ok(made);
            }
            let made = Arc::new(scene.write_even_sample()?);
            service.parse_cache.points.put(scene.parse.id.clone(), made.clone(), 1);
            Ok(made)
        });
        Ok(FileDownload::Local(made.await?.path().join(POINTS).into()))
    }

    /// Returns the cloud of a scene's current parse, or of its import while the first parse runs.
    /// No point of a draft belongs to an instance. A draft is on the machine that parses.
    ///
    /// # Errors
    /// Those of [`points`](Self::points).
    pub async fn points_or_draft(&self, scene_id: &str) -> Result<FileDownload, Error> {
        let not_ready = match self.points(scene_id).await {
            Err(error @ Error::SceneNotReady { .. }) => error,
            points => return points,
        };
        let scene = self.scene_lookup.scene_row(scene_id).await?;
        let draft = draft_points(&self.blobs.checkpoints(&scene.content_hash));
        match try_exists(&draft).await? {
            true => Ok(FileDownload::Local(draft.into())),
            false => Err(not_ready),
        }
    }

    /// Returns a small picture of the room of a scene's current parse.
    ///
    /// # Errors
    /// Those of [`points`](Self::points).
    pub async fn thumbnail(&self, scene_id: &str) -> Result<EvidenceFile, Error> {
        let (scene, file) = self.pin_parse_file(scene_id, ParseFile::Thumbnail).await?;
        if let Some(file) = file {
            return Ok(EvidenceFile::Stored(file));
        }
        let drawn = self.draw(scene, |_, scene| {
            Ok(report_pictures::thumbnail(&*scene.render_scene()?, &scene.extent()))
        });
        drawn.await.map(|jpeg| EvidenceFile::Drawn(jpeg.into()))
    }

    /// Runs a computation for a viewer, one at a time. Questions have permits of their own and go
    /// first.
    pub(crate) async fn draw<T: Send + 'static>(
        &self,
        scene: Arc<StoredScene>,
        work: impl FnOnce(&Self, &StoredScene) -> Result<T, Error> + Send + 'static,
    ) -> Result<T, Error> {
        let drawing_lock = self.drawing_lock.clone().lock_owned().await;
        let service = self.clone();
        let done = spawn_blocking(move || {
            let _drawing_lock = drawing_lock;
            work(&service, &scene)
        });
        match done.await? {
            Err(error) => Err(self.parsed_scenes.retire_if_damaged(error).await),
            done => done,
        }
    }

    /// Returns a file of a scene's current parse. Returns `None` for parses of versions that did
    /// not store it.
    async fn pin_parse_file(
        &self,
        scene_id: &str,
        file: ParseFile,
    ) -> Result<(Arc<StoredScene>, Option<PinnedPath>), Error> {
        let (_, parse_id) = self.scene_lookup.ready_scene(scene_id).await?;
        let scene = StoredScene::new(
            self.parsed_scenes.clone(),
            self.parsed_scenes.loaded_parse(&parse_id).await?,
        );
        let file = self.pin_if_published(&scene, file.path_in(&scene.folder())).await?;
        Ok((scene, file))
    }

    async fn pin_if_published(
        &self,
        scene: &StoredScene,
        path: Utf8PathBuf,
    ) -> Result<Option<PinnedPath>, Error> {
        let (blobs, folder, file) = (self.blobs.clone(), scene.folder(), path.clone());
        let is_kept = spawn_blocking(move || blobs.has_file(&folder, &file)).await??;
        Ok(if is_kept {
            Some(self.parsed_scenes.check_and_pin_file(&scene.parse.id, path).await?)
        } else {
            None
        })
    }

    /// Returns a picture of an instance in one of its views. Returns `None` and logs a warning if
    /// the photograph cannot be read.
    ///
    /// # Errors
    /// [`Error::ParseDamaged`].
    pub(crate) async fn view_of_instance(
        &self,
        scene: Arc<StoredScene>,
        instance: &Instance,
        at: usize,
        picture: Picture,
    ) -> Result<Option<EvidenceFile>, Error> {
        let file = view(&scene.folder(), instance.id, at, picture);
        if let Some(file) = self.pin_if_published(&scene, file.clone()).await? {
            return Ok(Some(EvidenceFile::Stored(file)));
        }
        // Pictures of merged instances are not cached: a merge may be undone, and its id may be
        // given to another instance.
        let stays = !instance.is_added_after_parse();
        if let Some(drawn) = self.parse_cache.drawn.get(file.as_str()).filter(|_| stays) {
            return Ok(Some(EvidenceFile::Drawn(drawn)));
        }
        let (seen, known_as) = (instance.views[at].clone(), file.clone());
        let drawn = self.draw(scene, move |service, scene| {
            // Another caller may have drawn the same picture while this one waited.
            if let Some(drawn) = service.parse_cache.drawn.get(known_as.as_str()).filter(|_| stays)
            {
                return Ok(Some(drawn));
            }
            let (parse, folder) = (&scene.parse, scene.folder());
            let kept = photograph(&folder, seen.frame);
            let _kept = match service.blobs.has_file(&folder, &kept)? {
                true => Some(scene.pin_checked_file(&kept)?),
                false => None,
            };
            let photograph = read_photograph(&service.blobs, &folder, &parse.content, seen.frame);
            Ok(photograph
                .map(|photograph| Bytes::from(evidence::draw_picture(&photograph, &seen, picture))))
        });
        let Some(drawn) = drawn.await? else { return Ok(None) };
        if stays {
            self.parse_cache.drawn.put(file.into(), drawn.clone(), drawn.len());
        }
        Ok(Some(EvidenceFile::Drawn(drawn)))
    }

    /// Returns the frames of a scene's current parse.
    ///
    /// # Errors
    /// [`Error::SceneNotFound`], [`Error::SceneNotReady`].
    pub async fn frames(&self, scene_id: &str) -> Result<FrameList, Error> {
        let (_, parse_id) = self.scene_lookup.ready_scene(scene_id).await?;
        let (folder, content) = (
            self.blobs.parse(&parse_id),
            self.parsed_scenes.loaded_parse(&parse_id).await?.content.clone(),
        );
        let blobs = self.blobs.clone();
        let frames = spawn_blocking(move || read_frames(&blobs, &folder, &content)).await??;
        let view = |frame: FrameRef| {
            let Intrinsics { width, height, fx, fy, cx, cy } = frame.color_intrinsics;
            let pose = frame.camera_to_world.to_homogeneous();
            let camera_to_world =
                std::array::from_fn(|row| std::array::from_fn(|column| pose[(row, column)]));
            FrameView { index: frame.index, width, height, fx, fy, cx, cy, camera_to_world }
        };
        Ok(FrameList { frames: frames.unwrap_or_default().into_iter().map(view).collect() })
    }

    /// Returns a photograph of a scene's scan by its index in the scan's own list, as JPEG or PNG
    /// as it was taken, otherwise as JPEG. On request, the instances that it shows are drawn in.
    ///
    /// # Errors
    /// [`Error::FrameNotFound`] and those of [`points`](Self::points).
    pub async fn frame_picture(
        &self,
        scene_id: &str,
        index: u32,
        with_instances: bool,
    ) -> Result<EvidenceFile, Error> {
        let (_, parse_id) = self.scene_lookup.ready_scene(scene_id).await?;
        let scene = StoredScene::new(
            self.parsed_scenes.clone(),
            self.parsed_scenes.loaded_parse(&parse_id).await?,
        );
        let (folder, content) = (scene.folder(), scene.parse.content.clone());
        let blobs = self.blobs.clone();
        let found = spawn_blocking(move || {
            let frames = read_frames(&blobs, &folder, &content)?.unwrap_or_default();
            let frame = frames
                .into_iter()
                .find(|frame| frame.index.0 == index)
                .ok_or(Error::FrameNotFound { index })?;
            let color = blobs.pin_file(&content, &frame.color)?;
            Ok::<_, Error>((frame, color))
        });
        let (frame, color) = found.await??;
        if !with_instances {
            return Ok(EvidenceFile::Stored(color));
        }
        let drawn = self.draw(scene, move |_, scene| {
            let _color = color;
            scene.photograph_with_instances(&frame)
        });
        drawn.await.map(|jpeg| EvidenceFile::Drawn(jpeg.into()))
    }
}

const POINTS: &str = "points.bin";

impl StoredScene {
    /// Returns the instance of each point, as stage 1 found it.
    pub fn instance_of_point(&self) -> Result<Vec<InstanceId>, Error> {
        let file = ParseFile::Instances.path_in(&self.folder());
        let file = self.pin_checked_file(&file)?;
        Ok(read_instance_of_point(BufReader::new(File::open(&file)?))?)
    }

    /// Computes the file of evenly sampled points for a parse of an earlier version without one.
    fn write_even_sample(&self) -> Result<Scratch, Error> {
        let (render_scene, of_point) = (self.render_scene()?, self.instance_of_point()?);
        let scratch = self.scratch()?;
        write_even_points(
            &render_scene.cloud,
            &of_point,
            File::create(scratch.path().join(POINTS))?,
        )?;
        Ok(scratch)
    }

    fn photograph_with_instances(&self, frame: &FrameRef) -> Result<Vec<u8>, Error> {
        let (render_scene, of_point) = (self.render_scene()?, self.instance_of_point()?);
        let owners = Owners::new(&of_point, self.instances());
        let shown_as = |point: usize| match of_point.get(point) {
            Some(found) => owners.owner_of(*found, &render_scene.cloud.positions[point]),
            None => InstanceId::default(),
        };
        let drawn = report_pictures::photograph_with_instances(
            frame,
            &render_scene.cloud,
            self.instances(),
            shown_as,
        );
        drawn.map_err(|error| ParseError::from(error).into())
    }
}
