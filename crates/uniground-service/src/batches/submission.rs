//! Receives a batch: items as JSON or JSONL, of any length, a few at a time.

use super::items::{ItemReferences, SCENE_ID, check_shared_context, take_scene};
use super::job::Payload;
use super::{BatchJob, MAX_CONCURRENCY, MAX_ITEMS, MAX_LABEL_CHARS};
use crate::error::Error;
use crate::{BatchService, Caller};
use bytes::Bytes;
use futures::{Stream, StreamExt};
use serde_json::{Map, Value};
use sha2::{Digest, Sha256};
use tokio::task::yield_now;
use uniground_jobs::JobRequest;
use uniground_storage::{BatchRepository, NewBatch, NewItem, ReceivedBatch, SubmitOutcome};
use uniground_types::batch::{Batch, BatchRequest};
use uniground_types::numbers::check_zero_or_more;

/// Metadata of a batch.
#[derive(Debug, Clone, Default)]
pub struct Submission {
    pub label: Option<String>,
    pub concurrency: Option<u32>,
    pub max_cost_usd: Option<f64>,
    pub idempotency_key: Option<String>,
    /// Default values for fields that an item does not have.
    pub defaults: Map<String, Value>,
}

/// The items of a batch.
pub enum BatchBody<S> {
    Items(Vec<Map<String, Value>>),
    /// JSONL: one object per line.
    Lines(S),
}

/// The maximum number of items, and of their bytes, in one transaction. Small enough that questions
/// do not wait long for the database.
const MAX_ITEMS_PER_TRANSACTION: usize = 500;
const MAX_BYTES_PER_TRANSACTION: usize = 1 << 20;
/// The maximum length of a line in bytes. All defaults together have the same limit.
const MAX_LINE_BYTES: usize = 64 << 10;
/// The maximum bytes of all items of a batch and its defaults, as they are stored.
const MAX_STORED_BYTES: u64 = 1 << 30;
/// The maximum length of a shared scene id in bytes. It is stored with every item, and no id is
/// longer.
const MAX_SCENE_ID_BYTES: usize = 64;

impl Submission {
    /// Splits a JSON request into metadata and items.
    #[must_use]
    pub fn from_request(
        request: BatchRequest,
        idempotency_key: Option<String>,
    ) -> (Self, Vec<Map<String, Value>>) {
        let BatchRequest { items, defaults, label, concurrency, max_cost_usd } = request;
        (Self { label, concurrency, max_cost_usd, idempotency_key, defaults }, items)
    }

    fn check(&self) -> Result<(), Error> {
        if self.concurrency.is_some_and(|c| !(1..=MAX_CONCURRENCY).contains(&c)) {
            return Err(Error::invalid("/concurrency", format!("must be 1 to {MAX_CONCURRENCY}")));
        }
        self.max_cost_usd.map_or(Ok(()), |usd| check_zero_or_more("/max_cost_usd", usd))?;
        if self.label.as_ref().is_some_and(|label| {
            label.chars().count() > MAX_LABEL_CHARS || label.chars().any(char::is_control)
        }) {
            return Err(Error::invalid(
                "/label",
                format!("a line of at most {MAX_LABEL_CHARS} characters"),
            ));
        }
        Ok(())
    }
}

/// The form in which a submission is hashed. A repeated submission is hashed in the form of the
/// batch that its idempotency key created, and then compared.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum DigestForm {
    /// Each item with its own fields, and the shared fields once.
    Shared,
    /// Each item as a whole question. Used by batches of earlier versions.
    Whole,
}

/// Receives items and writes them in groups.
struct BatchReceiver<'a> {
    service: &'a BatchService,
    /// Default values for fields that an item does not have. The scene is removed when the first
    /// item arrives.
    defaults: Map<String, Value>,
    /// The bytes of the lines of defaults received so far.
    defaults_bytes: usize,
    scene_id: String,
    form: DigestForm,
    /// `None` if the batch was submitted before. The items are then only compared.
    batch_id: Option<String>,
    references: ItemReferences,
    digest: Sha256,
    waiting: Vec<NewItem>,
    waiting_bytes: usize,
    items: u32,
    stored_bytes: u64,
}

