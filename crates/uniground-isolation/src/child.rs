//! The parent's side: starts a child process, follows it, and kills it when it takes too long or is
//! cancelled.

use super::wire::{Message, Request};
use super::{ReadError, Task, TaskOutcome};
use camino::Utf8PathBuf;
use std::borrow::Cow;
use std::io::{self, BufRead, BufReader, Read, Write};
use std::os::unix::process::ExitStatusExt;
use std::path::PathBuf;
use std::process::{Child, ChildStderr, ChildStdout, Command, ExitStatus, Stdio};
use std::sync::mpsc::{self, RecvTimeoutError, Sender};
use std::thread;
use std::time::{Duration, Instant};
use uniground_geometry::progress::{Cancelled, Progress};
use uniground_ingest::{IngestError, IngestErrorKind};

/// The subcommand that runs the child.
pub const SUBCOMMAND: &str = "isolated-reader";
/// Polling interval for cancellation and timeout.
const POLL_INTERVAL: Duration = Duration::from_millis(50);
/// The last bytes of a child's stderr that are stored.
const STDERR_BYTES: usize = 4 << 10;
/// Longest message of a child.
const MAX_MESSAGE_BYTES: u64 = 1 << 20;
/// The only environment variables that a child gets; it must not see secrets.
const ENVIRONMENT: [&str; 4] = ["LD_LIBRARY_PATH", "PATH", "RAYON_NUM_THREADS", "TMPDIR"];
/// Stages that a child reports, under the names of the jobs.
const STAGES: [&str; 6] =
    ["import", "check_reprojection", "levelling", "fuse_cloud", "look_through", "check_pictures"];
const SIGKILL: i32 = 9;
const SIGXCPU: i32 = 24;

/// Settings of child processes.
#[derive(Debug)]
pub struct ChildProcess {
    program: PathBuf,
    memory_bytes: u64,
}

/// How a child ended.
struct ChildExit {
    status: ExitStatus,
    last: Option<Result<TaskOutcome, ReadError>>,
    stopped: Option<StopReason>,
    stderr: String,
}

/// Why the service killed a child.
#[derive(Clone, Copy, PartialEq, Eq)]
enum StopReason {
    Cancelled,
    TimedOut,
}

impl ChildProcess {
    /// Uses child processes of `program`, or of this program if `None`. An import can use
    /// `memory_bytes`.
    #[must_use]
    pub fn new(program: Option<Utf8PathBuf>, memory_bytes: u64) -> Self {
        Self {
            program: program.map_or_else(this_program, Utf8PathBuf::into_std_path_buf),
            memory_bytes,
        }
    }

    /// Runs a task in a child, with a share of the memory; blocks.
    pub(super) fn run(
        &self,
        task: &Task,
        memory_share: u64,
        progress: &Progress,
    ) -> Result<TaskOutcome, ReadError> {
        let (memory_bytes, time_limit) = (self.memory_bytes / memory_share, task.time_limit());
        let request =
            Request { task: Cow::Borrowed(task), memory_bytes, cpu_s: cpu_seconds(time_limit) };
        let mut request = serde_json::to_vec(&request).map_err(io::Error::other)?;
        request.push(b'\n');
        let environment =
            ENVIRONMENT.iter().filter_map(|name| Some((*name, std::env::var_os(name)?)));
        let child = Command::new(&self.program)
            .arg(SUBCOMMAND)
            .env_clear()
            .envs(environment)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()?;
        let ended = follow(child, &request, Instant::now() + time_limit, progress)?;
        task_outcome(ended, task, memory_bytes, time_limit)
    }
}

/// Returns the running program. On Linux this works even after its file was replaced by a newer
/// version.
fn this_program() -> PathBuf {
    let of_process = PathBuf::from("/proc/self/exe");
    match of_process.exists() {
        true => of_process,
        false => std::env::current_exe().unwrap_or_else(|_| PathBuf::from("uniground")),
    }
}

/// Converts a time limit to CPU seconds of all threads together.
fn cpu_seconds(time: Duration) -> u64 {
    let cores = thread::available_parallelism().map_or(1, usize::from) as u64;
    time.as_secs().saturating_mul(cores)
}

