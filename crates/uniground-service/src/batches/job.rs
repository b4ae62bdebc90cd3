//! The job that answers the questions of a batch.

use super::items::{BatchDefaults, question_of};
use super::reason;
use crate::answers::{QuestionCaller, STORE_RETRY_TIMEOUT};
use crate::error::Error;
use crate::vlm::OF_QUESTION;
use crate::{Caller, Capacity, GroundingService, Keyring, Vlm, job_failure, until_cancelled};
use futures::future::ready;
use futures::{StreamExt, stream};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::pin::pin;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::sync::atomic::Ordering::Relaxed;
use std::time::{Duration, Instant};
use tokio::time::{sleep, sleep_until};
use tokio_util::sync::CancellationToken;
use tokio_util::task::AbortOnDropHandle;
use tracing::Instrument;
use uniground_geometry::progress::Progress;
use uniground_jobs::{JobContext, JobFailure, JobKind, Retry};
use uniground_models::chat::{Budget, OverBudget};
use uniground_parsing::ParseError;
use uniground_storage::{
    AnswerRepository, BatchRepository, BatchRow, ClosedItem, JobLease, OpenItem, StoreError,
};
use uniground_telemetry::metrics::Metrics;
use uniground_types::answer::{Answer, Usage};
use uniground_types::question::{GroundRequest, ReasonerChoice};

/// Runs batches. Several run at once, so that a short batch need not wait for a long one.
pub struct BatchJob(pub Arc<BatchRunner>);

#[derive(Serialize, Deserialize)]
pub struct Payload {
    pub(super) batch_id: String,
}

impl JobKind for BatchJob {
    const NAME: &'static str = "batch";
    const CONCURRENCY: usize = 4;
    /// Finished items are never asked again, so a retry costs nothing.
    const RETRY: Retry = Retry { interrupted: 100, transient: 10, backoff: Duration::from_secs(2) };
    type Payload = Payload;

    async fn run(&self, job: JobContext<Payload>) -> Result<String, JobFailure> {
        self.0.run_batch(job).await.map_err(job_failure)
    }
}

/// Items read from the database at once.
const WINDOW: u32 = 512;
/// The interval at which finished items are written.
const WRITE_EVERY: Duration = Duration::from_millis(200);
/// The number of finished items that triggers an earlier write.
const WRITE_AFTER: usize = 64;
/// Attempts at a question after transient errors, and the wait before the second attempt. Each
/// later wait is twice as long.
const TRIES: u32 = 4;
const MIN_BACKOFF: Duration = Duration::from_secs(1);
/// The wait of a question that found no free permit. Interactive questions go first.
const RETRY_DELAY: Duration = Duration::from_millis(50);

/// How long questions in progress may take after the job was asked to stop. Requests have the same
/// time when the server stops.
const GRACE: Duration = Duration::from_secs(5);

/// The outcome of an item.
enum ItemOutcome {
    Closed(ClosedItem),
    /// The budget of the batch is exhausted, so the item waits.
    OverBudget,
}

/// A batch in progress.
struct BatchRun {
    service: BatchRunner,
    batch: BatchRow,
    /// The fields that the items share.
    defaults: Arc<BatchDefaults>,
    budget: Option<Budget>,
    /// Items that were answered or failed, including those of earlier runs.
    done: u32,
    progress: Progress,
    lease: JobLease,
    lost: CancellationToken,
}

/// Runs the jobs of batches.
#[derive(Clone)]
pub struct BatchRunner {
    pub(crate) metrics: Arc<Metrics>,
    pub(crate) batch_repository: BatchRepository,
    pub(crate) keyring: Keyring,
    pub(crate) capacity: Arc<Capacity>,
    pub(crate) answer_repository: AnswerRepository,
    pub(crate) vlm: Option<Arc<Vlm>>,
    pub(crate) grounding_service: Arc<GroundingService>,
}

