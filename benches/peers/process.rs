//! A peer as a long-lived child process: one command and one answer per line, timed by the peer
//! itself (`protocol.py`).

use crate::duel::Run;
use anyhow::{Context, anyhow, bail, ensure};
use std::cell::RefCell;
use std::fs::File;
use std::io::{BufRead, BufReader, Read, Seek, Write};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};

/// A running peer, or the reason why there is none.
pub struct Peer {
    process: Result<RefCell<Process>, String>,
    /// Its answers to the preparing commands.
    pub prepared: Vec<Run>,
}

impl Peer {
    /// Starts a script of `benches/peers` and sends it its input before anything is timed.
    pub fn start(python: Option<&str>, script: &str, commands: &[String]) -> Self {
        let started = python.context("no --python PYTHON given").and_then(|python| {
            let mut process = Process::start(python, script)?;
            let prepared = commands
                .iter()
                .map(|command| process.ask(command))
                .collect::<anyhow::Result<_>>()?;
            Ok((process, prepared))
        });
        match started {
            Ok((process, prepared)) => Self { process: Ok(RefCell::new(process)), prepared },
            Err(e) => Self::missing(format!("{e:#}")),
        }
    }

    pub fn missing(why: String) -> Self {
        Self { process: Err(why), prepared: Vec::new() }
    }

    pub fn ask(&self, command: &str) -> anyhow::Result<Run> {
        let process = self.process.as_ref().map_err(|why| anyhow!("{why}"))?;
        process.borrow_mut().ask(command)
    }

    /// Returns library and language with their versions, if the peer runs.
    pub fn versions(&self) -> Option<String> {
        self.process.as_ref().ok().map(|process| process.borrow().versions.clone())
    }
}

/// A running peer. It ends when its stdin closes.
struct Process {
    child: Child,
    commands: Option<ChildStdin>,
    answers: BufReader<ChildStdout>,
    /// Its error output; the last line says why it ended.
    complaints: File,
    /// Library and language, as the peer names them.
    versions: String,
}

impl Process {
    /// Waits until the script has imported its libraries.
    fn start(python: &str, script: &str) -> anyhow::Result<Self> {
        let complaints = tempfile::tempfile()?;
        let mut child = Command::new(python)
            .args(["-B", &format!("{}/benches/peers/{script}", env!("CARGO_MANIFEST_DIR"))])
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(complaints.try_clone()?)
            .spawn()
            .with_context(|| python.to_owned())?;
        let commands = child.stdin.take();
        let answers = BufReader::new(child.stdout.take().context("no stdout")?);
        let mut process = Self { child, commands, answers, complaints, versions: String::new() };
        let line = process.line()?;
        line.strip_prefix("ready ")
            .with_context(|| line.clone())?
            .clone_into(&mut process.versions);
        Ok(process)
    }

    /// Sends one command and waits for its answer.
    fn ask(&mut self, command: &str) -> anyhow::Result<Run> {
        writeln!(self.commands.as_ref().context("closed")?, "{command}")
            .with_context(|| self.last_complaint())?;
        let line = self.line()?;
        let (ms, gives) = line.split_once(' ').unwrap_or((&line, ""));
        ensure!(ms != "error", "{gives}");
        Ok(Run { ms: ms.parse().with_context(|| line.clone())?, gives: gives.to_owned() })
    }

    fn line(&mut self) -> anyhow::Result<String> {
        let mut line = String::new();
        if self.answers.read_line(&mut line)? == 0 {
            bail!("{}", self.last_complaint());
        }
        Ok(line.trim_end().to_owned())
    }

    fn last_complaint(&mut self) -> String {
        let mut text = String::new();
        let read =
            self.complaints.rewind().and_then(|()| self.complaints.read_to_string(&mut text));
        let last = text.lines().rfind(|line| !line.trim().is_empty());
        read.ok()
            .and(last)
            .map_or_else(|| "it ended without a word".to_owned(), |line| line.trim().to_owned())
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        self.commands = None;
        // All its answers have been read, so its exit status does not matter.
        let _ = self.child.wait();
    }
}
