//! What a model is told about a question: candidates, anchors, directions. Nothing of it depends on the model.

use super::EvidenceMode;
use super::naming::PER_SHEET;
use crate::geometry::Vector3;
use crate::geometry::boxes::Aabb;
use crate::grounding::answer::{Grounding, ParsedQuerySummary};
use crate::grounding::assess::Looked;
use crate::grounding::direction::Directions;
use crate::grounding::query::{ParsedQuery, Phrase};
use crate::render::{BoxStyle, DirectionWord, LabelledBox, Subjects};
use crate::scene::InstanceId;
use std::collections::BTreeMap;

/// A question and what is known before a model is asked.
#[derive(Debug, Clone, PartialEq)]
pub struct Brief {
    pub query: String,
    pub summary: ParsedQuerySummary,
    pub(super) target: Phrase,
    /// Best first.
    pub candidates: Vec<BriefCandidate>,
    /// As the geometry sees them: a model is told that they are guesses.
    pub anchors: Vec<BriefAnchor>,
    /// Of every instance, in order of id.
    pub(super) boxes: Vec<Aabb>,
    pub(super) directions: Directions,
    /// Whose left and right these are.
    pub(super) seen_by: String,
}

#[derive(Debug, Clone, PartialEq)]
pub struct BriefCandidate {
    pub id: InstanceId,
    pub score: f32,
    /// Share of the geometry's belief, `0..=1`.
    pub belief: f32,
    pub aabb: Aabb,
}

#[derive(Debug, Clone, PartialEq)]
pub struct BriefAnchor {
    /// The question's words for it.
    pub words: String,
    pub id: InstanceId,
    pub aabb: Aabb,
}

impl Brief {
    /// `looked` has the directions the question is read in; `grounding` the candidates.
    pub(in crate::grounding) fn of(looked: &Looked, parsed: &ParsedQuery, grounding: &Grounding, beliefs: &[f32]) -> Self {
        let mut phrases = Vec::new();
        anchor_phrases(&parsed.target, &mut phrases);
        phrases.extend(parsed.viewpoint.iter().map(|viewpoint| &viewpoint.anchor));
        phrases.extend(parsed.standpoint.as_ref());
        let mut anchors: Vec<BriefAnchor> = Vec::new();
        for phrase in phrases {
            let Some(instance) = looked.best(phrase).map(|i| &looked.scene.instances[i]) else { continue };
            if anchors.iter().all(|a| a.id != instance.id) {
                anchors.push(BriefAnchor { words: phrase.text(), id: instance.id, aabb: instance.aabb });
            }
        }
        let directions = looked.directions;
        let seen_by = match &parsed.viewpoint {
            Some(viewpoint) if directions.of_somebody && looked.best(&viewpoint.anchor).is_some() => {
                format!("as seen by somebody {} the {}", viewpoint.look.phrase(), viewpoint.anchor.text())
            }
            _ if directions.of_somebody => "as seen by the observer who asks".into(),
            _ => format!("by the convention \"{}\"", grounding.direction_convention),
        };
        Self {
            query: grounding.query.clone(),
            summary: grounding.parsed_query.clone(),
            target: parsed.target.clone(),
            candidates: grounding
                .candidates
                .iter()
                .map(|c| BriefCandidate { id: c.id, score: c.score, belief: beliefs[c.id.0 as usize - 1], aabb: c.aabb })
                .collect(),
            anchors,
            boxes: looked.scene.instances.iter().map(|i| i.aabb).collect(),
            directions,
            seen_by,
        }
    }

    /// Candidates to be named before they are decided on: where names are used, the first that have none, as many as fit on a sheet.
    #[must_use]
    pub fn unnamed(&self, names: &BTreeMap<u32, String>, evidence: EvidenceMode) -> Vec<InstanceId> {
        let without = self
            .candidates
            .iter()
            .map(|c| c.id)
            .filter(|id| evidence == EvidenceMode::CachedNames && !names.contains_key(&id.0));
        without.take(PER_SHEET).collect()
    }

    #[must_use]
    pub fn is_candidate(&self, id: u32) -> bool {
        self.candidates.iter().any(|c| c.id.0 == id)
    }

    /// The six direction words and what they mean here. Named by the axis where they lie along one.
    pub(super) fn words(&self) -> [(&'static str, Vector3<f32>); 6] {
        let Directions { right, front, .. } = self.directions;
        [("left", -right), ("right", right), ("front", front), ("back", -front), ("above", Vector3::z()), ("below", -Vector3::z())]
    }

    /// What the global render shows: candidates in blue, anchors in red on top, horizontal direction words at the rims.
    #[must_use]
    pub fn subjects(&self) -> Subjects {
        let is_anchor = |id: InstanceId| self.anchors.iter().any(|a| a.id == id);
        let candidate = |c: &BriefCandidate| LabelledBox {
            aabb: c.aabb,
            label: c.id.to_string(),
            style: if is_anchor(c.id) { BoxStyle::Anchor } else { BoxStyle::Candidate },
        };
        let anchor = |a: &BriefAnchor| LabelledBox { aabb: a.aabb, label: format!("{} anchor", a.id), style: BoxStyle::Anchor };
        let others = self.anchors.iter().filter(|a| !self.is_candidate(a.id.0)).map(anchor);
        let mut boxes: Vec<LabelledBox> = self.candidates.iter().rev().map(candidate).chain(others).collect();
        boxes.sort_by_key(|b| b.style == BoxStyle::Anchor);
        let centers = self.candidates.iter().map(|c| c.aabb.center.coords).sum::<Vector3<f32>>() / self.candidates.len().max(1) as f32;
        let words = self
            .words()
            .into_iter()
            .take(4)
            .map(|(word, direction)| DirectionWord { word: named(word, direction), direction });
        Subjects { boxes, words: words.collect(), target: centers.into() }
    }
}

/// "left (+X)", or the word alone where it lies along no axis.
fn named(word: &str, direction: Vector3<f32>) -> String {
    axis(direction).map_or_else(|| word.to_owned(), |axis| format!("{word} ({axis})"))
}

/// "+X" for a direction along an axis.
pub(super) fn axis(direction: Vector3<f32>) -> Option<&'static str> {
    const ALONG: f32 = 0.9999;
    let axes = [
        ("+X", Vector3::x()),
        ("-X", -Vector3::x()),
        ("+Y", Vector3::y()),
        ("-Y", -Vector3::y()),
        ("+Z", Vector3::z()),
        ("-Z", -Vector3::z()),
    ];
    axes.into_iter().find(|(_, axis)| axis.dot(&direction) > ALONG).map(|(name, _)| name)
}

/// Anchors of a phrase's relations, and theirs.
fn anchor_phrases<'a>(phrase: &'a Phrase, found: &mut Vec<&'a Phrase>) {
    for anchor in phrase.relations.iter().flat_map(|relation| &relation.anchors) {
        found.push(anchor);
        anchor_phrases(anchor, found);
    }
}
