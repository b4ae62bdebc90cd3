//! Turns the decision about a question's target into the kind of answer that the question asks for:
//! a list, a count, a measurement, yes or no, a description, or a place. Every answer gets a
//! sentence.
//!
//! The decision is made before, by geometry or by a model. Other objects of the question, such as
//! the TV of "how far is the stool from the TV", are decided here by geometry.

mod checks;
mod differences;
mod fits;
mod limits;
mod lists;
mod measures;
mod sentences;

use super::answer::{describe_instance, to_target};
use super::assess::Assessor;
use super::fit::{can_check_word, colors_fit};
use super::reasoner::builtin::MIN_COLOR;
use super::reasoner::{NamesFrom, Verdict, builtin};
use super::{
    AnswerKind, AnswerValue, Grounding, NoMatchReason, Question, SceneView, Status, Target,
    assessor_of,
};
use differences::asks_for_number;
use sentences::{Names, joined};
use uniground_geometry::scene::{Instance, InstanceId};
use uniground_language::{Form, ME, Meaning, ParsedQuery, Phrase, Quantity};
use uniground_models::attributes::Lexicon;

/// Fills in the kind, the sentence and the value of an answer, and the targets of a list.
/// `by_model`: a vision-language model chose the object.
pub(super) fn complete(
    scene: SceneView,
    question: &Question,
    parsed: &ParsedQuery,
    by_model: bool,
    grounding: &mut Grounding,
) {
    let decided = (grounding.status, grounding.answer.predicted_id);
    let differs = grounding.differs.clone();
    let mut writer = Writer {
        assessor: assessor_of(scene, question),
        parsed,
        is_as_asked: differs.is_none(),
        chosen_by_model: grounding.answer.predicted_id.filter(|_| by_model),
    };
    grounding.kind = kind_of(&parsed.form);
    match &differs {
        Some(_) if writer.leave_out_chosen(grounding) => writer.fill_in(grounding),
        Some(differs) if asks_for_number(&parsed.form) => {
            writer.none_as_asked(differs, grounding);
        }
        _ => writer.fill_in(grounding),
    }
    if let Some(differs) = grounding.differs.clone().filter(|_| grounding.status != Status::NoMatch)
    {
        writer.add_difference(&differs, grounding);
    }
    if let Some(note) = writer.unchecked_words(grounding) {
        grounding.text = format!("{} {note}", grounding.text);
    }
    if writer.chosen(grounding).is_some_and(|index| writer.is_of_other_color(index)) {
        grounding.confidence = grounding.confidence.min(MIN_COLOR);
    }
    grounding.text = said_to_asker(&writer.names().in_place_of_ids(&grounding.text));
    if decided != (grounding.status, grounding.answer.predicted_id) {
        // The explanation of the first decision is of another object.
        grounding.answer.explanation.clone_from(&grounding.text);
    }
    grounding.confidence = grounding.confidence.min(question.most_confidence);
}

/// Replaces "the me", which is the person who asks: "closest to the me".
fn said_to_asker(text: &str) -> String {
    let is_whole = |rest: &str| !rest.starts_with(char::is_alphanumeric);
    let mut said = String::with_capacity(text.len());
    let mut rest = text;
    while let Some(at) = rest.find(" the me") {
        let (before, after) = (&rest[..at], &rest[at + " the me".len()..]);
        said.push_str(before);
        said.push_str(if is_whole(after) { " you" } else { " the me" });
        rest = after;
    }
    said.push_str(rest);
    said
}

/// Returns the kind of answer that a form asks for.
fn kind_of(form: &Form) -> AnswerKind {
    match form {
        Form::Object | Form::Choice(_) => AnswerKind::Box,
        Form::List => AnswerKind::List,
        Form::Count => AnswerKind::Count,
        Form::Size(_) | Form::Distance(_) | Form::Difference(_) => AnswerKind::Measure,
        Form::Exists
        | Form::Number(_)
        | Form::Holds(_)
        | Form::Limit(_)
        | Form::Comparison(_)
        | Form::Fit(_) => AnswerKind::YesNo,
        Form::Description(_) => AnswerKind::Description,
        Form::Place => AnswerKind::Relation,
    }
}