impl BatchRunner {
    async fn run_batch(
        &self,
        JobContext { lease, lost, payload, progress }: JobContext<Payload>,
    ) -> Result<String, Error> {
        // Deleted in the meantime, or submitted to a server that was stopped before it had received
        // all of it.
        let Some(batch) = self.batch_repository.batch(&payload.batch_id).await? else {
            return Ok("there is no such batch any more".into());
        };
        let defaults = Arc::new(BatchDefaults::from_stored(
            self.batch_repository.batch_defaults(&batch.id).await?.as_deref(),
        )?);
        let (numbers, spent) = self.batch_repository.summarize_batch_items(&batch.id).await?;
        let done = numbers.values().sum();
        let budget = batch.max_cost_usd.map(|usd| Budget::new(THIS_BATCH, usd).with_spent(spent));
        let mut run = BatchRun {
            service: self.clone(),
            batch,
            defaults,
            budget,
            done,
            progress,
            lease,
            lost,
        };
        loop {
            if !run.is_running().await? {
                return Ok(run.summary("stopped"));
            }
            let Ok(caller) = self.keyring.resolve_caller(run.batch.key_id.as_deref()) else {
                return run.pause(reason::KEY_REFUSED, "its key is refused").await;
            };
            // Answers need disk space too: on a nearly full disk the batch is postponed.
            self.capacity.check_disk(0)?;
            let items = self.batch_repository.open_batch_items(&run.batch.id, WINDOW).await?;
            if items.is_empty() {
                self.batch_repository
                    .change_batch_state(&run.batch.id, &["running"], "succeeded", None)
                    .await?;
                return Ok(run.summary("done"));
            }
            if run.ask(items, &caller).await? == BudgetState::Exhausted {
                return run.pause(reason::BUDGET_SPENT, "its money is spent").await;
            }
        }
    }
}

/// Whether the budget of the batch sufficed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum BudgetState {
    Available,
    Exhausted,
}

impl BatchRun {
    /// Asks items concurrently and writes their results.
    async fn ask(&mut self, items: Vec<OpenItem>, caller: &Caller) -> Result<BudgetState, Error> {
        let asking = AtomicBool::new(true);
        let (service, caller, budget) = (self.service.clone(), caller.clone(), self.budget.clone());
        let defaults = self.defaults.clone();
        let window = Arc::new(ItemWindow::of(&self.batch.id, &items));
        let wanted = stream::iter(items).take_while(|_| ready(asking.load(Relaxed)));
        // Separate tasks: they continue while this loop writes to the database. A suspended task
        // could hold a resource that the write waits for.
        let task = |item: OpenItem| {
            let (service, caller, budget) = (service.clone(), caller.clone(), budget.clone());
            let (defaults, number) = (defaults.clone(), item.item);
            let (window, of_task) = (window.clone(), window.clone());
            let asked = async move {
                service.ask_item(item, &defaults, &of_task, &caller, budget.as_ref()).await
            };
            let asked = AbortOnDropHandle::new(tokio::spawn(asked.in_current_span()));
            async move {
                // A question that panics fails alone. Its batch continues.
                let end =
                    asked.await.unwrap_or_else(|panic| Ok(to_failed_item(number, &panic.into())));
                window.set_done(number, matches!(end, Ok(ItemOutcome::Closed(_))));
                end
            }
        };
        let width = self.batch.concurrency.unwrap_or(super::CONCURRENCY) as usize;
        let mut ends = pin!(wanted.map(task).buffer_unordered(width));
        let (mut closed, mut written, mut money) =
            (Vec::new(), Instant::now(), BudgetState::Available);
        // Why the run stops, and how long it waits for questions in progress, which have been paid
        // for.
        let (mut stop, mut is_cancelled): (Option<(Error, tokio::time::Instant)>, bool) =
            (None, false);
        let soon = || tokio::time::Instant::now() + GRACE;
        // Answers that were paid for are stored once the database is available again.
        let when_it_is_back = || tokio::time::Instant::now() + STORE_RETRY_TIMEOUT;
        loop {
            let end = tokio::select! {
                // The lease is lost. Returning drops the calls in progress: another worker makes
                // them now.
                () = self.lost.cancelled() => return Err(StoreError::LeaseLost.into()),
                end = ends.next() => end,
                () = sleep_until(stop.as_ref().map_or_else(when_it_is_back, |(_, until)| *until)), if stop.is_some() => None,
                cancelled = until_cancelled(&self.progress), if !is_cancelled => {
                    is_cancelled = true;
                    stop = Some((ParseError::from(cancelled).into(), soon()));
                    asking.store(false, Relaxed);
                    continue;
                }
            };
            match end {
                None => break,
                Some(Ok(ItemOutcome::Closed(item))) => closed.push(item),
                Some(Ok(ItemOutcome::OverBudget)) => money = BudgetState::Exhausted,
                // The database is failing. Finished items are still written, and the job is
                // retried.
                Some(Err(error)) => drop(stop.get_or_insert_with(|| (error, when_it_is_back()))),
            }
            // The share of all items, so that a resumed run reports more progress than the run
            // before it. Cancellation is handled in the `select!` above.
            let share = (self.done as f32 + closed.len() as f32) / self.batch.items.max(1) as f32;
            let _ = self.progress.report("asking", share);
            if closed.len() >= WRITE_AFTER || written.elapsed() >= WRITE_EVERY {
                written = Instant::now();
                match self.write(&mut closed).await {
                    Ok(is_wanted) => drop(asking.fetch_and(is_wanted, Relaxed)),
                    Err(error) => drop(stop.get_or_insert_with(|| (error, when_it_is_back()))),
                }
            }
            if money == BudgetState::Exhausted || stop.is_some() {
                asking.store(false, Relaxed);
            }
        }
        self.write(&mut closed).await?;
        stop.map_or(Ok(money), |(error, _)| Err(error))
    }

