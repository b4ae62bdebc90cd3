//! Follow-up questions: they refer to an earlier answer or to a selected instance.

use super::{GroundingService, StoredScene};
use crate::Caller;
use crate::error::Error;
use std::sync::Arc;
use uniground_geometry::scene::InstanceId;
use uniground_grounding::pipeline::SceneSource;
use uniground_language::{Earlier, resolve_follow_up};
use uniground_storage::SceneRow;
use uniground_types::answer::Answer;
use uniground_types::problem::FieldError;
use uniground_types::question::QuestionContext;

/// A question that needs no context.
pub(super) struct ResolvedQuestion {
    pub query: String,
    /// Confidence in the earlier answer that the question points at: the new answer cannot be surer.
    pub confidence: f32,
    /// Id of the answer that it follows.
    pub follows: Option<String>,
}

impl GroundingService {
    /// Returns a question in a form that needs no context.
    ///
    /// # Errors
    /// [`FieldError`] for an instance that the scene does not have, for an answer that does not
    /// exist or is about another scene or version, and for an item outside of a batch.
    pub(super) async fn resolve_follow_up(
        &self,
        scene: &SceneRow,
        query: &str,
        context: &QuestionContext,
        caller: &Caller,
        source: &Arc<StoredScene>,
    ) -> Result<ResolvedQuestion, Error> {
        let instances = &source.parse.instances;
        let instance = |id: InstanceId| instances.get((id.0 as usize).wrapping_sub(1));
        if let Some(id) = context.instance
            && instance(id).is_none()
        {
            let why = format!("there is no instance {id} in this scene");
            return Err(FieldError::new("/context/instance", why).into());
        }
        if context.item.is_some() {
            let why = "only an item of a batch can refer to another item: use answer_id or session";
            return Err(FieldError::new("/context/item", why).into());
        }
        let answer = match (&context.answer_id, &context.session) {
            (Some(id), _) => Some(self.earlier_answer(scene, id).await?),
            (None, Some(session)) => self.latest_of_session(scene, session, caller).await?,
            (None, None) => None,
        };
        let confidence = answer.as_ref().map_or(1.0, |answer| answer.confidence);
        let follows = answer.as_ref().map(|answer| answer.id.clone());
        let earlier = answer.map(|answer| {
            let chosen = answer.answer.predicted_id;
            Earlier {
                query: answer.understood_as.unwrap_or(answer.query),
                instance: chosen,
                name: chosen.and_then(instance).map(|instance| instance.label().to_owned()),
                anchor: answer.answer.anchor_id,
                targets: answer.targets.iter().map(|target| target.id).collect(),
            }
        });
        let chosen = earlier.as_ref().and_then(|earlier| earlier.instance);
        let (query, selected) = (query.to_owned(), context.instance);
        let resolved = source
            .compute(move |_| Ok(resolve_follow_up(&query, earlier.as_ref(), selected)))
            .await?;
        let points_at =
            chosen.is_some_and(|id| resolved.split(' ').any(|word| word == format!("#{id}")));
        let confidence = if points_at { confidence } else { 1.0 };
        Ok(ResolvedQuestion { query: resolved, confidence, follows })
    }

    /// Returns an answer about the current version of a scene.
    async fn earlier_answer(&self, scene: &SceneRow, id: &str) -> Result<Answer, Error> {
        let row = self.answer_repository.answer(id).await?;
        let answer = row
            .and_then(|row| serde_json::from_str::<Answer>(&row.body).ok())
            .filter(|answer| answer.scene_id == scene.id);
        let answer = answer.ok_or_else(|| {
            let why = format!("there is no answer {id} about this scene");
            FieldError::new("/context/answer_id", why)
        })?;
        if i64::from(answer.parse_version) != scene.parse_version {
            let why = format!(
                "answer {id} is about version {} of the scene, which has version {} now: \
                 name the object instead",
                answer.parse_version, scene.parse_version
            );
            return Err(FieldError::new("/context/answer_id", why).into());
        }
        Ok(answer)
    }

    /// Returns the latest answer of a caller's session about the current version of a scene. A new
    /// version begins the session anew, because ids may mean other objects.
    async fn latest_of_session(
        &self,
        scene: &SceneRow,
        session: &str,
        caller: &Caller,
    ) -> Result<Option<Answer>, Error> {
        let session = caller.qualify_name(session.to_owned());
        let row = self.answer_repository.latest_of_session(&session, &scene.id).await?;
        let answer = row.and_then(|row| serde_json::from_str::<Answer>(&row.body).ok());
        Ok(answer.filter(|answer| i64::from(answer.parse_version) == scene.parse_version))
    }
}
