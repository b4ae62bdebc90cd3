//! The job that names all instances of a parse in advance. Questions with stored names then never
//! wait for naming.

use super::answers::StoredScene;
use super::vlm::{OF_KEY, WhenNamed};
use super::{Caller, Vlm, job_failure, until_cancelled};
use crate::error::Error;
use crate::{Keyring, ParsedScenes, SceneLookup};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;
use uniground_geometry::scene::InstanceId;
use uniground_grounding::pipeline::SceneSource;
use uniground_grounding::vlm::naming;
use uniground_jobs::{Job, JobContext, JobFailure, JobKind, Jobs, Retry};
use uniground_models::chat::{OverBudget, Session};
use uniground_parsing::ParseError;
use uniground_storage::{JobFilter, JobRepository, NameRepository};

/// Names the objects of scenes. A naming job mostly waits for a model, so several can run at once.
pub struct NamingJob(pub Arc<NamingService>);

#[derive(Serialize, Deserialize)]
pub struct Payload {
    scene_id: String,
    /// The key that pays, in addition to the daily budget.
    #[serde(default)]
    key_id: Option<String>,
}

impl JobKind for NamingJob {
    const NAME: &'static str = "naming";
    const CONCURRENCY: usize = 4;
    /// Each call has its own retries. Names are stored as they arrive, so a retry of the job asks
    /// only for the rest.
    const RETRY: Retry = Retry { interrupted: 10, transient: 1, backoff: Duration::ZERO };
    type Payload = Payload;

    async fn run(&self, job: JobContext<Payload>) -> Result<String, JobFailure> {
        self.0.run_naming(job).await.map_err(job_failure)
    }
}

/// Names the instances of a scene with a model.
#[derive(Clone)]
pub struct NamingService {
    pub(crate) vlm: Option<Arc<Vlm>>,
    pub(crate) scene_lookup: Arc<SceneLookup>,
    pub(crate) jobs: Jobs,
    pub(crate) name_repository: NameRepository,
    pub(crate) job_repository: JobRepository,
    pub(crate) keyring: Keyring,
    pub(crate) parsed_scenes: Arc<ParsedScenes>,
}

impl NamingService {
    /// Names every object of a scene's current parse, in the background. Objects that already have
    /// a name are not paid for again.
    ///
    /// # Errors
    /// [`Error`] if there is no model, the scene is unknown or unparsed, or the queue is full.
    pub async fn start_naming(&self, scene_id: &str, caller: &Caller) -> Result<Job, Error> {
        if self.vlm.is_none() {
            return Err(Error::VlmNotConfigured);
        }
        self.check_paid(caller)?;
        let (scene, _) = self.scene_lookup.ready_scene(scene_id).await?;
        let payload =
            Payload { scene_id: scene.id.clone(), key_id: caller.key_id().map(str::to_owned) };
        Ok(self.jobs.submit::<NamingJob>(&scene.id, &payload, caller.key_id()).await?)
    }

    /// Starts naming a scene that has just been parsed, if configured. Errors are only logged,
    /// because the parse is done. The server's own budget pays, not that of the uploader.
    pub(super) async fn name_when_parsed(&self, scene_id: &str) {
        if self.vlm.as_ref().is_none_or(|vlm| vlm.names() != WhenNamed::Parse) {
            return;
        }
        let start = async {
            let (_, parse_id) = self.scene_lookup.ready_scene(scene_id).await?;
            match self.name_repository.name_index(&parse_id, naming::NAMING_VERSION).await? {
                Some(_) => Ok(()),
                None => self.start_naming(scene_id, &Caller::operator()).await.map(drop),
            }
        };
        if let Err(error) = start.await {
            let error: Error = error;
            tracing::warn!(
                scene_id,
                error = &error as &dyn std::error::Error,
                "scene could not be queued for naming"
            );
        }
    }

    /// Waits until a scene is named, if names are required before the model's first question. If
    /// the names are unavailable, the question is answered without them, and its answer says so.
    pub(super) async fn name_before_asking(
        &self,
        scene_id: &str,
        parse_id: &str,
        caller: &Caller,
    ) -> Result<(), Error> {
        let wanted = self.vlm.as_ref().is_some_and(|vlm| vlm.names() == WhenNamed::Lazy);
        if !wanted
            || self.name_repository.name_index(parse_id, naming::NAMING_VERSION).await?.is_some()
        {
            return Ok(());
        }
        let filter = JobFilter {
            kind: Some(NamingJob::NAME.to_owned()),
            state: None,
            subject: Some(scene_id.to_owned()),
        };
        let last = self
            .job_repository
            .jobs(&filter, 1, None)
            .await?
            .into_iter()
            .find(|job| !job.state.is_final());
        let job_id = match last {
            Some(job) => job.id,
            None => self.start_naming(scene_id, caller).await?.id,
        };
        // A deleted job counts as finished too.
        let _ = self.jobs.follow(&job_id).await?.wait_for(|job| job.state.is_final()).await;
        Ok(())
    }

