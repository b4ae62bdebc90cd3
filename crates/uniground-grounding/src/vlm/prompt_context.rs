//! The content of a model's prompt: candidates, anchors, directions. It does not depend on the
//! model.

use super::EvidenceMode;
use crate::assess::Assessor;
use crate::direction::Directions;
use crate::reasoner::NamesFrom;
use crate::reasoner::builtin::guessed_from;
use crate::{Grounding, ParsedQuerySummary};
use std::collections::BTreeMap;
use uniground_geometry::Vector3;
use uniground_geometry::boxes::{Aabb, OrientedBox};
use uniground_geometry::scene::{Instance, InstanceId, Structure};
use uniground_language::{Meaning, ParsedQuery, Phrase, Viewpoint};
use uniground_render::{BoxStyle, DirectionWord, LabeledBox, Subjects};

/// A question, and what is known before a model is asked.
#[derive(Debug, Clone, PartialEq)]
pub struct PromptContext {
    /// The text of the question.
    pub query: String,
    /// The parsed question. Its relations and anchors are part of the prompt when the model is
    /// asked again.
    pub summary: ParsedQuerySummary,
    pub(super) target: Phrase,
    /// Best first.
    pub candidates: Vec<PromptCandidate>,
    /// The geometry's guesses; the prompt calls them guesses.
    pub anchors: Vec<PromptAnchor>,
    /// Anchors that are no candidates, but are shown like them and may be chosen.
    pub(super) shown_anchors: Vec<InstanceId>,
    /// Axis-aligned boxes of every instance, in order of id.
    pub(super) boxes: Vec<Aabb>,
    /// The boxes that are drawn, along the instances' own axes, in order of id. Empty: the
    /// axis-aligned ones are drawn, as in the paper.
    pub(super) oriented_boxes: Vec<OrientedBox>,
    /// Whether the question says from or towards which wall one looks, or which of the walls
    /// something is at. Walls are numbered in photographs then.
    pub(super) mentions_wall: bool,
    pub(super) directions: Directions,
    /// Whose left and right these are.
    pub(super) seen_by: String,
}

/// A candidate as the prompt lists it.
#[derive(Debug, Clone, PartialEq)]
pub struct PromptCandidate {
    /// The id with which the model answers.
    pub id: InstanceId,
    /// Fit to the whole question, `0..=1`; 0 for an instance that only stands in the right place.
    pub score: f32,
    /// Share of the geometry's belief, `0..=1`.
    pub belief: f32,
    /// Axis-aligned box, meters, world frame (Z up).
    pub aabb: Aabb,
}

/// The geometry's guess for an anchor of the question.
#[derive(Debug, Clone, PartialEq)]
pub struct PromptAnchor {
    /// The question's words for it.
    pub words: String,
    /// The likeliest instance; may be a candidate as well.
    pub id: InstanceId,
    /// Axis-aligned box, meters, world frame (Z up).
    pub aabb: Aabb,
    /// Other instances it may be, best first.
    pub alternatives: Vec<InstanceId>,
    /// Whether its name is a guess from size and place alone, which is wrong more often than right.
    pub is_weak_guess: bool,
}

/// Whose left and right they are if all photographs look one way.
const AS_PHOTOGRAPHED: &str = "as the photographs show it, which all look one way";
/// Maximum number of anchors that are shown beside the candidates.
const MAX_SHOWN_ANCHORS: usize = 2;
/// Maximum number of other instances listed for an anchor.
const MAX_ALTERNATIVES: usize = 2;

