//! Asking the questions of a batch.

use super::reason;
use crate::error::Error;
use crate::jobs::{JobContext, JobFailure, JobKind, Retry};
use crate::service::answers::Asker;
use crate::service::{Caller, Service, job_failure, until_cancelled};
use crate::store::{BatchRow, ClosedItem, OpenItem};
use futures::future::ready;
use futures::{StreamExt, stream};
use serde::{Deserialize, Serialize};
use std::pin::pin;
use std::sync::atomic::AtomicBool;
use std::sync::atomic::Ordering::Relaxed;
use std::time::{Duration, Instant};
use tokio::time::{sleep, timeout_at};
use uniground_core::models::chat::{Budget, OverBudget};
use uniground_core::scene_parsing::ParseError;
use uniground_types::answer::{Answer, Usage};
use uniground_types::question::{GroundRequest, ReasonerChoice};

/// Asks batches. Some at once: a short one need not wait for a long one.
pub struct BatchJob(pub Service);

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
/// Tries of a question that failed in a way that may pass, and the wait before the second; each later one is twice as long.
const TRIES: u32 = 4;
const FIRST_WAIT: Duration = Duration::from_secs(1);
/// How long a question waits that found all places taken: people come first.
const STEP_ASIDE: Duration = Duration::from_millis(50);

/// How long questions under way may take once the job is to stop. As long as requests have when the server stops.
const GRACE: Duration = Duration::from_secs(5);

/// How an item ended.
enum End {
    Closed(ClosedItem),
    /// The batch's money is spent: it waits.
    OverBudget,
}

impl Service {
    async fn run_batch(&self, JobContext { payload, progress, .. }: JobContext<Payload>) -> Result<String, Error> {
        // Deleted meanwhile, or submitted by a server that did not live to see it through.
        let Some(batch) = self.store.batch(&payload.batch_id).await? else { return Ok("there is no such batch any more".into()) };
        let (numbers, spent) = self.store.batch_figures(&batch.id).await?;
        let before: u32 = numbers.values().sum();
        let (mut done, open) = (0, batch.items.saturating_sub(before).max(1));
        let budget = batch.max_cost_usd.map(|usd| Budget::new(THIS_BATCH, usd).with_spent(spent));
        let width = batch.concurrency.unwrap_or(super::CONCURRENCY) as usize;
        loop {
            // Somebody may have paused or cancelled it.
            if self.store.batch(&batch.id).await?.is_none_or(|batch| batch.state != "running") {
                return Ok(told(before + done, &batch, "stopped"));
            }
            let Ok(caller) = self.keys.caller_of(batch.key_id.as_deref()) else {
                self.store.move_batch(&batch.id, &["running"], "paused", Some(reason::KEY_REFUSED)).await?;
                return Ok(told(before + done, &batch, "its key is refused"));
            };
            let items = self.store.open_batch_items(&batch.id, WINDOW).await?;
            if items.is_empty() {
                self.store.move_batch(&batch.id, &["running"], "succeeded", None).await?;
                return Ok(told(before + done, &batch, "done"));
            }
            let asking = AtomicBool::new(true);
            let wanted = stream::iter(items).take_while(|_| ready(asking.load(Relaxed)));
            let mut ends = pin!(wanted.map(|item| self.ask_item(item, &caller, budget.as_ref())).buffer_unordered(width));
            let (mut closed, mut written, mut over_budget) = (Vec::new(), Instant::now(), false);
            let (mut stop, mut last_call): (Option<Error>, _) = (None, None);
            loop {
                let end = if let Some(at) = last_call {
                    // What is under way has been paid for: it gets a while to end.
                    timeout_at(at, ends.next()).await.ok().flatten()
                } else {
                    tokio::select! {
                        end = ends.next() => end,
                        cancelled = until_cancelled(&progress) => {
                            (stop, last_call) = (Some(ParseError::from(cancelled).into()), Some(tokio::time::Instant::now() + GRACE));
                            asking.store(false, Relaxed);
                            continue;
                        }
                    }
                };
                match end {
                    None => break,
                    Some(Ok(End::Closed(item))) => closed.push(item),
                    Some(Ok(End::OverBudget)) => over_budget = true,
                    // The store is in trouble: what is known is kept, and the job is tried again.
                    Some(Err(error)) => stop = Some(error),
                }
                // Who is to stop is told above.
                let _ = progress.report("asking", (done as f32 + closed.len() as f32) / open as f32);
                if closed.len() >= WRITE_AFTER || written.elapsed() >= WRITE_EVERY {
                    self.close_items(&batch.id, &closed).await?;
                    done += closed.len() as u32;
                    (closed, written) = (Vec::new(), Instant::now());
                    if self.store.batch(&batch.id).await?.is_none_or(|batch| batch.state != "running") {
                        asking.store(false, Relaxed);
                    }
                }
                if over_budget || stop.is_some() {
                    asking.store(false, Relaxed);
                }
            }
            self.close_items(&batch.id, &closed).await?;
            done += closed.len() as u32;
            if let Some(error) = stop {
                return Err(error);
            }
            if over_budget {
                self.store.move_batch(&batch.id, &["running"], "paused", Some(reason::BUDGET_SPENT)).await?;
                return Ok(told(before + done, &batch, "its money is spent"));
            }
        }
    }

