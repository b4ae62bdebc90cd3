//! Stage 2 with a vision-language model: contextual semantic-spatial reasoning in a closed loop
//! (paper, Algorithm 1; docs/METHOD.md, section 4).
//!
//! ```text
//! context -> evidence (render, collages) -> prompt -> model -> reply -> checks
//!                                           ^------ what was wrong -------|
//! ```
//! The built-in reasoner runs first: candidates, anchors and directions come from it. The model
//! decides. Its reply is checked, and an inconsistent reply makes the model be asked again. The
//! [`Session`] records every call.

mod consistency;
mod decision;
mod finding;
mod marked_photographs;
pub mod naming;
mod photographs;
mod picture_limits;
mod points;
mod prompt;
mod prompt_context;
pub mod reply;
mod visual_evidence;

pub(crate) use consistency::matches as matches_phrase;
pub use decision::{Decision, Outcome};
pub use finding::{Finding, find};
pub use marked_photographs::{MarkedPhotographs, further_photographs, marked_photographs};
pub use photographs::select_photographs;
pub use picture_limits::{ImagePart, PictureLimits, SentPictures, Sighting};
pub use points::PointForm;
pub use prompt::{REMAINING, narrowing, reasoner_name};
pub(crate) use prompt_context::is_building;
pub use prompt_context::{PromptAnchor, PromptCandidate, PromptContext};
pub use uniground_types::question::{Ablation, EvidenceMode, PromptVersion};
pub use visual_evidence::{Photograph, PictureSettings, VisualEvidence, collect, contact_sheets};

use picture_limits::ask_within;
use prompt::Correction;
use reply::{Choice, Reply};
use std::collections::BTreeMap;
use uniground_models::chat::{AskError, ChatRequest, Picture, Session};

/// Maximum number of calls for one question, parsing it included (docs/METHOD.md, section 4).
pub const MAX_CALLS: u32 = 3;

/// Options of the prompt.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Options {
    /// The part of the paper's prompt that is left out (App. C.3).
    pub ablation: Ablation,
    /// Whether photographs of all candidates are sent, or names in their place.
    pub evidence: EvidenceMode,
    /// The version of the prompt.
    pub prompt: PromptVersion,
    /// Whether to ask for JSON by schema instead of six lines.
    pub json: bool,
    /// How the model gives places in pictures.
    pub points: PointForm,
    /// What the model accepts in one request.
    pub limits: PictureLimits,
}

/// The input of one decision.
#[derive(Debug, Clone)]
pub struct Conversation<'a> {
    /// The content of the prompt.
    pub context: &'a PromptContext,
    /// All available pictures; ablation and names decide which of them are sent.
    pub evidence: &'a VisualEvidence,
    /// Options of the prompt.
    pub options: Options,
    /// Names that were given before, by id.
    pub names: BTreeMap<u32, String>,
    /// A sheet of candidates without a name, to be named first; only with
    /// [`EvidenceMode::CachedNames`].
    pub unnamed: Option<(Picture, Vec<u32>)>,
}

/// Why the model could not decide, with the names that it gave before.
#[derive(Debug, thiserror::Error)]
#[error("{error}")]
pub struct Undecided {
    /// Why the call failed or was not made.
    #[source]
    pub error: AskError,
    /// Names to store, by id; "" for an instance that the model did not name.
    pub new_names: BTreeMap<u32, String>,
}

/// Asks until the reply is consistent, at most as often as the session allows.
///
/// # Errors
/// [`Undecided`] when a call fails and no earlier reply is usable.
pub async fn decide(
    conversation: &Conversation<'_>,
    session: &mut Session<'_>,
) -> Result<Decision, Undecided> {
    let Conversation { context, options, .. } = conversation;
    let mut decision = Decision::default();
    let mut names = conversation.names.clone();
    if let Some((sheet, ids)) = conversation.unnamed.clone().filter(|_| options.uses_names()) {
        let naming = naming::request(sheet, &ids);
        let named = ask_within(options.limits, session, "naming", naming).await;
        let (text, _) = named.map_err(|error| Undecided { error, new_names: BTreeMap::new() })?;
        decision.new_names = naming::read(&text, &ids);
        names.extend(decision.new_names.clone());
    }
    // An instance that could not be named is shown instead.
    names.retain(|_, name| options.uses_names() && !name.is_empty());
    let shown = conversation.shown(&names);
    let mut request = prompt::first_request(conversation, &shown, &names);
    let (mut purpose, mut looked_again) = ("spatial", false);
    loop {
        let (text, sent) = match ask_within(options.limits, session, purpose, request).await {
            Ok(replied) => replied,
            Err(error) if decision.settle(&error) => break,
            Err(error) => return Err(Undecided { error, new_names: decision.new_names }),
        };
        let mut reply = reply::read_answer(&text, &context.query, options.json);
        // The simple prompt asks for no format.
        if options.is_simple() && reply.predicted == Choice::Missing {
            reply.predicted = reply::only_id(&text, |id| context.is_candidate(id))
                .map_or(Choice::Missing, Choice::Id);
        }
        names.extend(
            reply
                .candidate_names
                .iter()
                .filter(|(id, _)| context.is_candidate(**id))
                .map(|(id, name)| (*id, name.clone())),
        );
        let correction = find_inconsistency(&reply, context, &names, looked_again);
        decision.take(reply, context, &sent, options.points);
        let Some(correction) = correction else { break };
        decision.corrections.push(describe_correction(&correction));
        if session.calls_left() == 0 || options.ablation == Ablation::NoLoop {
            break;
        }
        looked_again |= matches!(correction, Correction::Inconsistent { .. });
        purpose = correction.purpose();
        request = prompt::corrected_request(
            conversation,
            &conversation.shown_again(&correction, &shown),
            &names,
            &correction,
        );
    }
    decision.names = names;
    decision.project(context);
    Ok(decision)
}

