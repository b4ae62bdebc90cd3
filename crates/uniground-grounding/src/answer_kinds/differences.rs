//! Sentences about an object that is not quite as the question says: "the white bicycle" where it
//! is black. A vision-language model says what differs.

use super::sentences::{capitalized, none_of, spoken, with_article};
use super::{AnswerValue, Grounding, NoMatchReason, Target, Writer, value_of};
use crate::answer::{NOTHING_CLEARLY, to_alternative};
use crate::reasoner::relation_words;
use uniground_language::{Form, Phrase};

impl Writer<'_> {
    /// Leaves the chosen object, which differs, out of several that are counted. Returns `false` if
    /// none would be left, or nothing is counted.
    pub(super) fn leave_out_chosen(&mut self, grounding: &mut Grounding) -> bool {
        let chosen = grounding.answer.predicted_id;
        let others = grounding.targets.iter().filter(|target| Some(target.id) != chosen);
        let others: Vec<Target> = others.cloned().collect();
        let is_counted = matches!(self.parsed.form, Form::Count | Form::Number(_));
        let Some(first) = others.first().filter(|_| is_counted) else { return false };
        let confidence = grounding.confidence;
        self.choose(first.id.0 as usize - 1, &self.parsed.target, confidence, grounding);
        grounding.targets = others;
        grounding.differs = None;
        self.chosen_by_model = None;
        true
    }

    /// Answers a question about number or existence: nothing is as the question says. The object
    /// that differs becomes an alternative.
    pub(super) fn none_as_asked(&self, differs: &str, grounding: &mut Grounding) {
        let closest = self.chosen(grounding).map(|index| {
            let name = self.names().the(index);
            (to_alternative(&self.instances()[index], name.clone(), grounding.confidence), name)
        });
        Self::choose_nothing(NoMatchReason::NoneSeen, grounding.confidence, grounding);
        let nothing = format!("I found {}.", none_of(&described(&self.parsed.target)));
        grounding.text = match closest {
            Some((closest, name)) => {
                grounding.alternatives = vec![closest];
                format!("{nothing} The closest is {name}: {differs}.")
            }
            None => nothing,
        };
        grounding.count = None;
        match &self.parsed.form {
            Form::Number(range) => Self::say(range.contains(&0), grounding),
            Form::Count => {
                grounding.count = Some(0);
                grounding.value = Some(AnswerValue { number: Some(0.0), ..value_of(&[]) });
            }
            _ => Self::say(false, grounding),
        }
    }

    fn say(yes: bool, grounding: &mut Grounding) {
        let answer = if yes { "Yes" } else { "No" };
        grounding.value = Some(AnswerValue { yes: Some(yes), ..value_of(&[]) });
        grounding.text = format!("{answer}. {}", grounding.text);
    }

    /// Adds to the sentence about an object what differs from the question.
    pub(super) fn add_difference(&self, differs: &str, grounding: &mut Grounding) {
        let text = std::mem::take(&mut grounding.text);
        grounding.text = if text.starts_with(NOTHING_CLEARLY) {
            format!("{text} {}.", capitalized(differs))
        } else {
            let asked = with_article(&described(&self.parsed.target));
            format!("{NOTHING_CLEARLY} {asked}. The closest one differs: {differs}. {text}")
        };
    }
}

/// Returns whether a question is about number or existence.
pub(super) fn asks_for_number(form: &Form) -> bool {
    matches!(form, Form::Count | Form::Exists | Form::Number(_))
}

/// Returns what a question asks for, with its place: "mug on the stove".
fn described(target: &Phrase) -> String {
    match relation_words(target) {
        Some(place) => format!("{} {place}", spoken(target)),
        None => spoken(target),
    }
}
