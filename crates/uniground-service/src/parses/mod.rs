//! Parses: the same content with the same settings is parsed once.

mod cache;
mod continuing;
mod files;
mod job;
mod looks;
mod report_files;
mod reports;

pub use cache::{LoadedParse, ParseCache};
pub use files::{ParseFile, photograph, read, read_frames, read_photograph, view};
pub use job::ParseJob;

use super::{Caller, Service};
use crate::error::Error;
use camino::{Utf8Path, Utf8PathBuf};
use job::Payload;
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::fs;
use std::io;
use std::sync::Arc;
use tokio::task::spawn_blocking;
use uniground_geometry::boxes::Aabb;
use uniground_geometry::scene::correct;
use uniground_grounding::NameIndex;
use uniground_jobs::{Job, JobKind};
use uniground_parsing::scan::{STAGE_1_VERSION, chosen, names_of};
use uniground_storage::{Damage, Kept, Look, NewJob, ParseRecord};
use uniground_types::corrections::{Change, Correction};
use uniground_types::settings::{ParseModels, ParsePreset, ParseSettings};

/// A file somebody asks for.
pub enum Download {
    Here(Kept),
    /// An address of the object store's that works for a while.
    There(String),
}

impl Service {
    /// The models a parse started now is made with, unless it asks for others.
    #[must_use]
    pub fn parse_models(&self) -> ParseModels {
        names_of(&self.models)
    }

    /// Parses a scene, in the background. A stored parse of the same content and settings is taken
    /// at once.
    ///
    /// # Errors
    /// [`Error`] when the scene is unknown or the queue is full.
    pub async fn start_parse(
        &self,
        scene_id: &str,
        settings: &ParseSettings,
        caller: &Caller,
    ) -> Result<Job, Error> {
        let scene = self.scene_row(scene_id).await?;
        // A stored parse stays until the scene refers to it.
        let _references = self.parse_references().await?;
        let wanted = self.wanted_parse(&scene.id, &scene.content_hash, settings, caller).await?;
        if wanted.stored.is_none() {
            self.check_disk(0)?;
            self.jobs.check_room::<ParseJob>(caller.key_id()).await?;
        }
        let row = self.store.scenes.insert_scene_job(&scene.id, wanted.job()).await?;
        let row = row.ok_or_else(|| Error::SceneNotFound { id: scene.id })?;
        Ok(self.jobs.recorded::<ParseJob>(row))
    }

    /// What a scene's parse comes to, before it is recorded.
    pub(super) async fn wanted_parse(
        &self,
        scene_id: &str,
        content_hash: &str,
        settings: &ParseSettings,
        caller: &Caller,
    ) -> Result<WantedParse, Error> {
        let payload = serde_json::to_string(&Payload {
            scene_id: scene_id.to_owned(),
            settings: settings.clone(),
        })?;
        let stored = self.stored_parse(content_hash, settings).await?;
        Ok(WantedParse { payload, key_id: caller.key_id().map(str::to_owned), stored })
    }

    /// Parses a scene again: a preset with single values replaced. How the files are read was
    /// settled at the upload and stays, unless said: what is up, how long their unit is,
    /// whether they are levelled.
    ///
    /// # Errors
    /// [`Error`] for settings that make no sense, an unknown scene or a full queue.
    pub async fn reparse(
        &self,
        scene_id: &str,
        preset: ParsePreset,
        overrides: Option<serde_json::Value>,
        caller: &Caller,
    ) -> Result<Job, Error> {
        let scene = self.scene_row(scene_id).await?;
        let told = match &scene.job_id {
            Some(job_id) => self.store.jobs.job(job_id).await?,
            None => None,
        };
        let overrides = match told {
            Some(job) => job::with_reading_of(&job.payload, overrides),
            None => overrides,
        };
        let settings = ParseSettings::from_request(preset, overrides)?;
        self.start_parse(scene_id, &settings, caller).await
    }

    /// A file of a scene's current parse.
    ///
    /// # Errors
    /// [`Error::SceneNotFound`], [`Error::SceneNotReady`]; [`Error::NoEmbeddings`] when no encoder
    /// has seen the scene.
    pub async fn parse_file(&self, scene_id: &str, file: ParseFile) -> Result<Download, Error> {
        let (_, parse_id) = self.ready_scene(scene_id).await?;
        if file == ParseFile::Embeddings && self.loaded_parse(&parse_id).await?.embeddings.is_none()
        {
            return Err(Error::NoEmbeddings { scene_id: scene_id.into() });
        }
        match self.link_to(&parse_id, file).await? {
            Some(link) => Ok(Download::There(link)),
            None => Ok(Download::Here(
                self.sound_file(&parse_id, file.of(&self.store.blobs.parse(&parse_id))).await?,
            )),
        }
    }