impl BatchReceiver<'_> {
    async fn buffer_item(&mut self, mut fields: Map<String, Value>) -> Result<(), Error> {
        // `{"defaults": {...}}` lines are allowed before the first item.
        if self.items == 0
            && fields.len() == 1
            && let Some(Value::Object(defaults)) = fields.get("defaults")
        {
            // Several lines of defaults form one set. Together they may be no longer than one line.
            self.defaults_bytes += fields["defaults"].to_string().len();
            if self.defaults_bytes > MAX_LINE_BYTES {
                return Err(long_defaults_error());
            }
            // The scene in the URL applies unless the defaults name another.
            self.defaults.extend(defaults.clone());
            return Ok(());
        }
        if self.items >= MAX_ITEMS {
            return Err(Error::TooManyItems { most: MAX_ITEMS });
        }
        if self.items == 0 {
            self.finalize_defaults()?;
        }
        let scene_id = take_scene(&mut fields, &self.scene_id);
        self.references.add_item(&scene_id, &fields)?;
        if self.form == DigestForm::Whole {
            let own = std::mem::replace(&mut fields, self.defaults.clone());
            fields.extend(own);
            yield_now().await;
        }
        let request = Value::Object(fields).to_string();
        if self.form == DigestForm::Shared && request.len() > MAX_LINE_BYTES {
            return Err(self.line_too_long_error());
        }
        self.digest.update(scene_id.as_bytes());
        self.digest.update(request.as_bytes());
        self.digest.update(b"\n");
        let bytes = scene_id.len() + request.len();
        self.stored_bytes += bytes as u64;
        check_size(self.stored_bytes)?;
        self.items += 1;
        if self.batch_id.is_none() {
            return Ok(());
        }
        self.waiting.push(NewItem { scene_id, request });
        self.waiting_bytes += bytes;
        if self.waiting.len() >= MAX_ITEMS_PER_TRANSACTION
            || self.waiting_bytes >= MAX_BYTES_PER_TRANSACTION
        {
            self.write().await
        } else {
            Ok(())
        }
    }

    /// Finalizes the defaults when the first item arrives.
    fn finalize_defaults(&mut self) -> Result<(), Error> {
        check_shared_context(&self.defaults)?;
        self.scene_id = take_scene(&mut self.defaults, "");
        if self.scene_id.len() > MAX_SCENE_ID_BYTES {
            let detail = format!("no scene's id has more than {MAX_SCENE_ID_BYTES} bytes");
            return Err(Error::invalid(format!("/defaults/{SCENE_ID}"), detail));
        }
        let defaults = self.stored_defaults();
        if defaults.len() > MAX_LINE_BYTES {
            return Err(long_defaults_error());
        }
        if self.form == DigestForm::Shared && !self.defaults.is_empty() {
            self.digest.update(b"defaults ");
            self.digest.update(defaults.as_bytes());
            self.digest.update(b"\n");
        }
        self.stored_bytes += defaults.len() as u64;
        Ok(())
    }

    fn stored_defaults(&self) -> String {
        Value::Object(self.defaults.clone()).to_string()
    }

    /// Writes the buffered items if the disk has room.
    async fn write(&mut self) -> Result<(), Error> {
        let items = std::mem::take(&mut self.waiting);
        let bytes = std::mem::take(&mut self.waiting_bytes);
        if let Some(id) = &self.batch_id {
            self.service.capacity.check_disk(bytes as u64)?;
            self.service
                .batch_repository
                .insert_batch_items(id, self.items - items.len() as u32, &items)
                .await?;
        }
        Ok(())
    }

    fn line_too_long_error(&self) -> Error {
        Error::invalid(
            format!("/items/{}", self.items),
            format!("a line has at most {MAX_LINE_BYTES} bytes"),
        )
    }

    /// Receives all items. A batch needs at least one.
    async fn receive_all<E>(
        &mut self,
        body: BatchBody<impl Stream<Item = Result<Bytes, E>> + Unpin>,
    ) -> Result<(), Error> {
        match body {
            BatchBody::Items(items) => {
                for fields in items {
                    self.buffer_item(fields).await?;
                }
            }
            BatchBody::Lines(lines) => self.receive_lines(lines).await?,
        }
        if self.items == 0 {
            return Err(Error::invalid("/items", "a batch has at least one question"));
        }
        self.write().await
    }

    async fn receive_line(&mut self, line: &[u8]) -> Result<(), Error> {
        let line = line.trim_ascii();
        if line.is_empty() {
            return Ok(());
        }
        if line.len() > MAX_LINE_BYTES {
            return Err(self.line_too_long_error());
        }
        let fields = serde_json::from_slice(line);
        let fields = fields.map_err(|error| {
            Error::invalid(format!("/items/{}", self.items), format!("not a JSON object: {error}"))
        })?;
        self.buffer_item(fields).await
    }

    async fn receive_lines<E>(
        &mut self,
        mut lines: impl Stream<Item = Result<Bytes, E>> + Unpin,
    ) -> Result<(), Error> {
        let mut rest: Vec<u8> = Vec::new();
        let mut received = 0;
        let left = |received| Error::UploadInterrupted { received };
        while let Some(chunk) = lines.next().await {
            let chunk = chunk.map_err(|_| left(received))?;
            received += chunk.len() as u64;
            let mut parts = chunk.split(|byte| *byte == b'\n');
            rest.extend_from_slice(parts.next().unwrap_or_default());
            for part in parts {
                let line = std::mem::replace(&mut rest, part.to_vec());
                self.receive_line(&line).await?;
            }
            if rest.len() > MAX_LINE_BYTES {
                return Err(self.line_too_long_error());
            }
        }
        let last = std::mem::take(&mut rest);
        self.receive_line(&last).await
    }
}

