//! Ground truth is read after ranking only: the type makes anything else impossible.
//!
//! Readers put what is known of a target into a [`Sealed`]; it opens against a [`Ranked`], and the
//! only way to a `Ranked` is a finished reply. Two doors beside that one are named for what they
//! are: annotations that are themselves the source of instances, and hints of a paper-compatible
//! run. Both are marked in the report.

use super::reply::Reply;

/// Something a system must not see before it has answered.
#[derive(Debug, Clone)]
pub struct Sealed<T>(T);

/// A reply that can not be changed any more.
#[derive(Debug, Clone)]
pub struct Ranked(Reply);

/// Permission to use annotations as instances: the sources `oracle` and `oracle-boxes`.
#[derive(Debug, Clone, Copy)]
pub struct OracleRun(pub(super) ());

/// Permission to hand over target class and annotated anchors: `--paper-compatible`.
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

    /// The truth within the suite that carries it: readers resolve targets among annotations, and
    /// kept replies are known by its hash.
    pub(super) fn for_reader(&self) -> &T {
        &self.0
    }
}

impl Ranked {
    #[must_use]
    pub fn of(reply: Reply) -> Self {
        Self(reply)
    }

    /// A question that failed is finished as well: as an answer of nothing.
    pub(super) fn failed() -> Self {
        Self(Reply::nothing())
    }

    #[must_use]
    pub fn reply(&self) -> &Reply {
        &self.0
    }
}
