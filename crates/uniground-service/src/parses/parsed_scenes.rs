//! Loads finished parses, keeps them in memory and checks their files.

use crate::error::Error;
use crate::parses::job::{ParseJob, ParseStep, Payload};
use crate::parses::{LoadedParse, ParseCache, ParseFile, corrected_names, files, settings_hash};
use crate::{QuestionPermits, ServiceLocks, Vlm};
use camino::{Utf8Path, Utf8PathBuf};
use std::collections::BTreeMap;
use std::sync::Arc;
use std::{fs, io};
use tokio::task::spawn_blocking;
use uniground_geometry::boxes::Aabb;
use uniground_geometry::scene::{Instance, correct};
use uniground_grounding::vlm::naming;
use uniground_grounding::{NameIndex, PictureCache};
use uniground_jobs::{JobRequest, Jobs};
use uniground_models::neural::Models;
use uniground_parsing::scan::{model_names, select_models};
use uniground_storage::{
    Blobs, CheckDepth, CorrectionRepository, DamagedFile, NameRepository, ParseRecord,
    ParseRepository, PinnedPath, SceneRepository,
};
use uniground_types::settings::{ParseModels, ParseSettings};

/// Loads finished parses, keeps them in memory and checks their files.
#[derive(Clone)]
pub struct ParsedScenes {
    pub(crate) blobs: Blobs,
    pub(crate) name_repository: NameRepository,
    pub(crate) vlm: Option<Arc<Vlm>>,
    pub(crate) parse_repository: ParseRepository,
    pub(crate) models: Models,
    pub(crate) scene_repository: SceneRepository,
    pub(crate) jobs: Jobs,
    pub(crate) parse_cache: Arc<ParseCache>,
    pub(crate) correction_repository: CorrectionRepository,
    pub(crate) picture_cache: Arc<PictureCache>,
    pub(crate) service_locks: Arc<ServiceLocks>,
    pub(crate) question_permits: QuestionPermits,
}

impl ParsedScenes {
    /// Returns a link to a parse's file in the object store, if callers are sent there.
    pub(crate) async fn public_link(
        &self,
        parse_id: &str,
        file: ParseFile,
    ) -> Result<Option<String>, Error> {
        let (blobs, folder) = (self.blobs.clone(), self.blobs.parse(parse_id));
        Ok(spawn_blocking(move || blobs.link(&folder, &file.path_in(&folder))).await??)
    }

    /// Returns the parse of a content with these settings and the models they choose, if it exists
    /// with its files.
    pub(crate) async fn stored_parse(
        &self,
        content_hash: &str,
        settings: &ParseSettings,
    ) -> Result<Option<String>, Error> {
        let models = model_names(&select_models(settings.models, &self.models));
        self.stored_parse_by(content_hash, settings, &models).await
    }

    /// Returns the parse of a content with these settings and models, if it exists with its files.
    pub(crate) async fn stored_parse_by(
        &self,
        content_hash: &str,
        settings: &ParseSettings,
        models: &ParseModels,
    ) -> Result<Option<String>, Error> {
        let hash = settings_hash(settings, models)?;
        let Some(parse) = self.parse_repository.find_parse(content_hash, &hash).await? else {
            return Ok(None);
        };
        let wrong = self.check_parse_files(&parse.id, CheckDepth::Names).await?;
        if wrong.is_empty() {
            return Ok(Some(parse.id));
        }
        tracing::warn!(parse_id = parse.id, files = wrong.len(), "stored parse is incomplete");
        self.retire_parse(&parse.id).await?;
        Ok(None)
    }

    /// Starts a new parse for every scene that uses a parse whose files are lost or damaged. Until
    /// it is done, the scenes keep the damaged one.
    ///
    /// # Errors
    /// [`Error::Store`].
    pub async fn retire_parse(&self, parse_id: &str) -> Result<(), Error> {
        let settings =
            self.parse_repository.parse(parse_id).await?.map(|parse| parse.record().settings);
        for scene in self.parse_repository.retire_parse(parse_id).await? {
            let Some(settings) = &settings else { continue };
            let payload = Payload {
                scene_id: scene.id.clone(),
                settings: settings.clone(),
                step: ParseStep::Full,
            };
            let job = JobRequest::<ParseJob>::new(&payload, None)?.without_limit();
            let insert = self.scene_repository.insert_scene_job(&scene.id, job.row());
            if let Some(row) = self.jobs.enqueue(&job, insert).await? {
                tracing::info!(
                    parse_id,
                    scene_id = scene.id,
                    job_id = row.id,
                    "parsing a scene again"
                );
            }
        }
        Ok(())
    }

