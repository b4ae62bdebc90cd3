//! The child's side: sets its limits, then runs the task.

use super::wire::{Message, Request};
use rustix::process::{Resource, Rlimit, setrlimit};
use std::io::{self, BufRead, Read, Write};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};
use uniground_geometry::background;
use uniground_geometry::progress::Progress;
use uniground_ingest::IngestError;

/// Minimum interval of progress messages.
const PROGRESS_EVERY: Duration = Duration::from_millis(100);

/// Reads a request from stdin, runs it within its limits and writes the outcome to stdout.
///
/// # Errors
/// Errors of stdin and stdout, and an invalid request.
pub fn run() -> io::Result<()> {
    let mut line = String::new();
    io::stdin().lock().read_line(&mut line)?;
    let Request { task, memory_bytes, cpu_s } = serde_json::from_str(&line)?;
    set_limit(Resource::Core, 0);
    set_limit(Resource::Cpu, cpu_s);
    limit_memory(memory_bytes);
    prefer_for_oom_killer();
    exit_with_parent()?;
    let pool = background::low_priority_pool().map_err(io::Error::other)?;
    let subject = task.subject();
    // A panic has already printed its message and location to stderr.
    let done = catch_unwind(AssertUnwindSafe(|| pool.install(|| task.run(&report_progress()))))
        .unwrap_or_else(|_| {
            Err(IngestError::Malformed { file: subject, reason: "the file is damaged".into() })
        });
    send_message(&match done {
        Ok(outcome) => Message::Done(outcome),
        Err(error) => Message::Failed(error.into()),
    })
}

/// Limits the memory of this process. On Linux this limits its data, not its address space, because
/// threads reserve more address space than they use.
fn limit_memory(bytes: u64) {
    #[cfg(target_os = "linux")]
    set_limit(Resource::Data, bytes);
    #[cfg(not(target_os = "linux"))]
    set_limit(Resource::As, bytes);
}

/// Makes the system kill this process before the service when memory runs out.
fn prefer_for_oom_killer() {
    #[cfg(target_os = "linux")]
    if let Err(error) = std::fs::write("/proc/self/oom_score_adj", "1000") {
        tracing::debug!(%error, "out-of-memory score could not be raised");
    }
}

fn set_limit(resource: Resource, most: u64) {
    if let Err(error) = setrlimit(resource, Rlimit { current: Some(most), maximum: Some(most) }) {
        eprintln!("a limit could not be set: {error}");
    }
}

/// Ends this process when the service is gone: the service keeps stdin open while it waits for the
/// outcome.
fn exit_with_parent() -> io::Result<()> {
    let watch = || {
        let mut rest = [0; 64];
        while io::stdin().lock().read(&mut rest).is_ok_and(|read| read > 0) {}
        std::process::abort()
    };
    std::thread::Builder::new().name("parent".into()).spawn(watch).map(drop)
}

fn report_progress() -> Progress {
    let last_report = Arc::new(Mutex::new(None::<Instant>));
    let sink = move |stage: &'static str, done: f32| {
        let mut last_report = last_report.lock().unwrap_or_else(PoisonError::into_inner);
        if last_report.is_none_or(|last_report| last_report.elapsed() >= PROGRESS_EVERY) {
            *last_report = Some(Instant::now());
            // Sending fails only if the service is gone or is killing this process.
            let _ = send_message(&Message::Progress { stage: stage.to_owned(), done });
        }
    };
    Progress::new(sink, || false)
}

fn send_message(message: &Message) -> io::Result<()> {
    let mut line = serde_json::to_vec(message)?;
    line.push(b'\n');
    let mut stdout = io::stdout().lock();
    stdout.write_all(&line)?;
    stdout.flush()
}