    /// Writes the results of items. Returns whether the batch goes on.
    async fn write(&mut self, closed: &mut Vec<ClosedItem>) -> Result<bool, Error> {
        self.service
            .batch_repository
            .close_batch_items(&self.lease, &self.batch.id, closed)
            .await?;
        for item in closed.drain(..) {
            self.service.metrics.questions.record_batch_item(&item.status);
            self.done += 1;
        }
        // A key that was revoked or has expired is detected before the next items.
        Ok(self.service.keyring.resolve_caller(self.batch.key_id.as_deref()).is_ok()
            && self.is_running().await?)
    }

    /// Returns whether the batch is still running: not paused, cancelled or deleted.
    async fn is_running(&self) -> Result<bool, Error> {
        Ok(self
            .service
            .batch_repository
            .batch(&self.batch.id)
            .await?
            .is_some_and(|batch| batch.state == "running"))
    }

    async fn pause(&self, reason: &str, why: &str) -> Result<String, Error> {
        self.service
            .batch_repository
            .change_batch_state(&self.batch.id, &["running"], "paused", Some(reason))
            .await?;
        Ok(self.summary(why))
    }

    fn summary(&self, why: &str) -> String {
        format!("{} of {} questions asked: {why}", self.done, self.batch.items)
    }
}

impl BatchRunner {
    /// Answers one question, or finds the answer it got before a server was killed. Returns an
    /// error only if the store or the model is unavailable, not if the question fails.
    async fn ask_item(
        &self,
        open: OpenItem,
        defaults: &BatchDefaults,
        window: &ItemWindow,
        caller: &Caller,
        budget: Option<&Budget>,
    ) -> Result<ItemOutcome, Error> {
        let OpenItem { item, scene_id, request, answer_id } = open;
        if let Some(kept) = self.answer_repository.answer(&answer_id).await? {
            let AnswerSummary { status, usage } = serde_json::from_str(&kept.body)?;
            return Ok(ItemOutcome::Closed(ClosedItem {
                item,
                status,
                cost_usd: usage.cost_usd,
                error: None,
            }));
        }
        let request: GroundRequest =
            match defaults.merge(&request).and_then(|request| question_of(&request)) {
                // A question that cannot be paid for waits. It does not fall back to another
                // reasoner.
                Ok(request)
                    if budget.is_some()
                        && self.vlm.is_some()
                        && request.reasoner == ReasonerChoice::Auto =>
                {
                    GroundRequest { reasoner: ReasonerChoice::Vlm, ..request }
                }
                Ok(request) => request,
                Err(error) => return Ok(to_failed_item(item, &error)),
            };
        let request = match self.resolve_item_reference(request, window).await? {
            EarlierItem::Answered(request) => *request,
            EarlierItem::Open => return Ok(ItemOutcome::OverBudget),
            EarlierItem::Failed(earlier) => {
                let why = format!("item {earlier} has no answer that this question could follow");
                return Ok(to_failed_item(item, &Error::invalid("/context/item", why)));
            }
        };
        let (mut tries, mut wait) = (0, MIN_BACKOFF);
        loop {
            let asker = QuestionCaller {
                caller: caller.clone(),
                answer_id: answer_id.clone(),
                pays: budget.cloned(),
                is_batch: true,
                may_name: true,
            };
            match self.grounding_service.ground_for(&scene_id, request.clone(), asker).await {
                Ok(Answer { stored: false, .. }) => return Err(Error::AnswerNotStored),
                Ok(answer) => {
                    let status = serde_json::to_value(answer.status)?
                        .as_str()
                        .unwrap_or_default()
                        .to_owned();
                    return Ok(ItemOutcome::Closed(ClosedItem {
                        item,
                        status,
                        cost_usd: answer.usage.cost_usd,
                        error: None,
                    }));
                }
                Err(Error::Overloaded) => sleep(RETRY_DELAY).await,
                // The budget of the batch, of its key or of the server for today is exhausted: the
                // item waits. The question's own budget will not grow, so it does not wait for
                // that.
                Err(Error::OverBudget(OverBudget { of, .. })) if of != OF_QUESTION => {
                    return Ok(ItemOutcome::OverBudget);
                }
                // No question of this kind can be answered now. The batch is postponed, and no item
                // fails for it.
                Err(error @ (Error::Store(_) | Error::Io(_) | Error::VlmDown { .. })) => {
                    return Err(error);
                }
                Err(error) if error.is_transient() && tries + 1 < TRIES => {
                    sleep(wait).await;
                    (tries, wait) = (tries + 1, wait * 2);
                }
                Err(error) => return Ok(to_failed_item(item, &error)),
            }
        }
    }
}

