//! Stage 2 with a vision-language model: contextual semantic-spatial reasoning in a closed loop (paper, Algorithm 1; METHOD section 4).
//!
//! ```text
//! brief (candidates, anchors, directions) -> exhibits (render, collages) -> prompt -> model -> reply -> checks
//!                                                                              ^------- what was wrong -----|
//! ```
//! The geometry has been at work before: candidates, anchors and directions are the built-in reasoner's. The model decides; what it says
//! is checked, and asked about again where it does not hold together. Every call is remembered by its [`Session`].

mod brief;
mod consistency;
mod decision;
mod exhibits;
pub mod naming;
mod prompt;
pub mod reply;

pub use brief::{Brief, BriefAnchor, BriefCandidate};
pub use decision::{Decision, Outcome};
pub use exhibits::{Exhibits, PictureSettings, collages, global};
pub use prompt::reasoner_name;

use crate::models::chat::{AskError, ChatRequest, Picture, Session};
use prompt::Correction;
use reply::{Choice, Reply};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use utoipa::ToSchema;

/// Calls one question may take. METHOD: 3.
pub const MAX_CALLS: u32 = 3;

/// Parts of the paper's prompt left out; only a vision-language model has a prompt.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Hash, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Ablation {
    #[default]
    Full,
    NoGlobal,
    NoCandidate,
    SimplePrompt,
}

/// What a vision-language model is shown of the candidates.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Hash, Serialize, Deserialize, ToSchema, clap::ValueEnum)]
#[serde(rename_all = "snake_case")]
pub enum EvidenceMode {
    /// Photographs of every candidate with every question, as in the paper.
    #[default]
    Full,
    /// Names that a model gave once, and a smaller render; photographs only of candidates the question can not tell apart by name.
    CachedNames,
}

/// How a model is asked.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Options {
    pub ablation: Ablation,
    pub evidence: EvidenceMode,
    /// Ask for JSON by schema instead of six lines.
    pub json: bool,
}

/// What one question is decided from.
#[derive(Debug, Clone)]
pub struct Conversation<'a> {
    pub brief: &'a Brief,
    pub exhibits: &'a Exhibits,
    pub options: Options,
    /// Names that were given before, by id.
    pub names: BTreeMap<u32, String>,
    /// A sheet of candidates without a name, to be named first; only with [`EvidenceMode::CachedNames`].
    pub unnamed: Option<(Picture, Vec<u32>)>,
}

/// A question the model could not be asked, and names that were paid for before that.
#[derive(Debug, thiserror::Error)]
#[error("{error}")]
pub struct Undecided {
    #[source]
    pub error: AskError,
    pub new_names: BTreeMap<u32, String>,
}

/// Asks until the answer holds together, at most as often as the session allows.
///
/// # Errors
/// [`Undecided`] when the model could not be asked and has said nothing that can be used before.
pub async fn decide(conversation: &Conversation<'_>, session: &mut Session<'_>) -> Result<Decision, Undecided> {
    let Conversation { brief, options, .. } = conversation;
    let mut decision = Decision::default();
    let mut names = conversation.names.clone();
    if let Some((sheet, ids)) = conversation.unnamed.clone().filter(|_| options.uses_names()) {
        let named = session.ask("naming", naming::request(sheet, &ids)).await;
        let text = named.map_err(|error| Undecided { error, new_names: BTreeMap::new() })?;
        decision.new_names = naming::read(&text, &ids);
        names.extend(decision.new_names.clone());
    }
    // What could not be named is shown instead.
    names.retain(|_, name| options.uses_names() && !name.is_empty());
    let shown = conversation.shown(&names);
    let mut request = prompt::spatial(conversation, &shown, &names);
    let (mut purpose, mut looked_again) = ("spatial", false);
    loop {
        let text = match session.ask(purpose, request).await {
            Ok(text) => text,
            Err(error) if decision.settle(&error) => break,
            Err(error) => return Err(Undecided { error, new_names: decision.new_names }),
        };
        let mut reply = reply::read(&text);
        // Nobody has asked for a format here.
        if options.ablation == Ablation::SimplePrompt && reply.predicted == Choice::Missing {
            reply.predicted = reply::only_id(&text, |id| brief.is_candidate(id)).map_or(Choice::Missing, Choice::Id);
        }
        names.extend(
            reply
                .candidate_names
                .iter()
                .filter(|(id, _)| brief.is_candidate(**id))
                .map(|(id, name)| (*id, name.clone())),
        );
        let correction = wrong_with(&reply, brief, &names, looked_again);
        decision.take(reply, brief);
        let Some(correction) = correction else { break };
        decision.corrections.push(told(&correction));
        if session.calls_left() == 0 {
            break;
        }
        looked_again |= matches!(correction, Correction::Inconsistent { .. });
        purpose = correction.purpose();
        request = prompt::corrected(conversation, &conversation.shown_again(&correction, &shown), &names, &correction);
    }
    decision.names = names;
    decision.project(brief);
    Ok(decision)
}