/// Follows a child until it has ended or was killed.
fn follow(
    mut child: Child,
    request: &[u8],
    deadline: Instant,
    progress: &Progress,
) -> Result<ChildExit, ReadError> {
    let (stdin, stdout, stderr) = (child.stdin.take(), child.stdout.take(), child.stderr.take());
    thread::scope(|scope| {
        let (sender, messages) = mpsc::channel();
        if let Some(stdout) = stdout {
            scope.spawn(move || forward_messages(stdout, &sender));
        }
        let stderr = stderr.map(|stderr| scope.spawn(move || read_tail(stderr)));
        // Keep stdin open: a child ends when its stdin is closed.
        let mut stdin = stdin;
        // A child that has ended already is handled below.
        let _ = stdin.as_mut().map(|stdin| stdin.write_all(request));
        let (mut last, mut stopped) = (None, None);
        loop {
            match messages.recv_timeout(POLL_INTERVAL) {
                Ok(Message::Progress { stage, done }) => {
                    let stage =
                        STAGES.into_iter().find(|known| *known == stage).unwrap_or(STAGES[0]);
                    // Cancellation is checked below.
                    let _ = progress.report(stage, done);
                }
                Ok(Message::Done(outcome)) => last = Some(Ok(outcome)),
                Ok(Message::Failed(failure)) => last = Some(Err(failure.into())),
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => break,
            }
            let why = match () {
                () if stopped.is_some() => None,
                () if progress.check().is_err() => Some(StopReason::Cancelled),
                () if Instant::now() >= deadline => Some(StopReason::TimedOut),
                () => None,
            };
            if why.is_some() {
                stopped = why;
                child.kill()?;
            }
        }
        let status = wait_for_exit(&mut child)?;
        drop(stdin);
        let stderr = stderr.and_then(|tail| tail.join().ok()).unwrap_or_default();
        Ok(ChildExit { status, last, stopped, stderr })
    })
}

/// Returns the exit status of a child that has closed its stdout. Kills a child that keeps running.
fn wait_for_exit(child: &mut Child) -> io::Result<ExitStatus> {
    const GRACE: Duration = Duration::from_secs(2);
    let closed = Instant::now();
    while closed.elapsed() < GRACE {
        if let Some(status) = child.try_wait()? {
            return Ok(status);
        }
        thread::sleep(Duration::from_millis(1));
    }
    child.kill()?;
    child.wait()
}

/// Forwards the messages of a child, until it ends or sends something else.
fn forward_messages(stdout: ChildStdout, to: &Sender<Message>) {
    let mut stdout = BufReader::new(stdout);
    let mut line = Vec::new();
    loop {
        line.clear();
        match (&mut stdout).take(MAX_MESSAGE_BYTES).read_until(b'\n', &mut line) {
            Ok(read) if read > 0 => {}
            _ => return,
        }
        let Ok(message) = serde_json::from_slice(&line) else { return };
        if to.send(message).is_err() {
            return;
        }
    }
}

/// Returns the end of a child's stderr.
fn read_tail(mut stderr: ChildStderr) -> String {
    let (mut tail, mut chunk) = (Vec::new(), [0; 1024]);
    while let Ok(read) = stderr.read(&mut chunk)
        && read > 0
    {
        tail.extend_from_slice(&chunk[..read]);
        let excess = tail.len().saturating_sub(STDERR_BYTES);
        tail.drain(..excess);
    }
    String::from_utf8_lossy(&tail).into_owned()
}