    /// Returns an error if a key has a budget but the model's prices are unknown, because nothing
    /// can be charged to that budget.
    fn check_paid(&self, caller: &Caller) -> Result<(), Error> {
        let unknown = self.vlm.as_ref().is_some_and(|vlm| !vlm.prices().has_prices());
        match caller.key.as_ref().and_then(|key| key.row.daily_usd).filter(|_| unknown) {
            Some(limit_usd) => Err(Error::OverBudget(OverBudget {
                of: OF_KEY,
                limit_usd,
                left_usd: 0.0,
                wanted_usd: 0.0,
            })),
            None => Ok(()),
        }
    }

    async fn run_naming(
        &self,
        JobContext { payload, progress, .. }: JobContext<Payload>,
    ) -> Result<String, Error> {
        let vlm = self.vlm.clone().ok_or(Error::VlmNotConfigured)?;
        let caller = self
            .keyring
            .resolve_caller(payload.key_id.as_deref())
            .map_err(|_| Error::KeyRefused)?;
        self.check_paid(&caller)?;
        let (_, parse_id) = self.scene_lookup.ready_scene(&payload.scene_id).await?;
        let source = StoredScene::new(
            self.parsed_scenes.clone(),
            self.parsed_scenes.loaded_parse(&parse_id).await?,
        );
        let known = self.parsed_scenes.names_of(&parse_id).await?;
        let unnamed: Vec<InstanceId> = source
            .instances()
            .iter()
            .filter(|i| i.structure.is_none() && !i.dismissed && !known.contains_key(&i.id.0))
            .map(|i| i.id)
            .collect();
        let mut named = 0;
        let sheets: Vec<&[InstanceId]> = unnamed.chunks(naming::PER_SHEET).collect();
        for (number, ids) in sheets.iter().enumerate() {
            // Stops once the key has been revoked or has expired.
            self.keyring
                .resolve_caller(payload.key_id.as_deref())
                .map_err(|_| Error::KeyRefused)?;
            progress
                .report("naming", number as f32 / sheets.len() as f32)
                .map_err(ParseError::from)?;
            let names = tokio::select! {
                names = self.name_sheet(&vlm, &caller, &source, number + 1, ids) => names?,
                cancelled = until_cancelled(&progress) => return Err(ParseError::from(cancelled).into()),
            };
            named += names.values().filter(|name| !name.is_empty()).count();
        }
        self.name_repository
            .complete_name_index(&parse_id, vlm.name(), naming::NAMING_VERSION)
            .await?;
        // From here on, questions get all names.
        Ok(format!("{named} of {} objects named by {}", unnamed.len(), vlm.name()))
    }

    /// Asks for the names of one sheet and stores them, so that a resumed job continues with the
    /// next sheet. Objects that are not shown well enough to be asked about get the name "".
    async fn name_sheet(
        &self,
        vlm: &Vlm,
        caller: &Caller,
        source: &Arc<StoredScene>,
        number: usize,
        ids: &[InstanceId],
    ) -> Result<BTreeMap<u32, String>, Error> {
        let wanted = ids.to_vec();
        let limits = vlm.picture_limits();
        let request = source
            .compute(move |source| {
                let sheet = naming::sheet_of(source, number, &wanted)?;
                Ok(sheet.map(|(sheet, shown)| {
                    (limits.apply(1, naming::request(sheet, &shown)).0, shown)
                }))
            })
            .await?;
        let mut names = BTreeMap::new();
        if let Some((request, shown)) = request {
            let model = vlm.model_for(caller);
            let mut session = Session::new(model.as_ref(), Vlm::budgets(None), 1);
            names = naming::read(&session.ask("naming", request).await?, &shown);
            names.extend(
                ids.iter().filter(|id| !shown.contains(&id.0)).map(|id| (id.0, String::new())),
            );
        }
        self.parsed_scenes.store_names(&source.parse.id, &names).await?;
        Ok(names)
    }
}
