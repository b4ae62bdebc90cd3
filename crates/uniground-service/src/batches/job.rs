//! Asking the questions of a batch.

use super::items::{BatchDefaults, question_of};
use super::reason;
use crate::answers::{QuestionCaller, STORE_IS_BACK};
use crate::error::Error;
use crate::vlm::OF_QUESTION;
use crate::{Caller, Capacity, GroundingService, Keyring, Vlm, job_failure, until_cancelled};
use futures::future::ready;
use futures::{StreamExt, stream};
use serde::{Deserialize, Serialize};
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

/// Asks batches. Some at once: a short one need not wait for a long one.
pub struct BatchJob(pub BatchRunner);

#[derive(Serialize, Deserialize)]
pub struct Payload {
    pub(super) batch_id: String,
}

impl JobKind for BatchJob {
    const NAME: &'static str = "batch";
    const CONCURRENCY: usize = 4;
    /// What is finished is never asked again, so another try costs nothing.
    const RETRY: Retry = Retry { interrupted: 100, transient: 10, backoff: Duration::from_secs(2) };
    type Payload = Payload;

    async fn run(&self, job: JobContext<Payload>) -> Result<String, JobFailure> {
        self.0.run_batch(job).await.map_err(job_failure)
    }
}

/// Items looked at together.
const WINDOW: u32 = 512;
/// What was answered is written down after so long,
const WRITE_EVERY: Duration = Duration::from_millis(200);
/// or when it is so much.
const WRITE_AFTER: usize = 64;
/// Tries of a question that failed in a way that may pass, and the wait before the second; each
/// later one is twice as long.
const TRIES: u32 = 4;
const FIRST_WAIT: Duration = Duration::from_secs(1);
/// How long a question waits that found all places taken: people come first.
const STEP_ASIDE: Duration = Duration::from_millis(50);

/// How long questions under way may take once somebody wants the job to stop. As long as requests
/// have when the server stops.
const GRACE: Duration = Duration::from_secs(5);

/// How an item ended.
enum ItemOutcome {
    Closed(ClosedItem),
    /// The batch's money is spent: it waits.
    OverBudget,
}

/// A batch being asked.
struct BatchRun {
    service: BatchRunner,
    batch: BatchRow,
    /// What its items share.
    defaults: Arc<BatchDefaults>,
    budget: Option<Budget>,
    /// Items that are answered or have failed, those of earlier runs too.
    done: u32,
    progress: Progress,
    hold: JobLease,
    lost: CancellationToken,
}

/// Runs the jobs of batches.
#[derive(Clone)]
pub struct BatchRunner {
    pub(crate) metrics: Arc<Metrics>,
    pub(crate) batch_repository: BatchRepository,
    pub(crate) keyring: Keyring,
    pub(crate) capacity: Capacity,
    pub(crate) answer_repository: AnswerRepository,
    pub(crate) vlm: Option<Arc<Vlm>>,
    pub(crate) grounding_service: GroundingService,
}

impl BatchRunner {
    async fn run_batch(
        &self,
        JobContext { hold, lost, payload, progress }: JobContext<Payload>,
    ) -> Result<String, Error> {
        // Deleted meanwhile, or submitted by a server that did not live to see it through.
        let Some(batch) = self.batch_repository.batch(&payload.batch_id).await? else {
            return Ok("there is no such batch any more".into());
        };
        let defaults = Arc::new(BatchDefaults::from_stored(
            self.batch_repository.batch_defaults(&batch.id).await?.as_deref(),
        )?);
        let (numbers, spent) = self.batch_repository.batch_figures(&batch.id).await?;
        let done = numbers.values().sum();
        let budget = batch.max_cost_usd.map(|usd| Budget::new(THIS_BATCH, usd).with_spent(spent));
        let mut run =
            BatchRun { service: self.clone(), batch, defaults, budget, done, progress, hold, lost };
        loop {
            if !run.is_wanted().await? {
                return Ok(run.told("stopped"));
            }
            let Ok(caller) = self.keyring.caller_of(run.batch.key_id.as_deref()) else {
                return run.pause(reason::KEY_REFUSED, "its key is refused").await;
            };
            // Its answers take room too: on a disk that is nearly full it is put off.
            self.capacity.check_disk(0)?;
            let items = self.batch_repository.open_batch_items(&run.batch.id, WINDOW).await?;
            if items.is_empty() {
                self.batch_repository
                    .move_batch(&run.batch.id, &["running"], "succeeded", None)
                    .await?;
                return Ok(run.told("done"));
            }
            if run.ask(items, &caller).await? == BudgetState::Spent {
                return run.pause(reason::BUDGET_SPENT, "its money is spent").await;
            }
        }
    }
}