/// Returns the outcome of a task from the exit of its child.
fn task_outcome(
    ended: ChildExit,
    task: &Task,
    memory_bytes: u64,
    time_limit: Duration,
) -> Result<TaskOutcome, ReadError> {
    let ChildExit { status, last, stopped, stderr } = ended;
    if stopped == Some(StopReason::Cancelled) {
        return Err(IngestError::Cancelled(Cancelled).into());
    }
    let file = task.subject();
    let too_costly =
        |limit: String| Err(IngestError::TooCostly { file: file.clone(), limit }.into());
    let out_of_time = stopped == Some(StopReason::TimedOut) || status.signal() == Some(SIGXCPU);
    match last {
        Some(told) if status.success() => {
            if !stderr.trim().is_empty() {
                tracing::warn!(stderr = stderr.trim(), "decoder process wrote to its error output");
            }
            return told;
        }
        _ if out_of_time => return too_costly(format!("{} s", time_limit.as_secs())),
        // For example, the system is out of memory. The scan is not the cause.
        _ if status.signal() == Some(SIGKILL) => return Err(ReadError::Killed),
        // The child catches panics. An exit without an outcome is a bug of the program, not a fault
        // of the scan.
        _ if status.signal().is_none() => {
            return Err(io::Error::other(format!(
                "it exited with {status} without a result: {}",
                stderr.trim()
            ))
            .into());
        }
        _ => {}
    }
    tracing::warn!(%status, stderr = stderr.trim_end(), "decoder process crashed");
    if stderr.contains("memory allocation of") || stderr.contains("capacity overflow") {
        return too_costly(format!("{} MB of memory (--reader-memory-mb)", memory_bytes >> 20));
    }
    let message = format!("{file}: the reader crashed; the file is damaged or has another format");
    Err(IngestError::Reported { kind: IngestErrorKind::Malformed, message }.into())
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;
    use std::os::unix::fs::PermissionsExt;

    /// Runs a task with this shell script as its child.
    fn run(
        script: &str,
        is_cancelled: impl Fn() -> bool + Send + Sync + 'static,
    ) -> Result<TaskOutcome, ReadError> {
        let folder = tempfile::tempdir().unwrap();
        let program = Utf8PathBuf::from_path_buf(folder.path().join("reader")).unwrap();
        fs::write(&program, format!("#!/bin/sh\nread request\n{script}\n")).unwrap();
        fs::set_permissions(&program, fs::Permissions::from_mode(0o755)).unwrap();
        let task = Task::Inspect { folder: "/nowhere".into() };
        ChildProcess::new(Some(program), 64 << 20).run(
            &task,
            1,
            &Progress::new(|_, _| {}, is_cancelled),
        )
    }

    fn kind(result: Result<TaskOutcome, ReadError>) -> IngestErrorKind {
        match result {
            Err(ReadError::Ingest(error)) => error.kind(),
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn every_child_exit_maps_to_an_error() {
        let never = || false;
        let done = run(r#"echo '{"done":{"scan":{"name":"hall"}}}'"#, never).unwrap();
        assert_eq!(done, TaskOutcome::Scan { name: Some("hall".into()) });
        let failed = r#"echo '{"failed":{"kind":"EmptyScene","message":"nothing","file":null,"is_disk_full":false}}'"#;
        assert_eq!(kind(run(failed, never)), IngestErrorKind::EmptyScene);
        assert_eq!(kind(run("kill -ABRT $$", never)), IngestErrorKind::Malformed);
        assert_eq!(kind(run("kill -SEGV $$", never)), IngestErrorKind::Malformed);
        let out_of_memory =
            "echo 'memory allocation of 1099511627776 bytes failed' >&2; kill -ABRT $$";
        assert_eq!(kind(run(out_of_memory, never)), IngestErrorKind::TooCostly);
        assert_eq!(kind(run("kill -XCPU $$", never)), IngestErrorKind::TooCostly);
        assert!(matches!(run("kill -KILL $$", never), Err(ReadError::Killed)));
        assert_eq!(kind(run("exec sleep 60", || true)), IngestErrorKind::Cancelled);
        for without_outcome in ["exit 3", "exit 0", "echo no message; exit 0"] {
            assert!(
                matches!(run(without_outcome, never), Err(ReadError::Process(_))),
                "{without_outcome}"
            );
        }
        // Writes more than a pipe's buffer holds.
        let talkative =
            "i=0; while [ $i -lt 20000 ]; do echo filler >&2; i=$((i+1)); done; kill -ABRT $$";
        assert_eq!(kind(run(talkative, never)), IngestErrorKind::Malformed);
    }

    #[test]
    fn a_missing_reader_program_is_a_process_error() {
        let child = ChildProcess::new(Some("/nowhere/uniground".into()), 64 << 20);
        let task = Task::Inspect { folder: "/nowhere".into() };
        assert!(matches!(child.run(&task, 1, &Progress::silent()), Err(ReadError::Process(_))));
    }
}