fn long_defaults_error() -> Error {
    Error::invalid("/defaults", format!("defaults have at most {MAX_LINE_BYTES} bytes as JSON"))
}

/// Returns an error if a batch exceeds the maximum size.
fn check_size(stored_bytes: u64) -> Result<(), Error> {
    if stored_bytes > MAX_STORED_BYTES {
        Err(Error::BatchTooLarge { most_bytes: MAX_STORED_BYTES })
    } else {
        Ok(())
    }
}

/// A batch that is still being received. Deleted if its client disconnects.
struct UnfinishedBatch {
    batches: BatchRepository,
    id: Option<String>,
}

impl UnfinishedBatch {
    /// Deletes the batch now, before the client is answered.
    async fn discard(&mut self) {
        if let Some(id) = self.id.clone() {
            discard(&self.batches, &id).await;
            self.id = None;
        }
    }
}

impl Drop for UnfinishedBatch {
    fn drop(&mut self) {
        if let Some(id) = self.id.take() {
            let batches = self.batches.clone();
            tokio::spawn(async move { discard(&batches, &id).await });
        }
    }
}

async fn discard(batches: &BatchRepository, id: &str) {
    if let Err(error) = batches.discard_batch(id).await {
        let error = &error as &dyn std::error::Error;
        tracing::warn!(
            batch_id = id,
            error,
            "a refused batch could not be deleted: the next start deletes it"
        );
    }
}