/// Whether what a batch may cost was enough.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum BudgetState {
    Enough,
    Spent,
}

impl BatchRun {
    /// Asks items, some at once, and writes down what comes of them.
    async fn ask(&mut self, items: Vec<OpenItem>, caller: &Caller) -> Result<BudgetState, Error> {
        let asking = AtomicBool::new(true);
        let wanted = stream::iter(items).take_while(|_| ready(asking.load(Relaxed)));
        let (service, caller, budget) = (self.service.clone(), caller.clone(), self.budget.clone());
        let defaults = self.defaults.clone();
        // Tasks of their own: while something is written here they go on, and do not sit on what it
        // waits for.
        let task = |item: OpenItem| {
            let (service, caller, budget) = (service.clone(), caller.clone(), budget.clone());
            let (defaults, number) = (defaults.clone(), item.item);
            let asked =
                async move { service.ask_item(item, &defaults, &caller, budget.as_ref()).await };
            let asked = AbortOnDropHandle::new(tokio::spawn(asked.in_current_span()));
            // A question that panics fails, not its batch.
            async move { asked.await.unwrap_or_else(|panic| Ok(failed(number, &panic.into()))) }
        };
        let width = self.batch.concurrency.unwrap_or(super::CONCURRENCY) as usize;
        let mut ends = pin!(wanted.map(task).buffer_unordered(width));
        let (mut closed, mut written, mut money) =
            (Vec::new(), Instant::now(), BudgetState::Enough);
        // Why it stops, and until when it waits for what is under way: that has been paid for.
        let (mut stop, mut is_cancelled): (Option<(Error, tokio::time::Instant)>, bool) =
            (None, false);
        let soon = || tokio::time::Instant::now() + GRACE;
        // What was paid for is kept once the store is back.
        let when_it_is_back = || tokio::time::Instant::now() + STORE_IS_BACK;
        loop {
            let end = tokio::select! {
                // Dropped, calls under way end: others make them by now.
                () = self.lost.cancelled() => return Err(StoreError::NotHeld.into()),
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
                Some(Ok(ItemOutcome::OverBudget)) => money = BudgetState::Spent,
                // The store is in trouble: what is known is kept, and the job is tried again.
                Some(Err(error)) => drop(stop.get_or_insert_with(|| (error, when_it_is_back()))),
            }
            // Of all items, so that a run that goes on gets further than the one before. Who is to
            // stop is told above.
            let share = (self.done as f32 + closed.len() as f32) / self.batch.items.max(1) as f32;
            let _ = self.progress.report("asking", share);
            if closed.len() >= WRITE_AFTER || written.elapsed() >= WRITE_EVERY {
                written = Instant::now();
                match self.write(&mut closed).await {
                    Ok(is_wanted) => drop(asking.fetch_and(is_wanted, Relaxed)),
                    Err(error) => drop(stop.get_or_insert_with(|| (error, when_it_is_back()))),
                }
            }
            if money == BudgetState::Spent || stop.is_some() {
                asking.store(false, Relaxed);
            }
        }
        self.write(&mut closed).await?;
        stop.map_or(Ok(money), |(error, _)| Err(error))
    }

