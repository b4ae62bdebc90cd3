//! Corrections that people make to a scene's parse. They are stored separately from the parse,
//! applied whenever it is read, and exported as ground truth.
//!
//! Corrections belong to a parse, because instance ids mean nothing in another parse. Scenes with
//! the same content and settings share the parse and its corrections.

mod ground_truth;

pub use ground_truth::GroundTruth;

use super::Caller;
use super::answers::StoredScene;
use crate::error::Error;
use crate::{ParsedScenes, SceneLookup};
use std::collections::BTreeSet;
use std::sync::Arc;
use uniground_geometry::scene::{Instance, InstanceId, Level, Owners, parts_of};
use uniground_grounding::pipeline::SceneSource;
use uniground_parsing::instances;
use uniground_storage::{CorrectionRepository, NewCorrection, ParseRepository};
use uniground_types::corrections::{Change, Correction, CorrectionList};
use uniground_types::settings::ParsingSettings;

/// The maximum number of corrections of a parse.
const MAX_CORRECTIONS: u32 = 5000;
const MAX_NAME_CHARS: usize = 100;
const MAX_IDS: usize = 100;

/// Adds, lists and undoes corrections of instances.
#[derive(Clone)]
pub struct CorrectionService {
    pub(crate) correction_repository: CorrectionRepository,
    pub(crate) scene_lookup: Arc<SceneLookup>,
    pub(crate) parsed_scenes: Arc<ParsedScenes>,
    pub(crate) parse_repository: ParseRepository,
}

impl CorrectionService {
    /// Corrects a scene's current parse. Later answers take the correction into account.
    ///
    /// # Errors
    /// [`Error::Invalid`], [`Error::InstanceNotFound`]; [`Error::NotAThing`] for a merge of
    /// instances that are not objects, [`Error::NoParts`] for a split without known parts;
    /// [`Error::TooManyCorrections`].
    pub async fn correct(
        &self,
        scene_id: &str,
        change: Change,
        caller: &Caller,
    ) -> Result<Correction, Error> {
        check(&change)?;
        // Under the lock: what is checked stays valid until the correction is stored.
        let (parse_id, _lock) = self.scene_lookup.lock_current_parse(scene_id).await?;
        let parse = self.parsed_scenes.loaded_parse(&parse_id).await?;
        let known = |id: InstanceId| {
            let instance = parse.instances.get((id.0 as usize).wrapping_sub(1));
            instance.ok_or_else(|| Error::InstanceNotFound { scene_id: scene_id.to_owned(), id })
        };
        let made = match &change {
            Change::Rename { instance_id, .. } => known(*instance_id).map(|_| None)?,
            Change::Dismiss { instance_ids } => {
                instance_ids.iter().try_for_each(|id| known(*id).map(drop)).map(|()| None)?
            }
            Change::Split { instance_id } => {
                if !known(*instance_id)?.merged_from.is_empty() {
                    return Err(Error::WasMerged { id: *instance_id });
                }
                if parts_of(&parse.instances, *instance_id).is_empty() {
                    return Err(Error::NoParts { id: *instance_id });
                }
                None
            }
            Change::Merge { instance_ids, .. } => {
                for id in instance_ids {
                    let instance = known(*id)?;
                    // The points of instances that were found for a question are not stored.
                    if instance.level != Level::Thing
                        || instance.dismissed
                        || instance.found_for.is_some()
                    {
                        return Err(Error::NotAThing { id: *id });
                    }
                }
                let members = instance_ids.clone();
                let scene = StoredScene::new(self.parsed_scenes.clone(), parse.clone());
                Some(scene.compute(move |scene| scene.merge_instances(&members)).await?)
            }
        };
        let author = caller.key.as_ref().map(|key| key.row.name.as_str());
        let new = NewCorrection { parse_id: &parse_id, change: &change, author, made };
        self.correction_repository
            .insert_correction(new, MAX_CORRECTIONS)
            .await?
            .ok_or(Error::TooManyCorrections { most: MAX_CORRECTIONS })
    }