/// Returns whether a vision-language model may decide about the target. The other forms compare or
/// list what the geometry has found.
#[must_use]
pub(super) fn may_be_reviewed(parsed: &ParsedQuery) -> bool {
    match &parsed.form {
        Form::Holds(_)
        | Form::Limit(_)
        | Form::Comparison(_)
        | Form::Choice(_)
        | Form::Difference(_)
        | Form::Fit(_) => false,
        Form::List | Form::Count | Form::Number(_) | Form::Exists => {
            !is_about_anything(&parsed.target)
        }
        _ => true,
    }
}

/// Returns whether a phrase asks for objects of any kind: "what is on the desk".
fn is_about_anything(phrase: &Phrase) -> bool {
    phrase.meaning() == Meaning::Anything && phrase.uses.is_empty()
}

/// Writes the answer to one question.
struct Writer<'a> {
    assessor: Assessor<'a>,
    parsed: &'a ParsedQuery,
    /// Whether the chosen object is what the question says, as far as a model has looked at it.
    is_as_asked: bool,
    /// The object that a vision-language model chose.
    chosen_by_model: Option<InstanceId>,
}

/// An object of a question other than its target, as decided by geometry.
struct Resolved {
    /// The chosen instance; `None` where nothing fits.
    index: Option<usize>,
    /// Belief in it, or that nothing fits.
    confidence: f32,
    /// Why nothing fits.
    reason: Option<NoMatchReason>,
    /// Whether others fit as well as the chosen one.
    is_tied: bool,
    /// Fit of each instance.
    scores: Vec<f32>,
}

/// Which instances the anchors of a phrase stand for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Anchors {
    /// The best ones, unless others fit as well.
    Best,
    /// All that may be meant: "on the white table" is true of each white table.
    AllMeant,
}

/// An anchor of a question that was not found, and why.
type MissingAnchor = Box<(Phrase, Resolved)>;

impl Resolved {
    /// Returns indices of all instances that fit like the best.
    fn tied(&self) -> Vec<usize> {
        let best = self.scores.iter().copied().fold(0.0, f32::max);
        (0..self.scores.len()).filter(|&i| self.scores[i] >= builtin::TIE * best).collect()
    }

    /// Returns the best instance apart from one, if it fits nearly as well.
    fn next_to(&self, index: usize) -> Option<usize> {
        let best = *self.scores.get(index)?;
        (0..self.scores.len())
            .filter(|&i| i != index && self.scores[i] > 0.0)
            .filter(|&i| self.scores[i] >= builtin::ALSO_MEANT * best)
            .max_by(|&a, &b| self.scores[a].total_cmp(&self.scores[b]).then(b.cmp(&a)))
    }
}

impl<'a> Writer<'a> {
    /// Fills in what the form of the question asks for.
    fn fill_in(&mut self, grounding: &mut Grounding) {
        let parsed = self.parsed;
        match &parsed.form {
            Form::Object => grounding.text = self.object(grounding),
            Form::List => self.list(grounding),
            Form::Count => self.count(grounding),
            Form::Exists => self.exists(grounding),
            Form::Number(range) => self.number(range, grounding),
            Form::Holds(claim) => self.holds(claim, grounding),
            Form::Limit(limit) => self.limit(limit, grounding),
            Form::Size(dimension) => self.size(*dimension, grounding),
            Form::Distance(reference) => self.distance(reference, grounding),
            Form::Comparison(comparison) => self.comparison(comparison, grounding),
            Form::Choice(comparison) => self.choice(comparison, grounding),
            Form::Difference(comparison) => self.difference(comparison, grounding),
            Form::Fit(passage) => self.fit(passage, grounding),
            Form::Description(aspect) => {
                if let Some(index) =
                    self.chosen(grounding).filter(|_| *aspect == uniground_language::Aspect::All)
                {
                    let named = NamesFrom::name_confidence(self.assessor.scene, index);
                    grounding.confidence = grounding.confidence.min(named);
                }
                grounding.text = self.description(*aspect, grounding);
            }
            Form::Place => grounding.text = self.place(grounding),
        }
    }