impl Options {
    /// Names stand for what a model has seen in photographs: an ablation of these leaves them out as well.
    fn uses_names(self) -> bool {
        self.evidence == EvidenceMode::CachedNames && self.ablation != Ablation::NoCandidate
    }
}

impl Conversation<'_> {
    /// What the model is asked first about a question whose candidates have names, where names are used.
    #[must_use]
    pub fn first_request(&self) -> ChatRequest {
        let mut names = self.names.clone();
        names.retain(|_, name| self.options.uses_names() && !name.is_empty());
        prompt::spatial(self, &self.shown(&names), &names)
    }

    /// The pictures of the first call.
    fn shown(&self, names: &BTreeMap<u32, String>) -> Exhibits {
        let mut shown = self.exhibits.clone();
        match self.options.ablation {
            Ablation::NoGlobal => shown.global = None,
            Ablation::NoCandidate => shown.collages.clear(),
            Ablation::Full | Ablation::SimplePrompt => {}
        }
        if self.options.uses_names() {
            let needed = consistency::to_be_looked_at(self.brief, names);
            shown.collages.retain(|id, _| needed.contains(id));
        }
        shown
    }

    /// The pictures of another call. Paper: the renders and the images of the candidate that was chosen.
    fn shown_again(&self, correction: &Correction, shown: &Exhibits) -> Exhibits {
        match correction {
            Correction::Inconsistent { id, .. } => {
                let of_chosen = self.exhibits.collages.get_key_value(id).filter(|_| self.options.ablation != Ablation::NoCandidate);
                Exhibits { global: shown.global.clone(), collages: of_chosen.map(|(id, p)| (*id, p.clone())).into_iter().collect() }
            }
            Correction::OutOfSet { .. } | Correction::Unreadable { .. } => shown.clone(),
        }
    }
}

/// What is to be asked again, and why.
fn wrong_with(reply: &Reply, brief: &Brief, names: &BTreeMap<u32, String>, looked_again: bool) -> Option<Correction> {
    match reply.predicted {
        Choice::Nothing => None,
        Choice::Missing => Some(Correction::Unreadable { why: "no \"Predicted ID\" could be read".into() }),
        Choice::Contradiction(a, b) if a == b => Some(Correction::Unreadable { why: format!("the ID is both {a} and none") }),
        Choice::Contradiction(a, b) => Some(Correction::Unreadable { why: format!("the ID is both {a} and {b}") }),
        Choice::Id(id) if !brief.is_candidate(id) => Some(Correction::OutOfSet { id }),
        Choice::Id(_) if looked_again => None,
        Choice::Id(id) => consistency::disagreement(&brief.target, names, id, reply).map(|why| Correction::Inconsistent { id, why }),
    }
}

impl Correction {
    fn purpose(&self) -> &'static str {
        match self {
            Self::OutOfSet { .. } => "out_of_set",
            Self::Unreadable { .. } => "unreadable",
            Self::Inconsistent { .. } => "inconsistent",
        }
    }
}

/// For the trace.
fn told(correction: &Correction) -> String {
    match correction {
        Correction::OutOfSet { id } => format!("the model answered ID {id}, which is no candidate"),
        Correction::Unreadable { why } => format!("the model answered something of which {why}"),
        Correction::Inconsistent { id, why } => format!("the model answered ID {id}, but {why}"),
    }
}

#[cfg(test)]
mod tests;
