//! Adds frames to a scene: receives them, checks them against it and stores both as a new content.

use super::uploads::ReceivedArchive;
use crate::answers::CoordinateFrameView;
use crate::error::Error;
use crate::parses::ParseFile;
use crate::{
    Caller, Capacity, ImportService, Limits, MAX_UPLOADS, ParseJob, ParseService, ParsedScenes,
    SceneLookup, ServiceLocks,
};
use bytes::Bytes;
use camino::{Utf8Path, Utf8PathBuf};
use futures::Stream;
use sha2::{Digest, Sha256};
use std::fs;
use std::sync::Arc;
use tokio::sync::{Mutex, Semaphore};
use tokio::task::spawn_blocking;
use uniground_geometry::scene::SourceToScene;
use uniground_ingest::{GrownScan, ScanPart, part_folder};
use uniground_isolation::{ScanReader, Task};
use uniground_jobs::{Job, Jobs};
use uniground_storage::{
    Blobs, GrowthOutcome, ParseRepository, SceneGrowth, SceneRepository, SceneRow,
};
use uniground_types::placement::{FrameChoice, SceneToFrame};
use uniground_types::scenes::Scene;

/// Metadata of frames to add. The bytes follow separately.
pub struct NewFrames {
    /// The name of the uploaded file, if known.
    pub file_name: Option<String>,
    /// The coordinate frame of their poses.
    pub world: FrameChoice,
    pub idempotency_key: Option<String>,
    /// The size in bytes that the client announced.
    pub announced_bytes: u64,
}

/// How often a scene may grow. Every parse processes all parts.
const MOST_PARTS: usize = 200;

/// Adds frames to a scene.
#[derive(Clone)]
pub struct GrowthService {
    pub(crate) scene_repository: SceneRepository,
    pub(crate) blobs: Blobs,
    pub(crate) parse_repository: ParseRepository,
    pub(crate) upload_permits: Arc<Semaphore>,
    pub(crate) scene_lookup: Arc<SceneLookup>,
    pub(crate) parsed_scenes: Arc<ParsedScenes>,
    pub(crate) capacity: Arc<Capacity>,
    pub(crate) jobs: Jobs,
    pub(crate) import_service: Arc<ImportService>,
    pub(crate) growth_lock: Arc<Mutex<()>>,
    pub(crate) service_locks: Arc<ServiceLocks>,
    pub(crate) parse_service: Arc<ParseService>,
    pub(crate) reader: ScanReader,
    pub(crate) limits: Limits,
}

impl GrowthService {
    /// Adds frames to a scene and starts parsing what they change. Until the parse is done,
    /// questions are answered from the current parse. Instances that stay keep their ids.
    ///
    /// # Errors
    /// [`Error`] if the upload is invalid or the frames do not lie in the scene;
    /// [`Error::SceneNotReady`], [`Error::NoMap`], [`Error::GrownTooOften`].
    pub async fn add_frames<E>(
        &self,
        scene_id: &str,
        new: NewFrames,
        body: impl Stream<Item = Result<Bytes, E>> + Unpin,
        caller: &Caller,
    ) -> Result<(Scene, Job), Error> {
        let place = self.upload_permits.clone().try_acquire_owned();
        let place = place.map_err(|_| Error::TooMany { what: "uploads", most: MAX_UPLOADS })?;
        let NewFrames { file_name, world, idempotency_key, announced_bytes } = new;
        let (scene, parse_id) = self.scene_lookup.ready_scene(scene_id).await?;
        let parse = self.parsed_scenes.loaded_parse(&parse_id).await?;
        let to_scene = match CoordinateFrameView::resolve(world, &scene, parse.source_to_scene)? {
            // The poses are in the coordinates of the uploaded files. Every parse of the scan
            // determines their transform anew.
            Some(_) if world == FrameChoice::Source => None,
            Some(frame) => Some(inverse(&frame.from_scene)),
            None => Some(SourceToScene::IDENTITY),
        };
        self.capacity.check_disk(announced_bytes)?;
        self.jobs.check_queue_capacity::<ParseJob>(caller.key_id()).await?;
        let received =
            self.import_service.receive(body, file_name.as_deref().unwrap_or_default()).await?;
        drop(place);
        let key = idempotency_key.map(|key| caller.qualify_name(key));
        let part = ScanPart { hash: received.hash.clone(), to_scene };
        let request = hash_json(&("frames", scene_id, &part))?;
        // One at a time: each growth starts from the content that the previous one stored.
        let _lock = self.growth_lock.lock().await;
        if let Some(key) = &key
            && let Some((scene, before)) =
                self.scene_repository.scene_of_idempotency_key(key).await?
        {
            return match before.is_some_and(|before| before == request) {
                true => self.growth_under_key(scene).await,
                false => Err(Error::IdempotencyKeyReused),
            };
        }
        let (scene, _) = self.scene_lookup.ready_scene(scene_id).await?;
        let from_content = scene.content_hash.clone();
        let to_scene = parse_to_scene(part.to_scene, parse.source_to_scene);
        let cloud = self
            .parsed_scenes
            .check_and_pin_file(&parse_id, ParseFile::Cloud.path_in(&self.blobs.parse(&parse_id)))
            .await?;
        let bytes = received.bytes;
        let laid = self
            .publish_combined_content(scene, received, part, |folder| Task::CheckFit {
                folder,
                cloud: cloud.to_path_buf(),
                to_scene,
            })
            .await?;
        let references = self.service_locks.lock_content_references().await?;
        let settings = self
            .parse_repository
            .parse(&parse_id)
            .await?
            .map(|parse| parse.record().settings)
            .unwrap_or_default();
        let wanted =
            self.parse_service.prepare_parse(scene_id, &laid, true, &settings, caller).await?;
        let grow = self.scene_repository.grow_scene(SceneGrowth {
            scene_id,
            from_content: &from_content,
            content_hash: &laid,
            content_bytes: bytes,
            key: key.as_deref().map(|key| (key, request.as_str())),
            job: wanted.job.row(),
        });
        let grew = wanted.job.enqueue(&self.jobs, grow).await?;
        drop(references);
        match grew {
            GrowthOutcome::Grown(row, job) => {
                Ok((self.scene_lookup.to_scene(row).await?, self.jobs.to_job(*job)))
            }
            GrowthOutcome::AlreadyGrown(row) => self.growth_under_key(row).await,
            GrowthOutcome::KeyReused => Err(Error::IdempotencyKeyReused),
            GrowthOutcome::Overtaken => Err(Error::GrowthOvertaken { id: scene_id.to_owned() }),
        }
    }

