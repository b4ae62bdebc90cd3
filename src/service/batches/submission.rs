//! Receiving a batch: items as JSON or as JSONL, of any length, a few at a time.

use super::job::Payload;
use super::{BatchJob, MAX_CONCURRENCY, MAX_ITEMS, MAX_LABEL_CHARS};
use crate::error::Error;
use crate::jobs::JobKind;
use crate::service::{Caller, Service};
use crate::store::{NewBatch, NewItem, NewJob, Store, Submitted};
use bytes::Bytes;
use futures::{Stream, StreamExt};
use serde_json::{Map, Value};
use sha2::{Digest, Sha256};
use uniground_types::batch::{Batch, BatchRequest};
use uniground_types::numbers::zero_or_more;
use uniground_types::question::GroundRequest;

/// What comes with a batch.
#[derive(Debug, Clone, Default)]
pub struct Submission {
    pub label: Option<String>,
    pub concurrency: Option<u32>,
    pub max_cost_usd: Option<f64>,
    pub idempotency_key: Option<String>,
    /// Fields of every item that does not have them itself.
    pub defaults: Map<String, Value>,
}

/// The items of a batch.
pub enum Body<S> {
    Items(Vec<Map<String, Value>>),
    /// An object a line.
    Lines(S),
}

/// Items written together: few enough that no question waits long for the database.
const TOGETHER: usize = 500;
/// No question needs a longer line.
const MAX_LINE_BYTES: usize = 64 << 10;

impl Submission {
    /// Splits a JSON request into what comes with it and its items.
    #[must_use]
    pub fn of(request: BatchRequest, idempotency_key: Option<String>) -> (Self, Vec<Map<String, Value>>) {
        let BatchRequest { items, defaults, label, concurrency, max_cost_usd } = request;
        (Self { label, concurrency, max_cost_usd, idempotency_key, defaults }, items)
    }

    fn check(&self) -> Result<(), Error> {
        if self.concurrency.is_some_and(|c| !(1..=MAX_CONCURRENCY).contains(&c)) {
            return Err(Error::invalid("/concurrency", format!("must be 1 to {MAX_CONCURRENCY}")));
        }
        self.max_cost_usd.map_or(Ok(()), |usd| zero_or_more("/max_cost_usd", usd))?;
        if self
            .label
            .as_ref()
            .is_some_and(|label| label.chars().count() > MAX_LABEL_CHARS || label.chars().any(char::is_control))
        {
            return Err(Error::invalid("/label", format!("a line of at most {MAX_LABEL_CHARS} characters")));
        }
        Ok(())
    }

    /// A question as it is kept: its fields, those it does not have from the defaults.
    fn item(&self, fields: Map<String, Value>) -> NewItem {
        let mut all = self.defaults.clone();
        all.extend(fields);
        let scene_id = all.remove("scene_id");
        let scene_id = scene_id.as_ref().and_then(Value::as_str).unwrap_or_default().to_owned();
        NewItem { scene_id, request: Value::Object(all).to_string() }
    }
}

/// The question of an item.
pub(super) fn question_of(request: &str) -> Result<GroundRequest, Error> {
    let mut reader = serde_json::Deserializer::from_str(request);
    let question: GroundRequest = serde_path_to_error::deserialize(&mut reader).map_err(|error| {
        let pointer: String = error.path().iter().map(|segment| format!("/{segment}")).filter(|s| s != "/?").collect();
        Error::invalid(pointer, error.inner().to_string())
    })?;
    question.check()?;
    Ok(question)
}

/// Takes items as they come and writes them some at a time.
struct Receiving<'a> {
    service: &'a Service,
    submission: Submission,
    /// `None` for a batch that was submitted before: it is only compared.
    batch_id: Option<String>,
    digest: Sha256,
    waiting: Vec<NewItem>,
    items: u32,
}

