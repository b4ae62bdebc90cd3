//! Follow-up questions: they refer to an earlier answer or to a selected instance.

use super::{GroundingService, StoredScene};
use crate::error::Error;
use std::sync::Arc;
use uniground_geometry::scene::InstanceId;
use uniground_grounding::pipeline::SceneSource;
use uniground_language::{Earlier, resolve_follow_up};
use uniground_storage::SceneRow;
use uniground_types::answer::Answer;
use uniground_types::problem::FieldError;
use uniground_types::question::QuestionContext;

impl GroundingService {
    /// Returns a question in a form that needs no context, and the confidence in the earlier answer
    /// that it points at: the new answer cannot be surer.
    ///
    /// # Errors
    /// [`FieldError`] for an instance that the scene does not have, and for an answer that does not
    /// exist or is about another scene or version.
    pub(super) async fn resolve_follow_up(
        &self,
        scene: &SceneRow,
        query: &str,
        context: &QuestionContext,
        source: &Arc<StoredScene>,
    ) -> Result<(String, f32), Error> {
        let instances = &source.parse.instances;
        let instance = |id: InstanceId| instances.get((id.0 as usize).wrapping_sub(1));
        if let Some(id) = context.instance
            && instance(id).is_none()
        {
            let why = format!("there is no instance {id} in this scene");
            return Err(FieldError::new("/context/instance", why).into());
        }
        let mut confidence = 1.0;
        let earlier = match &context.answer_id {
            None => None,
            Some(id) => {
                let answer = match self.answer_repository.answer(id).await? {
                    Some(row) => serde_json::from_str::<Answer>(&row.body)
                        .ok()
                        .filter(|answer| answer.scene_id == scene.id),
                    None => None,
                };
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
                let chosen = answer.answer.predicted_id;
                confidence = answer.confidence;
                Some(Earlier {
                    query: answer.understood_as.unwrap_or(answer.query),
                    instance: chosen,
                    name: chosen.and_then(instance).map(|instance| instance.label().to_owned()),
                    anchor: answer.answer.anchor_id,
                    targets: answer.targets.iter().map(|target| target.id).collect(),
                })
            }
        };
        let chosen = earlier.as_ref().and_then(|earlier| earlier.instance);
        let (query, selected) = (query.to_owned(), context.instance);
        let resolved = source
            .compute(move |_| Ok(resolve_follow_up(&query, earlier.as_ref(), selected)))
            .await?;
        let points_at =
            chosen.is_some_and(|id| resolved.split(' ').any(|word| word == format!("#{id}")));
        Ok((resolved, if points_at { confidence } else { 1.0 }))
    }
}
