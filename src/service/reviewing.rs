//! The vision-language model's part in a question: pictures, conversation, names, money.

use super::Service;
use super::cache::LoadedParse;
use super::evidence::Stored;
use super::questions::{GroundRequest, ParserChoice, ReasonerChoice};
use super::vlm::Vlm;
use crate::error::Error;
use crate::grounding::vlm::{
    Brief, Conversation, Decision, EvidenceMode, Exhibits, MAX_CALLS, Options, PictureSettings, Undecided, decide, naming,
};
use crate::models::chat::{CallRecord, OverBudget, Picture, Purse, Session};
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Instant;
use tokio::task::spawn_blocking;

/// What came of asking the model.
pub(super) struct Review {
    pub decision: Result<Decision, Undecided>,
    pub records: Vec<CallRecord>,
    pub evidence_ms: f64,
}

/// A question about a parse, ready for the model.
pub(super) struct Case<'a> {
    pub parse_id: &'a str,
    pub parse: Arc<LoadedParse>,
    pub brief: Brief,
    pub options: Options,
    /// To read the question: they count.
    pub calls_made: u32,
}

impl Service {
    /// The model that reviews a question; `None` where the built-in reasoner decides, by choice or because nothing may be spent.
    pub(super) fn reviewer(&self, request: &GroundRequest) -> Result<Option<Arc<Vlm>>, Error> {
        let unpaid = request.max_cost_usd == Some(0.0);
        let asks = request.reasoner != ReasonerChoice::Builtin || request.parser == ParserChoice::Vlm;
        if let Some(vlm) = self.vlm.as_ref().filter(|_| asks && !unpaid && request.max_cost_usd.is_some())
            && !vlm.client.has_prices()
        {
            return Err(Error::invalid("/max_cost_usd", "this server knows no prices of its model: only 0 can be held to"));
        }
        match (request.reasoner, &self.vlm) {
            (ReasonerChoice::Builtin, _) | (ReasonerChoice::Auto, None) => Ok(None),
            (ReasonerChoice::Auto, Some(_)) if unpaid => Ok(None),
            (ReasonerChoice::Vlm, None) => Err(Error::VlmNotConfigured),
            (ReasonerChoice::Vlm, Some(_)) if unpaid => {
                Err(Error::OverBudget(OverBudget { of: "this question", limit_usd: 0.0, left_usd: 0.0, wanted_usd: 0.0 }))
            }
            (_, Some(vlm)) => Ok(Some(vlm.clone())),
        }
    }

    /// Shows the model a question and hears it out. Names it gave on the way are kept.
    pub(super) async fn review(&self, vlm: &Vlm, case: Case<'_>, purses: Vec<Purse>) -> Result<Review, Error> {
        let Case { parse_id, parse, brief, options, calls_made } = case;
        let start = Instant::now();
        let names = match options.evidence {
            EvidenceMode::Full => BTreeMap::new(),
            EvidenceMode::CachedNames => self.names_of(parse_id).await?,
        };
        let (brief, exhibits, unnamed) = self.exhibits(parse_id, parse, brief, options.evidence, names.clone()).await?;
        let evidence_ms = start.elapsed().as_secs_f64() * 1e3;
        let conversation = Conversation { brief: &brief, exhibits: &exhibits, options, names: of_candidates(names, &brief), unnamed };
        let mut session = Session::new(&vlm.client, purses, MAX_CALLS.saturating_sub(calls_made));
        let decision = {
            let _place = vlm.place()?;
            decide(&conversation, &mut session).await
        };
        let (Ok(Decision { new_names, .. }) | Err(Undecided { new_names, .. })) = &decision;
        if !new_names.is_empty() {
            self.store
                .keep_instance_names(parse_id, vlm.client.model(), naming::NAMING_VERSION, new_names)
                .await?;
        }
        vlm.note_spending(&self.store).await?;
        Ok(Review { decision, records: session.into_records(), evidence_ms })
    }

    /// Pictures for a question, drawn off the async threads; and a sheet of candidates without a name, where names are used.
    async fn exhibits(
        &self,
        parse_id: &str,
        parse: Arc<LoadedParse>,
        brief: Brief,
        evidence: EvidenceMode,
        names: BTreeMap<u32, String>,
    ) -> Result<(Brief, Exhibits, Option<(Picture, Vec<u32>)>), Error> {
        let permit = self.turn().await?;
        let (caches, parse_id, folder) = (self.caches.clone(), parse_id.to_owned(), self.store.blobs.parse(parse_id));
        spawn_blocking(move || {
            let _permit = permit;
            let stored = Stored { parse_id: &parse_id, parse: &parse, folder, caches: &caches };
            let exhibits = stored.exhibits(&brief, &PictureSettings::of(evidence))?;
            let unnamed = brief.unnamed(&names, evidence);
            let sheet = (!unnamed.is_empty()).then(|| stored.sheet(1, &unnamed)).transpose()?;
            Ok((brief, exhibits, sheet.map(|sheet| (sheet, unnamed.iter().map(|id| id.0).collect()))))
        })
        .await?
    }
}

fn of_candidates(mut names: BTreeMap<u32, String>, brief: &Brief) -> BTreeMap<u32, String> {
    names.retain(|id, _| brief.is_candidate(*id));
    names
}