    /// Returns a file of a parse after checking that it is as it was written.
    ///
    /// # Errors
    /// [`Error::ParseDamaged`] if it is lost or damaged. A new parse is then started.
    pub(crate) async fn check_and_pin_file(
        &self,
        parse_id: &str,
        file: Utf8PathBuf,
    ) -> Result<PinnedPath, Error> {
        let (service, id) = (self.clone(), parse_id.to_owned());
        match spawn_blocking(move || service.check_file(&id, &file)).await? {
            Err(error) => Err(self.retire_if_damaged(error).await),
            checked => checked,
        }
    }

    /// Pins a file of a parse after checking that it is as it was written. A file that was checked
    /// once and has not changed since is not checked again. Blocks.
    pub(crate) fn check_file(&self, parse_id: &str, file: &Utf8Path) -> Result<PinnedPath, Error> {
        let damaged = |what: String| Error::ParseDamaged { parse_id: parse_id.to_owned(), what };
        let of = |error: io::Error| match error.kind() {
            io::ErrorKind::NotFound => {
                damaged(format!("{} is missing", file.file_name().unwrap_or_default()))
            }
            io::ErrorKind::InvalidData => damaged(error.to_string()),
            // A disk that fails for a moment has lost no data.
            _ => Error::Io(error),
        };
        let stamp = |file: &Utf8Path| fs::metadata(file).and_then(|m| Ok((m.len(), m.modified()?)));
        let folder = self.blobs.parse(parse_id);
        let kept = self.blobs.pin_file(&folder, file).map_err(of)?;
        let now = stamp(file).map_err(of)?;
        if self.parse_cache.sound.get(file.as_str()) == Some(now) {
            return Ok(kept);
        }
        let name = file.strip_prefix(&folder).unwrap_or(file);
        if let Some(DamagedFile { file, what }) =
            self.blobs.check_file(&folder, name).map_err(of)?
        {
            return Err(damaged(format!("{file}: {what}")));
        }
        self.parse_cache.sound.put(file.to_string(), stamp(file).map_err(of)?, 1);
        Ok(kept)
    }

    /// Starts a new parse if the error reports a damaged one. Returns the error.
    pub(crate) async fn retire_if_damaged(&self, error: Error) -> Error {
        match &error {
            Error::ParseDamaged { parse_id, .. } => {
                self.retire_parse(parse_id).await.err().unwrap_or(error)
            }
            _ => error,
        }
    }

    /// Returns a parse from memory, or loads it.
    pub(crate) async fn loaded_parse(&self, parse_id: &str) -> Result<Arc<LoadedParse>, Error> {
        // The number of changes is read before the parse. A change in between causes one more load.
        let changes = self.changes_of_parse(parse_id).await?;
        if let Some(parse) = self.parse_cache.get(parse_id, changes) {
            return Ok(parse);
        }
        let parse = Arc::new(self.read_parse(parse_id).await?);
        self.parse_cache.insert(&parse, changes);
        Ok(parse)
    }

    /// Returns a parse without caching it. Scanning many scenes must not evict the parses that
    /// questions use.
    pub(crate) async fn load_parse_uncached(
        &self,
        parse_id: &str,
    ) -> Result<Arc<LoadedParse>, Error> {
        match self.parse_cache.get(parse_id, self.changes_of_parse(parse_id).await?) {
            Some(parse) => Ok(parse),
            None => Ok(Arc::new(self.read_parse(parse_id).await?)),
        }
    }

    /// Returns how often the data of a parse has changed, by this process or another.
    pub(crate) async fn changes_of_parse(&self, parse_id: &str) -> Result<i64, Error> {
        let changes = self.parse_repository.changes_of_parse(parse_id).await?;
        changes.ok_or_else(|| Error::SceneNotFound { id: parse_id.into() })
    }