impl PromptContext {
    /// Builds the context. `assessor` has the directions that the question is read in, `grounding`
    /// the candidates.
    pub(crate) fn of(
        assessor: &Assessor,
        parsed: &ParsedQuery,
        grounding: &Grounding,
        beliefs: &[f32],
    ) -> Self {
        let mut phrases = Vec::new();
        anchor_phrases(&parsed.target, &mut phrases);
        phrases.extend(parsed.viewpoint.iter().map(|viewpoint| &viewpoint.anchor));
        phrases.extend(parsed.standpoint.as_ref());
        let is_wall = |phrase: &Phrase| phrase.meaning() == Meaning::Structure(Structure::Wall);
        let of_viewer = parsed.viewpoint.iter().map(|viewpoint| &viewpoint.anchor);
        let mentions_wall = of_viewer.chain(&parsed.standpoint).any(is_wall)
            || phrases.iter().any(|phrase| is_wall(phrase) && says_which(phrase));
        let mut anchors: Vec<PromptAnchor> = Vec::new();
        for phrase in phrases {
            let likely = assessor.likely(phrase, 1 + MAX_ALTERNATIVES);
            let Some((&(first, _), others)) = likely.split_first() else { continue };
            let instance = &assessor.scene.instances[first];
            if anchors.iter().all(|a| a.id != instance.id) {
                let alternatives =
                    others.iter().map(|&(i, _)| assessor.scene.instances[i].id).collect();
                anchors.push(PromptAnchor {
                    words: phrase.text(),
                    id: instance.id,
                    aabb: instance.aabb,
                    alternatives,
                    is_weak_guess: guessed_from(assessor.scene, phrase, first)
                        == Some(NamesFrom::Measures),
                });
            }
        }
        let is_candidate = |id: InstanceId| grounding.candidates.iter().any(|c| c.id == id);
        let others = anchors.iter().map(|a| a.id).filter(|id| !is_candidate(*id));
        let shown_anchors = others.take(MAX_SHOWN_ANCHORS).collect();
        let directions = assessor.directions;
        let seen_by = match &parsed.viewpoint {
            Some(viewpoint)
                if directions.of_somebody && assessor.best(&viewpoint.anchor).is_some() =>
            {
                seen_by_somebody(viewpoint)
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
                .map(|c| PromptCandidate {
                    id: c.id,
                    score: c.score,
                    belief: beliefs[c.id.0 as usize - 1],
                    aabb: c.aabb,
                })
                .collect(),
            anchors,
            shown_anchors,
            boxes: assessor.scene.instances.iter().map(|i| i.aabb).collect(),
            oriented_boxes: assessor.scene.instances.iter().map(|i| i.oriented_box).collect(),
            mentions_wall,
            directions,
            seen_by,
        }
    }

    /// Returns whether pieces of the building of this kind are numbered in photographs.
    pub(super) fn numbers(&self, structure: Structure) -> bool {
        self.target.meaning() == Meaning::Structure(structure)
            || self.mentions_wall && structure == Structure::Wall
    }

    /// Returns the candidates to name before the decision: where names are used, the first without
    /// a name.
    #[must_use]
    pub fn unnamed(
        &self,
        names: &BTreeMap<u32, String>,
        evidence: EvidenceMode,
    ) -> Vec<InstanceId> {
        let without = self
            .candidates
            .iter()
            .map(|c| c.id)
            .filter(|id| evidence == EvidenceMode::CachedNames && !names.contains_key(&id.0));
        without.collect()
    }

    /// Returns whether an id from a reply is one that the model may choose.
    #[must_use]
    pub fn is_candidate(&self, id: u32) -> bool {
        self.shown().any(|shown| shown.0 == id)
    }

    /// Returns the instances that the model is shown individually and may choose: candidates, then
    /// anchors.
    pub fn shown(&self) -> impl Iterator<Item = InstanceId> {
        self.candidates.iter().map(|c| c.id).chain(self.shown_anchors.iter().copied())
    }

    /// Returns whether the id is an anchor that is shown beside the candidates.
    #[must_use]
    pub(super) fn is_shown_anchor(&self, id: u32) -> bool {
        self.shown_anchors.iter().any(|anchor| anchor.0 == id)
    }

    /// Returns whether right and front are those of a viewer who looks from the front to the back.
    /// The paper's left and right are not.
    pub(super) fn is_of_a_viewer(&self) -> bool {
        let Directions { right, front, .. } = self.directions;
        (-front).cross(&Vector3::z()).dot(&right) > 0.0
    }

    /// Returns the context without anchors that are pieces of the building. A room has several walls,
    /// and a relation to one of them decides little.
    #[must_use]
    pub fn without_building_anchors(mut self, instances: &[Instance]) -> Self {
        self.anchors.retain(|anchor| !is_building(instances, anchor.id));
        self.shown_anchors.retain(|id| !is_building(instances, *id));
        self
    }

    /// Returns the context as in the paper: anchors are listed, but not shown, and cannot be
    /// chosen. Axis-aligned boxes are drawn.
    #[must_use]
    pub fn like_the_paper(self) -> Self {
        Self { shown_anchors: Vec::new(), oriented_boxes: Vec::new(), ..self }
    }

    /// Returns the context with left and right as photographs show them that all look this way, in
    /// place of the default convention. An observer, the words of the question and the convention
    /// `viewer` take precedence.
    #[must_use]
    pub(crate) fn with_photographed_directions(self, look: Option<Vector3<f32>>) -> Self {
        let seen = look.filter(|_| self.directions.by_default).and_then(Directions::looking_along);
        match seen {
            Some(directions) => Self { directions, seen_by: AS_PHOTOGRAPHED.into(), ..self },
            None => self,
        }
    }

    /// Returns whether left and right are those of the photographs.
    pub(crate) fn is_as_photographed(&self) -> bool {
        self.seen_by == AS_PHOTOGRAPHED
    }

    /// Adds one more candidate, which a model saw. `instances` are those of the scene with it.
    #[must_use]
    pub fn with_found(mut self, found: &Instance, instances: &[Instance]) -> Self {
        self.update_boxes(instances);
        self.candidates.push(PromptCandidate {
            id: found.id,
            score: 0.0,
            belief: 0.0,
            aabb: found.aabb,
        });
        self
    }

    /// Puts an instance in the place of a candidate or an anchor that it fits better than.
    /// `instances` are those of the scene with it.
    pub(crate) fn replace_candidate(
        &mut self,
        old: InstanceId,
        new: InstanceId,
        instances: &[Instance],
    ) {
        self.update_boxes(instances);
        let Some(aabb) = self.boxes.get((new.0 as usize).wrapping_sub(1)).copied() else { return };
        match self.candidates.iter_mut().find(|candidate| candidate.id == old) {
            Some(candidate) => (candidate.id, candidate.aabb) = (new, aabb),
            None => {
                self.candidates.push(PromptCandidate { id: new, score: 0.0, belief: 0.0, aabb });
            }
        }
    }

    /// Returns the context with these candidates and, if any are given, these anchors, as a model
    /// found them. Candidates and anchors that the geometry knew keep what it said.
    #[must_use]
    pub(crate) fn with_found_in_photographs(
        &self,
        candidates: &[InstanceId],
        anchors: &[(InstanceId, String)],
    ) -> Self {
        let aabb = |id: InstanceId| self.boxes.get((id.0 as usize).checked_sub(1)?).copied();
        let candidate = |&id: &InstanceId| {
            let known = self.candidates.iter().find(|c| c.id == id).cloned();
            known.or_else(|| Some(PromptCandidate { id, score: 0.0, belief: 0.0, aabb: aabb(id)? }))
        };
        let candidates: Vec<PromptCandidate> = candidates.iter().filter_map(candidate).collect();
        let anchor = |(id, name): &(InstanceId, String)| {
            let known = self.anchors.iter().find(|a| a.id == *id).cloned();
            known.or_else(|| {
                let (words, alternatives) = (name.clone(), Vec::new());
                let aabb = aabb(*id)?;
                Some(PromptAnchor { words, id: *id, aabb, alternatives, is_weak_guess: false })
            })
        };
        let anchors: Vec<PromptAnchor> = match anchors {
            // The model saw none of the geometry's guesses there.
            [] => self.anchors.iter().filter(|anchor| !anchor.is_weak_guess).cloned().collect(),
            found => found.iter().filter_map(anchor).collect(),
        };
        let is_candidate = |id: InstanceId| candidates.iter().any(|c| c.id == id);
        let others = anchors.iter().map(|a| a.id).filter(|id| !is_candidate(*id));
        let shown_anchors = others.take(MAX_SHOWN_ANCHORS).collect();
        Self { candidates, anchors, shown_anchors, ..self.clone() }
    }

    /// Returns the context with the candidates and the directions of a later decision, which knew
    /// the anchors.
    #[must_use]
    pub(crate) fn decided_again(self, later: Self, parsed: &ParsedQuery) -> Self {
        let Self { candidates, directions, .. } = later;
        if self.is_as_photographed() && directions.by_default {
            return Self { candidates, ..self };
        }
        let seen_by = match &parsed.viewpoint {
            Some(viewpoint) if directions.of_somebody => seen_by_somebody(viewpoint),
            _ => self.seen_by.clone(),
        };
        Self { candidates, directions, seen_by, ..self }
    }

    /// Adds the boxes of instances that were found since, for this question or for others.
    pub(crate) fn update_boxes(&mut self, instances: &[Instance]) {
        self.boxes = instances.iter().map(|i| i.aabb).collect();
        if !self.oriented_boxes.is_empty() {
            self.oriented_boxes = instances.iter().map(|i| i.oriented_box).collect();
        }
    }

    /// Keeps these candidates only, in their order.
    #[must_use]
    pub fn narrowed_to(&self, ids: &[u32]) -> Self {
        let candidates =
            self.candidates.iter().filter(|c| ids.contains(&c.id.0)).cloned().collect();
        Self { candidates, ..self.clone() }
    }

    /// Returns the six direction words and their directions. They are named by the axis where they
    /// lie along one.
    pub(super) fn words(&self) -> [(&'static str, Vector3<f32>); 6] {
        let Directions { right, front, .. } = self.directions;
        [
            ("left", -right),
            ("right", right),
            ("front", front),
            ("back", -front),
            ("above", Vector3::z()),
            ("below", -Vector3::z()),
        ]
    }

    /// Returns what the global render shows: candidates in blue, anchors in red on top, horizontal
    /// direction words at the edges.
    #[must_use]
    pub fn subjects(&self) -> Subjects {
        let is_anchor = |id: InstanceId| self.anchors.iter().any(|a| a.id == id);
        let drawn = |id: InstanceId, aabb: Aabb| {
            let oriented = self.oriented_boxes.get((id.0 as usize).wrapping_sub(1));
            oriented.copied().unwrap_or(aabb.into())
        };
        let candidate = |c: &PromptCandidate| LabeledBox {
            aabb: c.aabb,
            drawn: drawn(c.id, c.aabb),
            label: c.id.to_string(),
            style: if is_anchor(c.id) { BoxStyle::Anchor } else { BoxStyle::Candidate },
        };
        let anchor = |a: &PromptAnchor| LabeledBox {
            aabb: a.aabb,
            drawn: drawn(a.id, a.aabb),
            label: format!("{} anchor", a.id),
            style: BoxStyle::Anchor,
        };
        let listed = |id: InstanceId| self.candidates.iter().any(|c| c.id == id);
        let others = self.anchors.iter().filter(|a| !listed(a.id)).map(anchor);
        let mut boxes: Vec<LabeledBox> =
            self.candidates.iter().rev().map(candidate).chain(others).collect();
        boxes.sort_by_key(|b| b.style == BoxStyle::Anchor);
        let centers = self.candidates.iter().map(|c| c.aabb.center.coords).sum::<Vector3<f32>>()
            / self.candidates.len().max(1) as f32;
        let words = self
            .words()
            .into_iter()
            .take(4)
            .map(|(word, direction)| DirectionWord { word: named(word, direction), direction });
        Subjects { boxes, words: words.collect(), target: centers.into() }
    }
}

/// Returns whether an instance is a piece of the building.
pub(crate) fn is_building(instances: &[Instance], id: InstanceId) -> bool {
    let instance = instances.get((id.0 as usize).wrapping_sub(1));
    instance.is_some_and(|instance| instance.structure.is_some())
}

/// Returns whose left and right those of a viewpoint are.
fn seen_by_somebody(viewpoint: &Viewpoint) -> String {
    format!("as seen by somebody {} the {}", viewpoint.look.phrase(), viewpoint.anchor.text())
}

/// Returns "left (+X)", or the word alone where it lies along no axis.
fn named(word: &str, direction: Vector3<f32>) -> String {
    axis(direction).map_or_else(|| word.to_owned(), |axis| format!("{word} ({axis})"))
}

/// Returns "+X" and the like for a direction along an axis.
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

/// Returns whether a phrase distinguishes what it means from others of the kind: "the blue wall".
fn says_which(phrase: &Phrase) -> bool {
    let Phrase { colors, traits, unchecked, with, relations, .. } = phrase;
    !(colors.is_empty()
        && traits.is_empty()
        && unchecked.is_empty()
        && with.is_empty()
        && relations.is_empty())
}

/// Collects the anchors of a phrase's relations, and their own anchors.
fn anchor_phrases<'a>(phrase: &'a Phrase, found: &mut Vec<&'a Phrase>) {
    for anchor in phrase.relations.iter().flat_map(|relation| &relation.anchors) {
        found.push(anchor);
        anchor_phrases(anchor, found);
    }
}