    /// Lists the corrections of a scene's current parse, newest first.
    ///
    /// # Errors
    /// [`Error::SceneNotFound`], [`Error::SceneNotReady`].
    pub async fn corrections(&self, scene_id: &str) -> Result<CorrectionList, Error> {
        let (_, parse_id) = self.scene_lookup.ready_scene(scene_id).await?;
        let mut corrections = self.correction_repository.corrections(&parse_id).await?;
        corrections.reverse();
        Ok(CorrectionList { corrections })
    }

    /// Undoes a correction.
    ///
    /// # Errors
    /// [`Error::CorrectionNotFound`]; [`Error::CorrectionInUse`] if a later correction refers to
    /// the instance that this one created.
    pub async fn undo_correction(&self, scene_id: &str, id: &str) -> Result<Correction, Error> {
        let (parse_id, _lock) = self.scene_lookup.lock_current_parse(scene_id).await?;
        let corrections = self.correction_repository.corrections(&parse_id).await?;
        let not_found = || Error::CorrectionNotFound { id: id.to_owned() };
        let correction =
            corrections.iter().find(|correction| correction.id == id).ok_or_else(not_found)?;
        let brought: Vec<InstanceId> = match &correction.change {
            Change::Split { instance_id } => {
                parts_of(&self.parse_repository.instances(&parse_id).await?, *instance_id)
            }
            _ => correction.made.into_iter().collect(),
        };
        let uses_it = |later: &&Correction| match &later.change {
            Change::Merge { instance_ids, .. } => {
                instance_ids.iter().any(|id| brought.contains(id))
            }
            _ => false,
        };
        if let Some(by) = corrections.iter().filter(|later| later.undone_at.is_none()).find(uses_it)
        {
            return Err(Error::CorrectionInUse { by: by.id.clone() });
        }
        self.correction_repository.undo_correction(id).await?;
        self.correction_repository
            .corrections(&parse_id)
            .await?
            .into_iter()
            .find(|correction| correction.id == id)
            .ok_or_else(not_found)
    }
}

impl StoredScene {
    /// Merges the points of several instances into one instance.
    fn merge_instances(&self, members: &[InstanceId]) -> Result<Instance, Error> {
        let (render_scene, settings) = (self.render_scene()?, ParsingSettings::default());
        let (known, of_point) = (self.instances(), self.instance_of_point()?);
        let owners = Owners::new(&of_point, known);
        let owner =
            |point: usize| owners.owner_of(of_point[point], &render_scene.cloud.positions[point]);
        let merged = instances::merge_points(
            &render_scene.cloud,
            owner,
            members,
            known,
            &settings.instances,
        );
        merged.ok_or(Error::NotAThing { id: members[0] })
    }
}

/// Checks what does not depend on the scene.
fn check(change: &Change) -> Result<(), Error> {
    let name_fits = |name: &str| {
        let fits = !name.trim().is_empty()
            && name.chars().count() <= MAX_NAME_CHARS
            && !name.chars().any(char::is_control);
        match fits {
            true => Ok(()),
            false => Err(Error::invalid(
                "/name",
                format!("must be one line of 1 to {MAX_NAME_CHARS} characters, not blank"),
            )),
        }
    };
    let ids_fit = |ids: &[InstanceId], least: usize| {
        let different: BTreeSet<_> = ids.iter().collect();
        match (least..=MAX_IDS).contains(&ids.len()) && different.len() == ids.len() {
            true => Ok(()),
            false => Err(Error::invalid(
                "/instance_ids",
                format!("must be {least} to {MAX_IDS} different ids"),
            )),
        }
    };
    match change {
        Change::Rename { name, .. } => name_fits(name),
        Change::Dismiss { instance_ids } => ids_fit(instance_ids, 1),
        Change::Merge { instance_ids, name } => {
            ids_fit(instance_ids, 2)?;
            name.as_deref().map_or(Ok(()), name_fits)
        }
        Change::Split { .. } => Ok(()),
    }
}