impl Options {
    /// Returns whether names are used. They replace photographs, so the ablation that leaves out
    /// photographs leaves out names as well.
    #[must_use]
    pub fn uses_names(self) -> bool {
        self.evidence == EvidenceMode::CachedNames
            && !matches!(self.ablation, Ablation::NoCandidate | Ablation::RawRender)
    }

    /// Returns whether the prompt is the paper's bare one.
    fn is_simple(self) -> bool {
        matches!(self.ablation, Ablation::SimplePrompt | Ablation::RawRender)
    }
}

impl Conversation<'_> {
    /// Returns the first request for a decision, with the names that were known before.
    #[must_use]
    pub fn first_request(&self) -> ChatRequest {
        let mut names = self.names.clone();
        names.retain(|_, name| self.options.uses_names() && !name.is_empty());
        prompt::first_request(self, &self.shown(&names), &names)
    }

    /// Returns the pictures of the first call.
    fn shown(&self, names: &BTreeMap<u32, String>) -> VisualEvidence {
        let mut shown = self.evidence.clone();
        match self.options.ablation {
            Ablation::NoGlobal => shown.global = None,
            Ablation::NoCandidate | Ablation::RawRender => {
                shown.collages.clear();
                shown.sheets.clear();
                shown.photographs.clear();
            }
            Ablation::Full | Ablation::SimplePrompt | Ablation::NoLoop => {}
        }
        if self.options.uses_names() {
            let needed = consistency::candidates_to_show(self.context, names);
            shown.collages.retain(|id, _| needed.contains(id) || self.context.is_shown_anchor(*id));
        }
        shown
    }

    /// Returns the pictures of another call. Paper: the renders and the images of the chosen
    /// candidate.
    fn shown_again(&self, correction: &Correction, shown: &VisualEvidence) -> VisualEvidence {
        match correction {
            Correction::Inconsistent { id, .. } => {
                let shows =
                    !matches!(self.options.ablation, Ablation::NoCandidate | Ablation::RawRender);
                let of_chosen = self.evidence.collages.get_key_value(id).filter(|_| shows);
                let collages = of_chosen.map(|(id, p)| (*id, p.clone())).into_iter().collect();
                VisualEvidence { collages, ..shown.clone() }
            }
            Correction::OutOfSet { .. } | Correction::Unreadable { .. } => shown.clone(),
        }
    }
}

/// Asks which of many candidates, shown on contact sheets, may be meant. Returns at most three, the
/// likeliest first.
///
/// # Errors
/// [`AskError`]: the call failed.
pub async fn narrow(
    context: &PromptContext,
    evidence: &VisualEvidence,
    limits: PictureLimits,
    session: &mut Session<'_>,
) -> Result<Vec<u32>, AskError> {
    let request = prompt::narrowing(context, evidence);
    let (text, _) = ask_within(limits, session, "sheet", request).await?;
    let mut ids = reply::shortlist(&text, |id| context.is_candidate(id));
    ids.truncate(prompt::REMAINING);
    Ok(ids)
}

/// Returns what to ask again, and why.
fn find_inconsistency(
    reply: &Reply,
    context: &PromptContext,
    names: &BTreeMap<u32, String>,
    looked_again: bool,
) -> Option<Correction> {
    match reply.predicted {
        Choice::Nothing | Choice::NotListed => None,
        Choice::Missing => {
            Some(Correction::Unreadable { why: "no \"Predicted ID\" could be read".into() })
        }
        Choice::Contradiction(a, b) if a == b => {
            Some(Correction::Unreadable { why: format!("the ID is both {a} and none") })
        }
        Choice::Contradiction(a, b) => {
            Some(Correction::Unreadable { why: format!("the ID is both {a} and {b}") })
        }
        Choice::Id(id) if !context.is_candidate(id) => Some(Correction::OutOfSet { id }),
        Choice::Id(_) if looked_again => None,
        Choice::Id(id) => consistency::disagreement(&context.target, names, id, reply)
            .map(|why| Correction::Inconsistent { id, why }),
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

/// Describes a correction for the trace.
fn describe_correction(correction: &Correction) -> String {
    match correction {
        Correction::OutOfSet { id } => {
            format!("the model answered ID {id}, which is not a candidate")
        }
        Correction::Unreadable { why } => format!("the model's answer could not be used: {why}"),
        Correction::Inconsistent { id, why } => format!("the model answered ID {id}, but {why}"),
    }
}

#[cfg(test)]
mod tests;