    /// Writes down what came of items; whether more are wanted.
    async fn write(&mut self, closed: &mut Vec<ClosedItem>) -> Result<bool, Error> {
        self.service.batch_repository.close_batch_items(&self.hold, &self.batch.id, closed).await?;
        for item in closed.drain(..) {
            self.service.metrics.questions.item(&item.status);
            self.done += 1;
        }
        // A key that is refused by now is found so before the next items.
        Ok(self.service.keyring.caller_of(self.batch.key_id.as_deref()).is_ok()
            && self.is_wanted().await?)
    }

    /// Whether nobody has paused, cancelled or removed it.
    async fn is_wanted(&self) -> Result<bool, Error> {
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
            .move_batch(&self.batch.id, &["running"], "paused", Some(reason))
            .await?;
        Ok(self.told(why))
    }

    fn told(&self, why: &str) -> String {
        format!("{} of {} questions asked: {why}", self.done, self.batch.items)
    }
}

impl BatchRunner {
    /// Asks one question, or finds the answer it got before a server was killed. Only what is wrong
    /// with the store itself is an error.
    async fn ask_item(
        &self,
        open: OpenItem,
        defaults: &BatchDefaults,
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
                // What can not be paid for waits; it is not answered by something else.
                Ok(request)
                    if budget.is_some()
                        && self.vlm.is_some()
                        && request.reasoner == ReasonerChoice::Auto =>
                {
                    GroundRequest { reasoner: ReasonerChoice::Vlm, ..request }
                }
                Ok(request) => request,
                Err(error) => return Ok(failed(item, &error)),
            };
        let (mut tries, mut wait) = (0, FIRST_WAIT);
        loop {
            let asker = QuestionCaller {
                caller: caller.clone(),
                answer_id: answer_id.clone(),
                pays: budget.cloned(),
                is_batch: true,
                may_name: true,
            };
            match self.grounding_service.ground_for(&scene_id, request.clone(), asker).await {
                Ok(Answer { stored: false, .. }) => return Err(Error::AnswerNotKept),
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
                Err(Error::Overloaded) => sleep(STEP_ASIDE).await,
                // The batch's own money, its key's or the server's of today: it waits. What the
                // question itself may cost will not grow.
                Err(Error::OverBudget(OverBudget { of, .. })) if of != OF_QUESTION => {
                    return Ok(ItemOutcome::OverBudget);
                }
                // Nothing of this kind can be asked now: the batch is put off, and no item fails
                // for it.
                Err(error @ (Error::Store(_) | Error::Io(_) | Error::VlmDown { .. })) => {
                    return Err(error);
                }
                Err(error) if error.is_transient() && tries + 1 < TRIES => {
                    sleep(wait).await;
                    (tries, wait) = (tries + 1, wait * 2);
                }
                Err(error) => return Ok(failed(item, &error)),
            }
        }
    }
}

/// Of what is told about an item that failed: it repeats what was asked, and is stored with every
/// item.
const MAX_DETAIL_CHARS: usize = 500;

fn shortened(text: &str) -> String {
    match text.char_indices().nth(MAX_DETAIL_CHARS) {
        Some((cut, _)) => format!("{}...", &text[..cut]),
        None => text.to_owned(),
    }
}

fn failed(item: u32, error: &Error) -> ItemOutcome {
    let detail = match error {
        Error::Invalid { pointer, detail } => {
            format!("{}: {}", shortened(pointer), shortened(detail))
        }
        other => shortened(&other.to_string()),
    };
    let error = Some((error.code().to_owned(), detail));
    ItemOutcome::Closed(ClosedItem { item, status: "failed".into(), cost_usd: 0.0, error })
}

/// Whose budget it is, in messages.
const THIS_BATCH: &str = "this batch";

/// What a batch wants to know of an answer that is kept.
#[derive(Deserialize)]
struct AnswerSummary {
    status: String,
    usage: Usage,
}