    async fn close_items(&self, batch_id: &str, closed: &[ClosedItem]) -> Result<(), Error> {
        self.store.close_batch_items(batch_id, closed).await?;
        closed.iter().for_each(|item| self.metrics.questions.item(&item.status));
        Ok(())
    }

    /// Asks one question, or finds the answer it got before a server was killed. Only what is wrong with the store itself is an error.
    async fn ask_item(&self, open: OpenItem, caller: &Caller, budget: Option<&Budget>) -> Result<End, Error> {
        let OpenItem { item, scene_id, request, answer_id } = open;
        if let Some(kept) = self.store.answer(&answer_id).await? {
            let Kept { status, usage } = serde_json::from_str(&kept.body)?;
            return Ok(End::Closed(ClosedItem { item, status, cost_usd: usage.cost_usd, error: None }));
        }
        let failed = |error: &Error| {
            let error = Some((error.code().to_owned(), error.to_string()));
            End::Closed(ClosedItem { item, status: "failed".into(), cost_usd: 0.0, error })
        };
        let request: GroundRequest = match super::submission::question_of(&request) {
            // What can not be paid for waits; it is not answered by something else.
            Ok(request) if budget.is_some() && self.vlm.is_some() && request.reasoner == ReasonerChoice::Auto => {
                GroundRequest { reasoner: ReasonerChoice::Vlm, ..request }
            }
            Ok(request) => request,
            Err(error) => return Ok(failed(&error)),
        };
        let (mut tries, mut wait) = (0, FIRST_WAIT);
        loop {
            let asker = Asker { caller: caller.clone(), answer_id: answer_id.clone(), pays: budget.cloned(), is_batch: true };
            match self.ground_for(&scene_id, request.clone(), asker).await {
                Ok(Answer { stored: false, .. }) => return Err(Error::AnswerNotKept),
                Ok(answer) => {
                    let status = serde_json::to_value(answer.status)?.as_str().unwrap_or_default().to_owned();
                    return Ok(End::Closed(ClosedItem { item, status, cost_usd: answer.usage.cost_usd, error: None }));
                }
                Err(Error::Overloaded) => sleep(STEP_ASIDE).await,
                Err(Error::OverBudget(OverBudget { of: THIS_BATCH, .. })) => return Ok(End::OverBudget),
                Err(error @ (Error::Store(_) | Error::Io(_))) => return Err(error),
                Err(error) if error.may_pass() && tries + 1 < TRIES => {
                    sleep(wait).await;
                    (tries, wait) = (tries + 1, wait * 2);
                }
                Err(error) => return Ok(failed(&error)),
            }
        }
    }
}

/// Whose budget it is, in messages.
const THIS_BATCH: &str = "this batch";

/// What a batch wants to know of an answer that is kept.
#[derive(Deserialize)]
struct Kept {
    status: String,
    usage: Usage,
}

fn told(done: u32, batch: &BatchRow, why: &str) -> String {
    format!("{done} of {} questions asked: {why}", batch.items)
}