    /// Where the object store itself has a file of a parse, if callers are sent there.
    async fn link_to(&self, parse_id: &str, file: ParseFile) -> Result<Option<String>, Error> {
        let (blobs, folder) = (self.store.blobs.clone(), self.store.blobs.parse(parse_id));
        Ok(spawn_blocking(move || blobs.link(&folder, &file.of(&folder))).await??)
    }

    /// The parse of a content under these settings and the models they choose, where there is one
    /// and its files are.
    async fn stored_parse(
        &self,
        content_hash: &str,
        settings: &ParseSettings,
    ) -> Result<Option<String>, Error> {
        let hash = settings_hash(settings, &names_of(&chosen(settings.models, &self.models)))?;
        let Some(parse) = self.store.parses.parse_of(content_hash, &hash).await? else {
            return Ok(None);
        };
        let wrong = self.look_at_parse(&parse.id, Look::Names).await?;
        if wrong.is_empty() {
            return Ok(Some(parse.id));
        }
        tracing::warn!(parse_id = parse.id, files = wrong.len(), "a stored parse is not whole");
        self.retire_parse(&parse.id).await?;
        Ok(None)
    }

    /// Has a parse made anew whose files are lost or damaged, for every scene that uses it. Until
    /// then the scenes keep what they have.
    ///
    /// # Errors
    /// [`Error::Store`].
    pub async fn retire_parse(&self, parse_id: &str) -> Result<(), Error> {
        let settings =
            self.store.parses.parse(parse_id).await?.map(|parse| parse.record().settings);
        for scene in self.store.parses.retire_parse(parse_id).await? {
            let Some(settings) = &settings else { continue };
            let payload = serde_json::to_string(&Payload {
                scene_id: scene.id.clone(),
                settings: settings.clone(),
            })?;
            let job = NewJob { kind: ParseJob::NAME, payload: &payload, key_id: None, done: None };
            if let Some(row) = self.store.scenes.insert_scene_job(&scene.id, job).await? {
                tracing::info!(
                    parse_id,
                    scene_id = scene.id,
                    job_id = row.id,
                    "a parse is made anew"
                );
                self.jobs.recorded::<ParseJob>(row);
            }
        }
        Ok(())
    }

    /// A file of a parse, once it is known to be what was written.
    ///
    /// # Errors
    /// [`Error::ParseDamaged`]: it is lost or damaged, and the parse is being made anew.
    pub(super) async fn sound_file(
        &self,
        parse_id: &str,
        file: Utf8PathBuf,
    ) -> Result<Kept, Error> {
        let (service, id) = (self.clone(), parse_id.to_owned());
        match spawn_blocking(move || service.check_file(&id, &file)).await? {
            Err(error) => Err(self.after_damage(error).await),
            checked => checked,
        }
    }

    /// A file of a parse, if it is what was written; blocks. What was looked at once and has not
    /// changed since is believed.
    pub(super) fn check_file(&self, parse_id: &str, file: &Utf8Path) -> Result<Kept, Error> {
        let damaged = |what: String| Error::ParseDamaged { parse_id: parse_id.to_owned(), what };
        let of = |error: io::Error| match error.kind() {
            io::ErrorKind::NotFound => {
                damaged(format!("{} is missing", file.file_name().unwrap_or_default()))
            }
            io::ErrorKind::InvalidData => damaged(error.to_string()),
            // A disk that fails for a moment has lost nothing.
            _ => Error::Io(error),
        };
        let stamp = |file: &Utf8Path| fs::metadata(file).and_then(|m| Ok((m.len(), m.modified()?)));
        let folder = self.store.blobs.parse(parse_id);
        let kept = self.store.blobs.file(&folder, file).map_err(of)?;
        let now = stamp(file).map_err(of)?;
        if self.parses.sound.get(file.as_str()) == Some(now) {
            return Ok(kept);
        }
        let name = file.strip_prefix(&folder).unwrap_or(file);
        if let Some(Damage { file, what }) = self.store.blobs.look_at(&folder, name).map_err(of)? {
            return Err(damaged(format!("{file}: {what}")));
        }
        self.parses.sound.put(file.to_string(), stamp(file).map_err(of)?, 1);
        Ok(kept)
    }

    /// Has a damaged parse made anew, if that is what an error is about.
    pub(super) async fn after_damage(&self, error: Error) -> Error {
        match &error {
            Error::ParseDamaged { parse_id, .. } => {
                self.retire_parse(parse_id).await.err().unwrap_or(error)
            }
            _ => error,
        }
    }

    /// A parse in memory.
    pub(super) async fn loaded_parse(&self, parse_id: &str) -> Result<Arc<LoadedParse>, Error> {
        // Of now, not of when it is read: what changes in between is read once more.
        let changes = self.changes_of_parse(parse_id).await?;
        if let Some(parse) = self.parses.loaded(parse_id, changes) {
            return Ok(parse);
        }
        let parse = Arc::new(self.read_parse(parse_id).await?);
        self.parses.keep(&parse, changes);
        Ok(parse)
    }

