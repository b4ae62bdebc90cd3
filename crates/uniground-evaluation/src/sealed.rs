//! Ensures by types that ground truth is read only after ranking.
//!
//! Readers put the known data of a target into a [`Sealed`]. It opens with a [`Ranked`], and only a
//! finished reply becomes a `Ranked`. There are two named exceptions: annotations as the source of
//! instances, and hints of a paper-compatible run. The report marks both.

use super::reply::Reply;

/// Data that a system must not see before it has answered.
#[derive(Debug, Clone)]
pub struct Sealed<T>(T);

/// A final reply.
#[derive(Debug, Clone)]
pub struct Ranked(Reply);

/// Permission to use annotations as instances: the sources `oracle` and `oracle-boxes`.
#[derive(Debug, Clone, Copy)]
pub struct OracleRun(pub(super) ());

/// Permission to pass on target class and annotated anchors: `--paper-compatible`.
#[derive(Debug, Clone, Copy)]
pub struct PaperCompatibleRun(pub(super) ());

impl<T> Sealed<T> {
    #[must_use]
    pub fn new(truth: T) -> Self {
        Self(truth)
    }

    /// Opens the truth to judge a finished reply.
    #[must_use]
    pub fn judge(&self, _finished: &Ranked) -> &T {
        &self.0
    }

    #[must_use]
    pub fn as_instances(&self, _permission: OracleRun) -> &T {
        &self.0
    }

    #[must_use]
    pub fn as_hints(&self, _permission: PaperCompatibleRun) -> &T {
        &self.0
    }

    /// Returns the truth for the suite that holds it: readers resolve targets among annotations,
    /// and stored replies are identified by its hash.
    pub(super) fn for_reader(&self) -> &T {
        &self.0
    }
}

impl Ranked {
    #[must_use]
    pub fn new(reply: Reply) -> Self {
        Self(reply)
    }

    /// A failed question counts as finished, with an empty answer.
    pub(super) fn failed() -> Self {
        Self(Reply::empty())
    }

    #[must_use]
    pub fn reply(&self) -> &Reply {
        &self.0
    }
}