impl Receiving<'_> {
    async fn take(&mut self, fields: Map<String, Value>) -> Result<(), Error> {
        // "{"defaults": {...}}", before the first item.
        if self.items == 0
            && fields.len() == 1
            && let Some(Value::Object(defaults)) = fields.get("defaults")
        {
            // The scene of the address stays, unless they name another.
            self.submission.defaults.extend(defaults.clone());
            return Ok(());
        }
        if self.items >= MAX_ITEMS {
            return Err(Error::TooManyItems { most: MAX_ITEMS });
        }
        let item = self.submission.item(fields);
        self.digest.update(item.scene_id.as_bytes());
        self.digest.update(item.request.as_bytes());
        self.digest.update(b"\n");
        self.waiting.push(item);
        self.items += 1;
        if self.waiting.len() >= TOGETHER { self.write().await } else { Ok(()) }
    }

    async fn write(&mut self) -> Result<(), Error> {
        let items = std::mem::take(&mut self.waiting);
        if let Some(id) = &self.batch_id {
            self.service.store.insert_batch_items(id, self.items - items.len() as u32, &items).await?;
        }
        Ok(())
    }

    async fn take_line(&mut self, line: &[u8]) -> Result<(), Error> {
        let line = line.trim_ascii();
        if line.is_empty() {
            return Ok(());
        }
        let fields = serde_json::from_slice(line);
        let fields = fields.map_err(|error| Error::invalid(format!("/items/{}", self.items), format!("not a JSON object: {error}")))?;
        self.take(fields).await
    }

    async fn take_lines<E>(&mut self, mut lines: impl Stream<Item = Result<Bytes, E>> + Unpin) -> Result<(), Error> {
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
                self.take_line(&line).await?;
            }
            if rest.len() > MAX_LINE_BYTES {
                return Err(Error::invalid(format!("/items/{}", self.items), format!("a line has at most {MAX_LINE_BYTES} bytes")));
            }
        }
        let last = std::mem::take(&mut rest);
        self.take_line(&last).await
    }
}

/// A batch that is being received; forgotten where its sender leaves.
struct Unfinished {
    store: Store,
    id: Option<String>,
}

impl Drop for Unfinished {
    fn drop(&mut self) {
        if let Some(id) = self.id.take() {
            let store = self.store.clone();
            tokio::spawn(async move {
                if let Err(error) = store.delete_batch(&id).await {
                    // The next start does it.
                    tracing::warn!(error = &error as &dyn std::error::Error, "half a batch could not be forgotten");
                }
            });
        }
    }
}

impl Service {
    /// Takes a list of questions and starts asking them. All of it is taken or nothing.
    ///
    /// What is wrong with one question is that item's failure. The same submission again under its idempotency key returns the batch it made.
    ///
    /// # Errors
    /// [`Error`]: what is no list of JSON objects, or empty, or too long; [`Error::IdempotencyKeyReused`]; a full queue.
    pub async fn create_batch<E, S: Stream<Item = Result<Bytes, E>> + Unpin>(
        &self,
        submission: Submission,
        body: Body<S>,
        caller: &Caller,
    ) -> Result<Batch, Error> {
        submission.check()?;
        let key = submission.idempotency_key.clone().map(|key| caller.own(key));
        let before = match &key {
            Some(key) => self.store.batch_of_idempotency_key(key).await?,
            None => None,
        };
        let batch_id = if before.is_some() {
            None
        } else {
            self.check_disk(0)?;
            self.jobs.check_room::<BatchJob>(caller.key_id()).await?;
            let Submission { label, concurrency, max_cost_usd, .. } = &submission;
            let new = NewBatch { label: label.as_deref(), concurrency: *concurrency, max_cost_usd: *max_cost_usd, key_id: caller.key_id() };
            Some(self.store.insert_batch(new).await?)
        };
        let mut unfinished = Unfinished { store: self.store.clone(), id: batch_id.clone() };
        let mut digest = Sha256::new();
        digest.update(serde_json::to_vec(&(&submission.label, submission.concurrency, submission.max_cost_usd))?);
        let mut receiving = Receiving { service: self, submission, batch_id: batch_id.clone(), digest, waiting: Vec::new(), items: 0 };
        let taken = async {
            match body {
                Body::Items(items) => {
                    for fields in items {
                        receiving.take(fields).await?;
                    }
                }
                Body::Lines(lines) => receiving.take_lines(lines).await?,
            }
            if receiving.items == 0 {
                return Err(Error::invalid("/items", "a batch has at least one question"));
            }
            receiving.write().await
        };
        let taken = taken.await;
        let (items, digest) = (receiving.items, receiving.digest.finalize());
        let request: String = digest.iter().map(|byte| format!("{byte:02x}")).collect();
        let Some(id) = batch_id else {
            taken?;
            let before = before
                .filter(|before| before.request.as_deref() == Some(&request))
                .ok_or(Error::IdempotencyKeyReused)?;
            return self.batch(&before.id).await;
        };
        taken?;
        let payload = serde_json::to_string(&Payload { batch_id: id.clone() })?;
        let job = NewJob { kind: BatchJob::NAME, payload: &payload, key_id: caller.key_id(), done: None };
        match self.store.submit_batch(&id, items, &request, key.as_deref(), &job).await? {
            Submitted::New(job) => {
                unfinished.id = None;
                self.jobs.recorded::<BatchJob>(job);
                self.batch(&id).await
            }
            Submitted::MadeBefore(before) => self.batch(&before.id).await,
            Submitted::KeyReused => Err(Error::IdempotencyKeyReused),
        }
    }
}