    pub(crate) async fn read_parse(&self, parse_id: &str) -> Result<LoadedParse, Error> {
        let gone = || Error::SceneNotFound { id: parse_id.into() };
        let row = self.parse_repository.parse(parse_id).await?.ok_or_else(gone)?;
        let ParseRecord { models, extent, import, .. } = row.record();
        let mut instances = self.parse_repository.instances(parse_id).await?;
        let named_by = self.apply_name_index(parse_id, &mut instances).await?;
        let corrections = self.correction_repository.corrections(parse_id).await?;
        let (blobs, folder) = (self.blobs.clone(), self.blobs.parse(parse_id));
        let (id, content, masks, encoder) =
            (parse_id.to_owned(), blobs.content(&row.content_hash), models.masks, models.encoder);
        let source_to_scene = import.and_then(|import| import.source_to_scene);
        // Names are parsed like questions, which takes CPU time.
        let read = move || {
            correct(&mut instances, &corrections);
            // Instances that were found later have no embedding. Merged instances get the joint
            // embedding of their members.
            let embeddings = files::read_embeddings(&blobs, &folder)?.map(|seen| {
                let seen = seen.pad_to(instances.len());
                let merged = instances
                    .iter()
                    .enumerate()
                    .filter(|(_, instance)| !instance.merged_from.is_empty());
                merged.fold(seen, |seen, (at, merged)| {
                    seen.with_mean_row(merged.merged_from.iter().map(|id| id.0 as usize - 1), at)
                })
            });
            let around = || {
                Aabb::around(&instances.iter().flat_map(|i| i.aabb.corners()).collect::<Vec<_>>())
            };
            Ok(LoadedParse {
                content,
                embeddings,
                frame_embeddings: files::read_frame_embeddings(&blobs, &folder)?,
                observation: files::read_observation(&blobs, &folder)?.of_corrected(&instances),
                renamed: corrected_names(&corrections),
                extent: extent
                    .or_else(around)
                    .ok_or_else(|| Error::SceneNotFound { id: id.clone() })?,
                source_to_scene,
                names: NameIndex::of(&instances),
                named_by,
                instances,
                masks,
                encoder,
                id,
            })
        };
        spawn_blocking(read).await?
    }

    /// Returns what is wrong with a parse's files.
    pub(crate) async fn check_parse_files(
        &self,
        parse_id: &str,
        closely: CheckDepth,
    ) -> Result<Vec<DamagedFile>, Error> {
        let (blobs, place) = (self.blobs.clone(), self.blobs.parse(parse_id));
        Ok(spawn_blocking(move || blobs.check_folder(&place, closely)).await??)
    }

    /// Returns the names that the configured model gave to the instances of a parse.
    pub(crate) async fn names_of(&self, parse_id: &str) -> Result<BTreeMap<u32, String>, Error> {
        match &self.vlm {
            Some(vlm) => Ok(self
                .name_repository
                .instance_names(parse_id, vlm.name(), naming::NAMING_VERSION)
                .await?),
            None => Ok(BTreeMap::new()),
        }
    }

    /// Sets the instances' names from the parse's index, if a model has named all of them. Returns
    /// that model and the version of the question.
    pub(crate) async fn apply_name_index(
        &self,
        parse_id: &str,
        instances: &mut [Instance],
    ) -> Result<Option<String>, Error> {
        let Some(model) = self.name_repository.name_index(parse_id, naming::NAMING_VERSION).await?
        else {
            return Ok(None);
        };
        let mut names =
            self.name_repository.instance_names(parse_id, &model, naming::NAMING_VERSION).await?;
        for instance in instances {
            // An instance that was found for a question has its own name.
            let own = instance.given_name.take();
            instance.given_name =
                names.remove(&instance.id.0).filter(|name| !name.is_empty()).or(own);
        }
        Ok(Some(naming::namer(&model)))
    }

    /// Stores names that the configured model gave. Existing names stay.
    pub(crate) async fn store_names(
        &self,
        parse_id: &str,
        names: &BTreeMap<u32, String>,
    ) -> Result<(), Error> {
        if let Some(vlm) = &self.vlm {
            self.name_repository
                .insert_instance_names(parse_id, vlm.name(), naming::NAMING_VERSION, names)
                .await?;
        }
        Ok(())
    }
}
