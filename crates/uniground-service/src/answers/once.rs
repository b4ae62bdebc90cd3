//! Repeated questions. The same idempotency key returns the same answer, and a model is paid once.

use super::question_models::wants_model;
use super::{QuestionCaller, filter_answer};
use crate::error::Error;
use crate::{Caller, GroundingService};
use sha2::{Digest, Sha256};
use tracing::Instrument;
use uniground_types::answer::Answer;
use uniground_types::question::GroundRequest;

impl GroundingService {
    /// Answers a question under an idempotency key. Also returns whether the answer was given
    /// before. The question is answered to its end even if the client disconnects, because the
    /// client will retry.
    ///
    /// # Errors
    /// Those of [`ground`](Self::ground); [`Error::IdempotencyKeyReused`].
    pub async fn ground_once(
        &self,
        scene_id: &str,
        request: GroundRequest,
        caller: Caller,
        key: String,
    ) -> Result<(Answer, bool), Error> {
        let (service, scene_id) = (self.clone(), scene_id.to_owned());
        let lock_idempotency_key =
            async move { service.ground_with_key(&scene_id, request, caller, &key).await };
        tokio::spawn(lock_idempotency_key.in_current_span()).await?
    }

    async fn ground_with_key(
        &self,
        scene_id: &str,
        request: GroundRequest,
        caller: Caller,
        key: &str,
    ) -> Result<(Answer, bool), Error> {
        request.check()?;
        // Checked first, so that a question about an unparsed scene does not use up its key.
        self.scene_lookup.ready_scene(scene_id).await?;
        let key = caller.qualify_name(key.to_owned());
        let _lock = self.service_locks.lock_idempotency_key(&key).await?;
        let digest = Sha256::digest(serde_json::to_vec(&(scene_id, &request))?);
        let asked: String = digest.iter().map(|byte| format!("{byte:02x}")).collect();
        // The answer's id is chosen before the question is asked. An answer that was stored before
        // a crash is found again by it.
        let (known, answer_id) = match self
            .answer_repository
            .claim_idempotency_key(&key, &asked, &self.ids.new_id())
            .await
        {
            Ok(known) => known,
            // No model is paid for this question, so answering it without storing its key is
            // better than failing.
            Err(error) if self.vlm.is_none() || !wants_model(&request) => {
                tracing::warn!(
                    error = &error as &dyn std::error::Error,
                    "idempotency key could not be stored; answering without it"
                );
                (asked.clone(), self.ids.new_id())
            }
            Err(error) => return Err(error.into()),
        };
        if known != asked {
            return Err(Error::IdempotencyKeyReused);
        }
        if let Some(row) = self.answer_repository.answer(&answer_id).await? {
            return Ok((
                filter_answer(serde_json::from_str(&row.body)?, request.include.as_deref()),
                true,
            ));
        }
        let asker =
            QuestionCaller { caller, answer_id, pays: None, is_batch: false, may_name: true };
        Ok((self.ground_for(scene_id, request, asker).await?, false))
    }
}