    /// A parse that is looked at in passing: those that people ask about stay in memory, whatever
    /// many are looked through.
    pub(super) async fn passing_parse(&self, parse_id: &str) -> Result<Arc<LoadedParse>, Error> {
        match self.parses.loaded(parse_id, self.changes_of_parse(parse_id).await?) {
            Some(parse) => Ok(parse),
            None => Ok(Arc::new(self.read_parse(parse_id).await?)),
        }
    }

    /// How often what is known of a parse has changed: by this process or another.
    async fn changes_of_parse(&self, parse_id: &str) -> Result<i64, Error> {
        let changes = self.store.parses.changes_of_parse(parse_id).await?;
        changes.ok_or_else(|| Error::SceneNotFound { id: parse_id.into() })
    }

    async fn read_parse(&self, parse_id: &str) -> Result<LoadedParse, Error> {
        let gone = || Error::SceneNotFound { id: parse_id.into() };
        let row = self.store.parses.parse(parse_id).await?.ok_or_else(gone)?;
        let ParseRecord { models, extent, import, .. } = row.record();
        let mut instances = self.store.parses.instances(parse_id).await?;
        let named_by = self.give_names(parse_id, &mut instances).await?;
        let corrections = self.store.corrections.corrections(parse_id).await?;
        let (blobs, folder) = (self.store.blobs.clone(), self.store.blobs.parse(parse_id));
        let (id, content, masks, encoder) =
            (parse_id.to_owned(), blobs.content(&row.content_hash), models.masks, models.encoder);
        let source_to_scene = import.and_then(|import| import.source_to_scene);
        // Names are read as questions are: that computes.
        let read = move || {
            correct(&mut instances, &corrections);
            // What was found since no encoder has seen; what was merged looks like its members
            // together.
            let embeddings = files::read_embeddings(&blobs, &folder)?.map(|seen| {
                let seen = seen.padded_to(instances.len());
                let merged = instances
                    .iter()
                    .enumerate()
                    .filter(|(_, instance)| !instance.merged_from.is_empty());
                merged.fold(seen, |seen, (at, merged)| {
                    seen.with_mean(merged.merged_from.iter().map(|id| id.0 as usize - 1), at)
                })
            });
            let around = || {
                Aabb::around(&instances.iter().flat_map(|i| i.aabb.corners()).collect::<Vec<_>>())
            };
            Ok(LoadedParse {
                content,
                embeddings,
                frame_embeddings: files::read_frame_embeddings(&blobs, &folder)?,
                renamed: renamed(&corrections),
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
}

/// The names people have given, by id; the last one counts.
fn renamed(corrections: &[Correction]) -> BTreeMap<u32, String> {
    let name = |correction: &Correction| match (&correction.change, correction.made) {
        (Change::Rename { instance_id, name }, _) => Some((instance_id.0, name.clone())),
        (Change::Merge { name: Some(name), .. }, Some(made)) => Some((made.0, name.clone())),
        _ => None,
    };
    corrections
        .iter()
        .filter(|correction| correction.undone_at.is_none())
        .filter_map(name)
        .collect()
}

/// A parse somebody wants: to be made, or there already.
pub(super) struct WantedParse {
    payload: String,
    key_id: Option<String>,
    pub(super) stored: Option<String>,
}

impl WantedParse {
    pub(super) fn job(&self) -> NewJob<'_> {
        let done = self.stored.as_deref().map(|id| (id, job::STORED_PARSE_USED));
        NewJob {
            kind: ParseJob::NAME,
            payload: &self.payload,
            key_id: self.key_id.as_deref(),
            done,
        }
    }
}

/// Identifies settings and the code and models that read them.
fn settings_hash(settings: &ParseSettings, models: &ParseModels) -> Result<String, Error> {
    let mut hasher = Sha256::new();
    hasher.update(serde_json::to_vec(&(STAGE_1_VERSION, models, settings))?);
    Ok(hasher.finalize().iter().take(16).map(|byte| format!("{byte:02x}")).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn settings_and_models_make_the_hash() {
        let models = |encoder: &str| ParseModels { masks: "m".into(), encoder: encoder.into() };
        let (default, paper) = (
            ParseSettings::default(),
            ParseSettings::from_request(ParsePreset::Paper, None).unwrap(),
        );
        assert_eq!(
            settings_hash(&default, &models("a")).unwrap(),
            settings_hash(&default.clone(), &models("a")).unwrap()
        );
        assert_ne!(
            settings_hash(&default, &models("a")).unwrap(),
            settings_hash(&paper, &models("a")).unwrap()
        );
        assert_ne!(
            settings_hash(&default, &models("a")).unwrap(),
            settings_hash(&default, &models("b")).unwrap()
        );
    }
}