    fn instances(&self) -> &'a [Instance] {
        self.assessor.scene.instances
    }

    fn names(&self) -> Names<'a> {
        Names { instances: self.instances() }
    }

    /// Returns the index of the chosen instance.
    fn chosen(&self, grounding: &Grounding) -> Option<usize> {
        let index = (grounding.answer.predicted_id?.0 as usize).checked_sub(1)?;
        (index < self.instances().len()).then_some(index)
    }

    /// Decides which instance a phrase means. It need not be in the question's region.
    fn resolve(&mut self, phrase: &Phrase) -> Resolved {
        let within = self.assessor.within.take();
        let found = self.resolve_target(phrase);
        self.assessor.within = within;
        found
    }

    /// Decides which instance in the question's region a phrase means.
    fn resolve_target(&mut self, phrase: &Phrase) -> Resolved {
        let parsed = ParsedQuery { target: phrase.clone(), ..ParsedQuery::default() };
        let Verdict { status, reason, scores, beliefs, .. } =
            builtin::decide(&mut self.assessor, &parsed);
        let best = (0..scores.len())
            .reduce(|best, i| if scores[i] > scores[best] { i } else { best })
            .filter(|_| status != Status::NoMatch);
        let confidence = match best {
            Some(best) => beliefs[best],
            None => 1.0 - scores.iter().copied().fold(0.0, f32::max),
        };
        Resolved { index: best, confidence, reason, is_tied: status == Status::Ambiguous, scores }
    }

    /// Replaces the anchors of a phrase by the instances that they mean. Returns the phrase, and
    /// the confidence in its anchors; or the anchor that was not found, and why.
    fn resolve_anchors(
        &mut self,
        phrase: &Phrase,
        anchors: Anchors,
    ) -> Result<(Phrase, f32), MissingAnchor> {
        let mut resolved = phrase.clone();
        let mut confidence = 1.0_f32;
        for relation in &mut resolved.relations {
            // "chairs at a table": any of them. Zones and the asker are no instances.
            for anchor in &mut relation.anchors {
                let is_instance = anchor.head != ME
                    && !anchor.indefinite
                    && uniground_language::zones::nouns_of_zone(&anchor.head).is_none();
                if !is_instance {
                    continue;
                }
                let found = self.resolve(anchor);
                let Some(index) = found.index else {
                    return Err(Box::new((anchor.clone(), found)));
                };
                // "on the wall", where there are four: each of them may be meant.
                let several =
                    found.is_tied || anchors == Anchors::AllMeant && found.next_to(index).is_some();
                if several || matches!(anchor.meaning(), Meaning::Structure(_)) {
                    continue;
                }
                confidence = confidence.min(found.confidence);
                let head = format!("#{}", self.instances()[index].id);
                *anchor = Phrase { head, ..Phrase::default() };
            }
        }
        Ok((resolved, confidence))
    }

    /// Makes an instance the answer, as what a phrase means.
    fn choose(&self, index: usize, phrase: &Phrase, confidence: f32, grounding: &mut Grounding) {
        let instance = &self.instances()[index];
        grounding.status = Status::Grounded;
        grounding.no_match_reason = None;
        grounding.confidence = confidence;
        grounding.answer.predicted_id = Some(instance.id);
        grounding.answer.target_name_matches =
            Some(builtin::name_matches(self.assessor.scene, phrase, index));
        grounding
            .answer
            .candidate_names
            .entry(instance.id.0)
            .or_insert_with(|| describe_instance(instance));
        grounding.aabb = Some(instance.aabb);
        grounding.oriented_box = Some(instance.oriented_box);
        grounding.targets = vec![to_target(instance, confidence)];
        grounding.count = None;
        grounding.alternatives.retain(|other| other.id != instance.id);
    }

    /// Makes the answer one without an object.
    fn choose_nothing(reason: NoMatchReason, confidence: f32, grounding: &mut Grounding) {
        grounding.status = Status::NoMatch;
        grounding.no_match_reason = Some(reason);
        grounding.confidence = confidence;
        grounding.answer.predicted_id = None;
        grounding.answer.target_name_matches = None;
        grounding.aabb = None;
        grounding.oriented_box = None;
        grounding.targets.clear();
        grounding.alternatives.clear();
    }

    /// Makes the answer one without an object, because another object of the question was not
    /// found.
    fn choose_nothing_without(phrase: &Phrase, missing: &Resolved, grounding: &mut Grounding) {
        let reason = missing.reason.unwrap_or(NoMatchReason::Absent);
        Self::choose_nothing(reason, missing.confidence, grounding);
        grounding.text = Self::nothing(phrase, Some(reason));
    }

    /// Returns how the answer calls the target: by the question's own words where they name it.
    fn target_name(&self, index: usize) -> String {
        if self.parsed.quantity == Quantity::One && self.is_as_asked {
            self.spoken_name(&self.parsed.target, index)
        } else {
            self.names().the(index)
        }
    }

    /// Returns how a sentence calls an instance that a phrase means: by the question's words where
    /// they say what it is, and by its name where that has the same noun and says more.
    fn spoken_name(&self, phrase: &Phrase, index: usize) -> String {
        let named = self.names().the(index);
        let says_what = !matches!(phrase.meaning(), Meaning::Anything | Meaning::Instance(_))
            && phrase.uses.is_empty();
        let has_noun = named.strip_suffix(&phrase.head).is_some_and(|rest| rest.ends_with(' '));
        let says_less = phrase.colors.is_empty()
            && phrase.other_than.is_empty()
            && phrase.traits.is_empty()
            && phrase.unchecked.is_empty();
        let is_one_of_several = Lexicon::get().is_plural(&phrase.head);
        if !says_what
            || has_noun && says_less
            || is_one_of_several && self.parsed.quantity == Quantity::One
        {
            named
        } else {
            format!("the {}", sentences::spoken(phrase))
        }
    }

    /// Returns the sentence where no single instance was chosen; `None` where one was.
    fn without_choice(&self, grounding: &Grounding) -> Option<String> {
        match grounding.status {
            Status::Grounded | Status::Uncertain => None,
            Status::Ambiguous => Some(self.which_one(grounding)),
            Status::NoMatch => Some(Self::nothing(&self.parsed.target, grounding.no_match_reason)),
        }
    }

    /// Asks which of several objects is meant.
    fn which_one(&self, grounding: &Grounding) -> String {
        if is_about_anything(&self.parsed.target) && self.parsed.target.relations.is_empty() {
            return "Your question names no object. Select an object, or say which one you mean."
                .to_owned();
        }
        let ids: Vec<String> = grounding
            .alternatives
            .iter()
            .map(|other| format!("{} ({})", self.names().the(other.id.0 as usize - 1), other.id))
            .collect();
        if ids.is_empty() {
            return "Many objects fit. Say more about the one you mean.".to_owned();
        }
        format!("Several objects fit: {}. Which one do you mean?", joined(&ids))
    }

    /// Returns the sentence for an object that was not found.
    fn nothing(phrase: &Phrase, reason: Option<NoMatchReason>) -> String {
        let name = sentences::spoken(phrase);
        let name =
            if is_about_anything(phrase) { "nothing".into() } else { sentences::none_of(&name) };
        match reason {
            Some(NoMatchReason::NotRecognised) => {
                format!("I do not know what \"{}\" looks like.", phrase.head)
            }
            Some(NoMatchReason::NotEnglish) => "I only understand English.".to_owned(),
            Some(NoMatchReason::Elsewhere) => {
                let place = super::reasoner::relation_words(phrase).unwrap_or_default();
                format!("I found {name} {place}.").replace(" .", ".")
            }
            Some(NoMatchReason::NotListed) => {
                format!("I see the {} in a photograph, but I have no box for it.", phrase.head)
            }
            Some(NoMatchReason::Absent | NoMatchReason::NoneSeen) | None => {
                format!("I found {name}.")
            }
        }
    }

    /// "The red mug is on the coffee table."
    fn object(&self, grounding: &Grounding) -> String {
        self.without_choice(grounding).unwrap_or_else(|| self.place(grounding))
    }

    /// Where the chosen object is.
    fn place(&self, grounding: &Grounding) -> String {
        if let Some(sentence) = self.without_choice(grounding) {
            return sentence;
        }
        let Some(index) = self.chosen(grounding) else { return String::new() };
        if grounding.answer.target_name_matches == Some(false) || self.is_of_other_color(index) {
            let (asked, called) = (&self.parsed.target, self.names().the(index));
            let place = self.names().place(&self.assessor, index);
            let place = place.map(|place| format!(", {place}")).unwrap_or_default();
            return format!(
                "{} {}. The likeliest is {called}{place}.",
                super::answer::NOTHING_CLEARLY,
                sentences::with_article(&sentences::spoken(asked))
            );
        }
        let name = sentences::capitalized(&self.target_name(index));
        let be = sentences::be(&name);
        if let Some(place) = self.names().place(&self.assessor, index) {
            return format!("{name} {be} {place}.");
        }
        let called = self.names().the(index);
        if name.eq_ignore_ascii_case(&called) {
            format!("I found {called}.")
        } else {
            format!("{name} {be} {called}.")
        }
    }

    /// Returns whether an instance contradicts the colors of an object question.
    fn is_of_other_color(&self, index: usize) -> bool {
        let target = &self.parsed.target;
        let by_color = matches!(self.parsed.form, Form::Object | Form::Place)
            && !target.colors.is_empty()
            && !target.roughly;
        let colors = Phrase { colors: target.colors.clone(), ..Phrase::default() };
        by_color && colors_fit(self.assessor.scene, &colors, index) < MIN_COLOR
    }

    /// Says which of the words that must not describe the target a scan does not show.
    fn unchecked_words(&self, grounding: &Grounding) -> Option<String> {
        if matches!(grounding.status, Status::NoMatch) {
            return None;
        }
        let excluded = &self.parsed.target.excluded;
        let words: Vec<&str> = excluded
            .iter()
            .map(String::as_str)
            .filter(|word| !can_check_word(self.assessor.scene, word))
            .collect();
        let it = if grounding.targets.len() > 1 { "they are" } else { "it is" };
        (!words.is_empty()).then(|| {
            format!("A scan does not show whether {it} {}.", sentences::alternatives(&words))
        })
    }

    /// What the chosen object is.
    fn description(&self, aspect: uniground_language::Aspect, grounding: &Grounding) -> String {
        if let Some(sentence) = self.without_choice(grounding) {
            return sentence;
        }
        let Some(index) = self.chosen(grounding) else { return String::new() };
        if grounding.targets.len() > 1 {
            return format!("{}.", sentences::capitalized(&Self::named(grounding)));
        }
        sentences::description(&self.assessor, aspect, index, &self.target_name(index))
    }
}

/// Returns a value without number, with the instances that it is about.
fn value_of(instances: &[InstanceId]) -> AnswerValue {
    AnswerValue { instances: instances.to_vec(), ..AnswerValue::default() }
}

#[cfg(test)]
mod tests;