impl BatchService {
    /// Receives a list of questions and starts answering them. Stores all of them or none.
    ///
    /// An invalid question fails only its own item. The same submission with the same idempotency
    /// key returns the batch that the first one created.
    ///
    /// # Errors
    /// [`Error`] if the body is not a list of JSON objects, or is empty or too long;
    /// [`Error::IdempotencyKeyReused`]; a full queue or disk.
    pub async fn create_batch<E, S: Stream<Item = Result<Bytes, E>> + Unpin>(
        &self,
        submission: Submission,
        body: BatchBody<S>,
        caller: &Caller,
    ) -> Result<Batch, Error> {
        submission.check()?;
        let Submission { label, concurrency, max_cost_usd, idempotency_key, defaults } = submission;
        let key = idempotency_key.map(|key| caller.qualify_name(key));
        let before = match &key {
            Some(key) => self.batch_repository.batch_of_idempotency_key(key).await?,
            None => None,
        };
        let (batch_id, form) = if let Some(before) = &before {
            let defaults = self.batch_repository.batch_defaults(&before.id).await?;
            (None, if defaults.is_some() { DigestForm::Shared } else { DigestForm::Whole })
        } else {
            self.capacity.check_disk(0)?;
            self.jobs.check_queue_capacity::<BatchJob>(caller.key_id()).await?;
            let new = NewBatch {
                label: label.as_deref(),
                concurrency,
                max_cost_usd,
                key_id: caller.key_id(),
            };
            (Some(self.batch_repository.insert_batch(new).await?), DigestForm::Shared)
        };
        let mut unfinished =
            UnfinishedBatch { batches: self.batch_repository.clone(), id: batch_id.clone() };
        let mut digest = Sha256::new();
        digest.update(serde_json::to_vec(&(&label, concurrency, max_cost_usd))?);
        let mut receiving = BatchReceiver {
            service: self,
            defaults,
            defaults_bytes: 0,
            scene_id: String::new(),
            form,
            batch_id: batch_id.clone(),
            references: ItemReferences::default(),
            digest,
            waiting: Vec::new(),
            waiting_bytes: 0,
            items: 0,
            stored_bytes: 0,
        };
        let received = receiving.receive_all(body).await;
        let defaults = receiving.stored_defaults();
        let (items, digest) = (receiving.items, receiving.digest.finalize());
        let request: String = digest.iter().map(|byte| format!("{byte:02x}")).collect();
        let Some(id) = batch_id else {
            received?;
            let before = before
                .filter(|before| before.request.as_deref() == Some(&request))
                .ok_or(Error::IdempotencyKeyReused)?;
            return self.batch(&before.id).await;
        };
        let received = received.map(|()| ReceivedBatch {
            id: &id,
            items,
            defaults: &defaults,
            request: &request,
            key: key.as_deref(),
        });
        let submitted = match received {
            Ok(received) => self.submit(&received, caller).await,
            Err(error) => Err(error),
        };
        match submitted {
            Ok(SubmitOutcome::New(_)) => {
                unfinished.id = None;
                self.batch(&id).await
            }
            Ok(SubmitOutcome::AlreadyExists(before)) => {
                unfinished.discard().await;
                self.batch(&before.id).await
            }
            Ok(SubmitOutcome::KeyReused) => {
                unfinished.discard().await;
                Err(Error::IdempotencyKeyReused)
            }
            Err(error) => {
                unfinished.discard().await;
                Err(error)
            }
        }
    }

    async fn submit(
        &self,
        received: &ReceivedBatch<'_>,
        caller: &Caller,
    ) -> Result<SubmitOutcome, Error> {
        let payload = Payload { batch_id: received.id.to_owned() };
        // Its capacity was checked before the questions were received.
        let job = JobRequest::<BatchJob>::new(&payload, caller.key_id())?.without_limit();
        let row = job.row();
        let submit = self.batch_repository.submit_batch(received, &row);
        Ok(self.jobs.enqueue(&job, submit).await?)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn batches_above_the_size_limit_are_rejected() {
        assert!(check_size(MAX_STORED_BYTES).is_ok());
        let refused = check_size(MAX_STORED_BYTES + 1).unwrap_err();
        assert_eq!(
            (refused.code(), refused.to_string().as_str()),
            ("batch_too_large", "a batch holds at most 1024 MB: split it into several")
        );
    }
}
