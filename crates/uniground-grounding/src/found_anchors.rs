//! Decides again with the anchors that a model found in photographs. Relations and directions then
//! come from these (docs/METHOD.md, section 4, "Photographs first").

use super::fit::colors_fit;
use super::reasoner::builtin::MIN_COLOR;
use super::scene_source::{SceneSource, scene_view};
use super::vlm::{PromptContext, matches_phrase};
use super::{Appearance, Grounding, Question, Status, ground_with_context};
use std::sync::Arc;
use std::time::Duration;
use uniground_geometry::scene::{InstanceId, Structure};
use uniground_language::{Form, ME, Meaning, ParsedQuery, Phrase};
use uniground_models::attributes::Lexicon;

/// Confidence of the geometry from which a model does not decide if it finds the same object in
/// photographs, and no other.
pub(super) const SURE_IF_CONFIRMED: f32 = 0.1;

/// The geometry's decision, and what it takes to decide again.
pub(super) struct ByGeometry<'a> {
    pub question: &'a Question,
    pub parsed: &'a ParsedQuery,
    pub appearance: &'a Arc<Option<Appearance>>,
    /// The decision.
    pub grounding: &'a mut Grounding,
    /// The question with the anchors of the later decision; `None` without one.
    pub decided_with: &'a mut Option<ParsedQuery>,
}

impl ByGeometry<'_> {
    /// Decides again, if the model found anchors that the question names. Returns the context with
    /// the candidates and the directions of the later decision.
    ///
    /// # Errors
    /// Those of the source.
    pub async fn decide_with<S: SceneSource>(
        &mut self,
        source: &Arc<S>,
        anchors: &[(InstanceId, String)],
        context: PromptContext,
    ) -> Result<PromptContext, S::Error> {
        let Some(parsed) = with_anchors(self.parsed, anchors) else { return Ok(context) };
        let (question, appearance) = (self.question.clone(), self.appearance.clone());
        let asked = parsed.clone();
        let (grounding, again) = source
            .compute(move |source| {
                let scene = scene_view(source, (*appearance).as_ref());
                Ok(ground_with_context(scene, &question, asked, Duration::ZERO))
            })
            .await?;
        let Grounding { parsed_query, timings_ms, .. } = self.grounding.clone();
        *self.grounding = Grounding { parsed_query, timings_ms, ..grounding };
        *self.decided_with = Some(parsed);
        Ok(context.decided_again(again, self.parsed))
    }

    /// Returns the instance that the geometry chose, if a model that finds the same need not look
    /// again. The question must name a kind, or a kind and a color that the instance has: whether
    /// anything else is as the question says, only the second look tells.
    pub fn choice<S: SceneSource>(&self, source: &S) -> Option<InstanceId> {
        let Grounding { status, count, confidence, answer, .. } = &*self.grounding;
        let is_sure = *status == Status::Grounded && *confidence >= SURE_IF_CONFIRMED;
        let target = &self.parsed.target;
        let kind = Phrase {
            head: target.head.clone(),
            could_be: target.could_be.clone(),
            colors: target.colors.clone(),
            ..Phrase::default()
        };
        let has_colors = |id: &InstanceId| {
            let scene = scene_view(source, (**self.appearance).as_ref());
            colors_fit(scene, &kind, id.0 as usize - 1) >= MIN_COLOR
        };
        let asks_for_one = matches!(self.parsed.form, Form::Object | Form::Place);
        let is_plain = *target == kind && count.is_none() && asks_for_one;
        answer.predicted_id.filter(|id| is_sure && is_plain && has_colors(id))
    }
}

/// Returns the question with ids in place of the anchors that were found: each is the only one with
/// a name that the question has for it. `None` if no anchor is replaced.
fn with_anchors(parsed: &ParsedQuery, anchors: &[(InstanceId, String)]) -> Option<ParsedQuery> {
    let mut found = parsed.clone();
    let mut phrases: Vec<&mut Phrase> = Vec::new();
    collect_anchors(&mut found.target, &mut phrases);
    phrases.extend(found.viewpoint.as_mut().map(|viewpoint| &mut viewpoint.anchor));
    phrases.extend(found.standpoint.as_mut());
    let mut is_changed = false;
    for phrase in phrases.into_iter().filter(|phrase| is_single_object(phrase)) {
        let mut named = anchors.iter().filter(|(_, name)| matches_phrase(name, phrase));
        if let (Some((id, _)), None) = (named.next(), named.next()) {
            *phrase = Phrase { head: format!("#{id}"), ..Phrase::default() };
            is_changed = true;
        }
    }
    is_changed.then_some(found)
}

/// Collects the anchors of a phrase's relations. Those of anchors only say which anchor is meant.
fn collect_anchors<'a>(phrase: &'a mut Phrase, found: &mut Vec<&'a mut Phrase>) {
    for relation in &mut phrase.relations {
        found.extend(&mut relation.anchors);
    }
}

/// Returns whether a phrase means one object of the scene, or one of its walls: no zone, and not the
/// asker. Walls have numbers only if the question says which one it means.
fn is_single_object(phrase: &Phrase) -> bool {
    let is_other = match phrase.meaning() {
        Meaning::Structure(structure) => structure != Structure::Wall,
        meaning => matches!(meaning, Meaning::Anything | Meaning::Instance(_)),
    };
    !is_other
        && !phrase.indefinite
        && !Lexicon::get().is_plural(&phrase.head)
        && phrase.head != ME
        && uniground_language::zones::nouns_of_zone(&phrase.head).is_none()
}

#[cfg(test)]
mod tests {
    use super::*;
    use uniground_language::parse;

    fn anchors_of(query: &str, found: &[(u32, &str)]) -> Option<Vec<String>> {
        let found: Vec<_> =
            found.iter().map(|(id, name)| (InstanceId(*id), (*name).to_owned())).collect();
        let parsed = with_anchors(&parse(query), &found)?;
        let of_relations = parsed.target.relations.iter().flat_map(|relation| &relation.anchors);
        let of_viewer = parsed.viewpoint.iter().map(|viewpoint| &viewpoint.anchor);
        Some(of_relations.chain(of_viewer).map(|anchor| anchor.head.clone()).collect())
    }

    #[test]
    fn anchors_are_replaced_by_what_has_their_name() {
        let found = [(7, "grey sofa"), (12, "office chair")];
        let replaced = |query: &str| anchors_of(query, &found);
        assert_eq!(replaced("the mug next to the couch"), Some(vec!["#7".into()]));
        assert_eq!(replaced("facing the sofa, the lamp on the left"), Some(vec!["#7".into()]));
        assert_eq!(
            replaced("the mug between the sofa and the chair"),
            Some(vec!["#7".into(), "#12".into()])
        );
        let wall = [(3, "brick wall")];
        let facing = anchors_of("facing the brick wall, the lamp on the left", &wall);
        assert_eq!(facing, Some(vec!["#3".into()]));
        for query in
            ["the mug", "the mug on the table", "the mug next to a sofa", "the mug by the wall"]
        {
            assert_eq!(replaced(query), None, "{query}");
        }
    }

    #[test]
    fn an_anchor_that_may_be_either_stays() {
        let two = [(7, "sofa"), (8, "grey sofa")];
        assert_eq!(anchors_of("the mug next to the sofa", &two), None);
        assert_eq!(anchors_of("the lamp between the sofas", &two[..1]), None);
        // A name that the model did not give.
        assert_eq!(anchors_of("the mug next to the sofa", &[(7, "anchor")]), None);
    }
}