/// The item that a question follows.
enum EarlierItem {
    /// It was answered, or there is none. The question now names the answer.
    Answered(Box<GroundRequest>),
    /// It was not asked, because a budget is exhausted.
    Open,
    /// It has no answer.
    Failed(u32),
}

impl BatchRunner {
    /// Waits for the item that a question follows, and replaces the reference by its answer.
    async fn resolve_item_reference(
        &self,
        mut request: GroundRequest,
        window: &ItemWindow,
    ) -> Result<EarlierItem, Error> {
        let Some(context) = &mut request.context else {
            return Ok(EarlierItem::Answered(Box::new(request)));
        };
        let Some(earlier) = context.item.take() else {
            return Ok(EarlierItem::Answered(Box::new(request)));
        };
        let answer_id = match window.items.get(&earlier) {
            Some(end) => {
                end.done.cancelled().await;
                if !end.is_closed.load(Relaxed) {
                    return Ok(EarlierItem::Open);
                }
                Some(end.answer_id.clone())
            }
            None => self.batch_repository.answer_id_of_item(&window.batch_id, earlier).await?,
        };
        let answer = match &answer_id {
            Some(id) => self.answer_repository.answer(id).await?,
            None => None,
        };
        if answer.is_none() {
            return Ok(EarlierItem::Failed(earlier));
        }
        context.answer_id = answer_id;
        Ok(EarlierItem::Answered(Box::new(request)))
    }
}

/// The items that are asked together. An item starts after all earlier ones, so waiting for an
/// earlier one never blocks the batch.
struct ItemWindow {
    batch_id: String,
    items: BTreeMap<u32, ItemEnd>,
}

/// The end of an item, for those that follow it.
struct ItemEnd {
    answer_id: String,
    done: CancellationToken,
    /// Whether it was answered or failed. Otherwise it stays open.
    is_closed: AtomicBool,
}

impl ItemWindow {
    fn of(batch_id: &str, items: &[OpenItem]) -> Self {
        let end = |open: &OpenItem| {
            let (done, is_closed) = (CancellationToken::new(), AtomicBool::new(false));
            (open.item, ItemEnd { answer_id: open.answer_id.clone(), done, is_closed })
        };
        Self { batch_id: batch_id.to_owned(), items: items.iter().map(end).collect() }
    }

    /// Lets the items go on that follow this one.
    fn set_done(&self, item: u32, is_closed: bool) {
        if let Some(end) = self.items.get(&item) {
            end.is_closed.store(is_closed, Relaxed);
            end.done.cancel();
        }
    }
}

/// The maximum length of an item's error. The text repeats parts of the question and is stored with
/// every item.
const MAX_DETAIL_CHARS: usize = 500;

fn shorten(text: &str) -> String {
    match text.char_indices().nth(MAX_DETAIL_CHARS) {
        Some((cut, _)) => format!("{}...", &text[..cut]),
        None => text.to_owned(),
    }
}

fn to_failed_item(item: u32, error: &Error) -> ItemOutcome {
    let detail = match error {
        Error::Invalid { pointer, detail } => {
            format!("{}: {}", shorten(pointer), shorten(detail))
        }
        other => shorten(&other.to_string()),
    };
    let error = Some((error.code().to_owned(), detail));
    ItemOutcome::Closed(ClosedItem { item, status: "failed".into(), cost_usd: 0.0, error })
}

/// The name of the budget in messages.
const THIS_BATCH: &str = "this batch";

/// The fields of a stored answer that a batch needs.
#[derive(Deserialize)]
struct AnswerSummary {
    status: String,
    usage: Usage,
}
