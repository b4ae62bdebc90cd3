//! Naming all instances of a parse up front, as a job: questions with cached names then never wait for it.

use super::Service;
use super::evidence::Stored;
use super::vlm::Vlm;
use crate::error::Error;
use crate::grounding::vlm::naming;
use crate::jobs::{Handler, Job, JobContext, JobFailure};
use crate::models::chat::Session;
use crate::progress::{Cancelled, Progress};
use crate::scene::InstanceId;
use crate::scene_parsing::ParseError;
use futures::FutureExt;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;
use tokio::task::spawn_blocking;

/// Name of the job kind.
pub const NAMING_JOB: &str = "naming";

#[derive(Serialize, Deserialize)]
struct Payload {
    scene_id: String,
}

impl Service {
    /// Names every object of a scene's current parse, in the background. What has a name already is not paid for again.
    ///
    /// # Errors
    /// [`Error`]: no model, an unknown or unparsed scene, a full queue.
    pub async fn start_naming(&self, scene_id: &str) -> Result<Job, Error> {
        if self.vlm.is_none() {
            return Err(Error::VlmNotConfigured);
        }
        let (scene, _) = self.ready_scene(scene_id).await?;
        let payload = serde_json::to_string(&Payload { scene_id: scene.id.clone() })?;
        Ok(self.jobs.submit(NAMING_JOB, &scene.id, &payload).await?)
    }

    /// Names the configured model gave to the instances of a parse.
    pub(super) async fn names_of(&self, parse_id: &str) -> Result<BTreeMap<u32, String>, Error> {
        match &self.vlm {
            Some(vlm) => Ok(self.store.instance_names(parse_id, vlm.client.model(), naming::NAMING_VERSION).await?),
            None => Ok(BTreeMap::new()),
        }
    }

    /// The handler of [`NAMING_JOB`].
    #[must_use]
    pub fn naming_handler(&self) -> Handler {
        let service = self.clone();
        Arc::new(move |context| {
            let service = service.clone();
            async move {
                service.run_naming(context).await.map_err(|error| match error.code() {
                    "cancelled" => JobFailure::Cancelled,
                    code => JobFailure::Failed { code: code.to_owned(), detail: error.to_string() },
                })
            }
            .boxed()
        })
    }

    async fn run_naming(&self, JobContext { payload, progress, .. }: JobContext) -> Result<String, Error> {
        let Payload { scene_id } = serde_json::from_str(&payload)?;
        let vlm = self.vlm.clone().ok_or(Error::VlmNotConfigured)?;
        let (_, parse_id) = self.ready_scene(&scene_id).await?;
        let parse = self.loaded_parse(&parse_id).await?;
        let known = self.names_of(&parse_id).await?;
        let unnamed: Vec<InstanceId> = parse
            .instances
            .iter()
            .filter(|i| i.structure.is_none() && !known.contains_key(&i.id.0))
            .map(|i| i.id)
            .collect();
        let mut named = 0;
        let sheets: Vec<&[InstanceId]> = unnamed.chunks(naming::PER_SHEET).collect();
        for (number, ids) in sheets.iter().enumerate() {
            progress.report("naming", number as f32 / sheets.len() as f32).map_err(ParseError::from)?;
            let names = tokio::select! {
                names = self.name_sheet(&vlm, &parse_id, number + 1, ids) => names?,
                cancelled = until_cancelled(&progress) => return Err(ParseError::from(cancelled).into()),
            };
            named += names.values().filter(|name| !name.is_empty()).count();
        }
        Ok(format!("{named} of {} objects named by {}", unnamed.len(), vlm.client.model()))
    }

    /// Asks for the names of one sheet and keeps them: a job that is resumed goes on with the next.
    async fn name_sheet(&self, vlm: &Vlm, parse_id: &str, number: usize, ids: &[InstanceId]) -> Result<BTreeMap<u32, String>, Error> {
        let (parse, caches, folder) = (self.loaded_parse(parse_id).await?, self.caches.clone(), self.store.blobs.parse(parse_id));
        let (parse_id_owned, wanted) = (parse_id.to_owned(), ids.to_vec());
        let sheet = spawn_blocking(move || {
            let stored = Stored { parse_id: &parse_id_owned, parse: &parse, folder, caches: &caches };
            stored.sheet(number, &wanted)
        })
        .await??;
        let ids: Vec<u32> = ids.iter().map(|id| id.0).collect();
        let mut session = Session::new(&vlm.client, vlm.purses(&self.store, None).await?, 1);
        let asked = session.ask("naming", naming::request(sheet, &ids)).await;
        vlm.note_spending(&self.store).await?;
        let names = naming::read(&asked?, &ids);
        self.store.keep_instance_names(parse_id, vlm.client.model(), naming::NAMING_VERSION, &names).await?;
        Ok(names)
    }
}

async fn until_cancelled(progress: &Progress) -> Cancelled {
    const LOOK_EVERY: Duration = Duration::from_millis(100);
    loop {
        if let Err(cancelled) = progress.check() {
            return cancelled;
        }
        tokio::time::sleep(LOOK_EVERY).await;
    }
}