    async fn growth_under_key(&self, scene: SceneRow) -> Result<(Scene, Job), Error> {
        let not_ready = || Error::SceneNotReady { id: scene.id.clone(), job_id: None };
        let job = self.scene_lookup.current_job(&scene).await?.ok_or_else(not_ready)?;
        Ok((self.scene_lookup.to_scene(scene).await?, job))
    }

    /// Publishes the scene's content and the received part together as one new content, if both
    /// checks pass. Returns the hash of the new content.
    async fn publish_combined_content(
        &self,
        scene: SceneRow,
        received: ReceivedArchive,
        part: ScanPart,
        fits: impl FnOnce(Utf8PathBuf) -> Task,
    ) -> Result<String, Error> {
        let blobs = self.blobs.clone();
        let content_hash = scene.content_hash.clone();
        let prepared = spawn_blocking(move || {
            let content = blobs.pin_folder(&blobs.content(&content_hash))?;
            let so_far = GrownScan::read(&content)?;
            let parts = so_far.as_ref().map_or(1, |grown| grown.parts.len());
            if parts > MOST_PARTS {
                return Err(Error::GrownTooOften { most: MOST_PARTS });
            }
            let scratch = blobs.scratch()?;
            let folder = part_folder(scratch.path(), parts);
            fs::create_dir_all(&folder)?;
            Ok((content, so_far, scratch, folder))
        });
        let (content, so_far, scratch, folder) = prepared.await??;
        self.reader.check(received.unpack_task(&folder, &self.limits.unpack)).await?;
        self.reader.check(fits(folder)).await?;
        let blobs = self.blobs.clone();
        let publish = move || {
            let mut grown =
                so_far.clone().unwrap_or_else(|| GrownScan::from_upload(&scene.content_hash));
            // A scan that has grown before already has its parts.
            let below = if so_far.is_some() {
                Utf8PathBuf::new()
            } else {
                part_folder(Utf8Path::new(""), 0)
            };
            let mut sums = blobs.link_files(&content, &scratch, &below)?;
            grown.parts.push(part);
            let list = scratch.path().join(uniground_ingest::GROWN);
            // This file is a hard link to the previous list. The previous list must never change.
            if so_far.is_some() {
                fs::remove_file(&list)?;
                sums.remove(Utf8Path::new(uniground_ingest::GROWN));
            }
            grown.write(scratch.path())?;
            // The content of a grown scene belongs to that scene alone: its instance ids depend on
            // its history. The scene's id is part of the hash for this reason.
            let hash = hash_json(&(&scene.id, &scene.content_hash, &grown))?;
            blobs.publish_with_checksums(scratch, &blobs.content(&hash), &sums)?;
            blobs.copy_checkpoints(&scene.content_hash, &hash)?;
            Ok(hash)
        };
        spawn_blocking(publish).await?
    }
}

fn parse_to_scene(
    requested: Option<SourceToScene>,
    source: Option<SourceToScene>,
) -> SourceToScene {
    requested.or(source).unwrap_or(SourceToScene::IDENTITY)
}

/// Returns the transform from another coordinate frame to the scene's.
fn inverse(from_scene: &SceneToFrame) -> SourceToScene {
    let origin = from_scene.invert([0.0; 3]);
    // The direction in the scene of each unit axis of the other frame.
    let axis = |i: usize| {
        let tip = from_scene.invert(std::array::from_fn(|k| f64::from(u8::from(k == i))));
        std::array::from_fn::<f64, 3, _>(|row| (tip[row] - origin[row]) * from_scene.scale)
    };
    let axes = [axis(0), axis(1), axis(2)];
    let rotation = std::array::from_fn(|row| std::array::from_fn(|column| axes[column][row]));
    SourceToScene { rotation, translation_m: origin, metres_per_unit: 1.0 / from_scene.scale }
}

fn hash_json(what: &impl serde::Serialize) -> Result<String, Error> {
    let digest = Sha256::digest(serde_json::to_vec(what)?);
    Ok(digest.iter().map(|byte| format!("{byte:02x}")).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use uniground_types::placement::SceneToMap;

    #[test]
    fn inverse_transforms_map_coordinates_to_the_scene() {
        let s = std::f64::consts::FRAC_1_SQRT_2;
        let map = SceneToFrame::scene_to_map(&SceneToMap {
            rotation: [0.0, 0.0, s, s],
            translation_m: [100.0, -40.0, 0.5],
        });
        let back = inverse(&map);
        for point in [[0.0, 0.0, 0.0], [1.0, 2.0, 3.0], [-4.0, 0.5, 1.0]] {
            let there = back.apply(map.apply(point));
            assert!(
                there.iter().zip(point).all(|(a, b)| (a - b).abs() < 1e-9),
                "{there:?} for {point:?}"
            );
        }
    }
}
