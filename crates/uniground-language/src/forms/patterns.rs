//! Tries the forms of questions on a clause, one after the other.

use super::descriptions::{description, place};
use super::lists::{exists, list};
use super::measures::{how, measure_of};
use super::words::{LEADS, TAILS, after, before, is_article, owned, without_second_question};
use super::{Form, ReadObject, Reference};
use crate::Phrase;
use crate::distances::{self, LengthUnit};
use crate::tokens::BREAK;

/// The form and the words that describe the target.
pub(super) type Found = Option<(Form, Vec<String>)>;

/// Recognizes the form of one clause, and reads the objects in it.
pub(super) struct PatternReader<'a> {
    pub read: ReadObject<'a>,
    /// Words of the objects other than the target that were not understood.
    pub not_understood: Vec<String>,
    /// The unit that the answer has to use.
    pub unit: Option<LengthUnit>,
}

/// Turns a statement to be confirmed into a question: "confirm: the bear is on the sofa".
fn as_question<'b>(words: &[&'b str]) -> Option<Vec<&'b str>> {
    let stated = after(
        words,
        &["confirm that", "confirm", "verify that", "verify", "is it true that", "true or false"],
    )?;
    let stated = stated.strip_prefix(&[BREAK]).unwrap_or(stated);
    let be = stated.iter().position(|word| matches!(*word, "is" | "are"))?;
    let has_article = stated.first().is_some_and(|word| is_article(word));
    let article = (!has_article).then_some("the");
    let question = [stated[be]].into_iter().chain(article).chain(stated[..be].iter().copied());
    Some(question.chain(stated[be + 1..].iter().copied()).collect())
}

impl PatternReader<'_> {
    /// Recognizes the form of the clause with which tokens begin, up to their end. Forms that a
    /// plain description can look like are recognized only at the beginning of the question.
    pub fn clause(&mut self, tokens: &[String], is_first: bool) -> Found {
        let all: Vec<&str> = tokens.iter().map(String::as_str).collect();
        let mut words = all.strip_suffix(&[BREAK]).unwrap_or(&all);
        while let Some(rest) = after(words, &LEADS).filter(|rest| !rest.is_empty()) {
            words = rest.strip_prefix(&[BREAK]).unwrap_or(rest);
        }
        while let Some(rest) = before(words, &TAILS).filter(|rest| rest.len() > 2) {
            words = rest.strip_suffix(&[BREAK]).unwrap_or(rest);
        }
        let asked = as_question(words);
        let words = asked.as_deref().unwrap_or(words);
        let mut words = without_second_question(words);
        let unit = distances::take_unit(&mut words);
        let words = &words[..];
        let found = self
            .difference(words)
            .or_else(|| self.distance(words))
            .or_else(|| how(words))
            .or_else(|| self.fit(words))
            .or_else(|| self.limit(words))
            .or_else(|| self.choice(words))
            .or_else(|| measure_of(words))
            .or_else(|| description(words))
            .or_else(|| place(words))
            .or_else(|| list(words, is_first))
            .or_else(|| exists(words))
            .or_else(|| self.holds(words));
        if found.is_some() {
            self.unit = unit;
        }
        found
    }

    /// Reads the objects of an enumeration: "the laptop and the mug".
    pub fn objects(&mut self, tokens: &[String]) -> Vec<Phrase> {
        let words: Vec<&str> = tokens.iter().map(String::as_str).collect();
        words
            .split(|word| *word == BREAK || *word == "and" || *word == "or")
            .map(|object| after(object, &["except for", "except", "also", "for"]).unwrap_or(object))
            .filter(|object| !object.is_empty())
            .map(|object| self.object(object))
            .collect()
    }

    pub(super) fn object(&mut self, words: &[&str]) -> Phrase {
        let parsed = (self.read)(&owned(words));
        self.not_understood.extend(parsed.not_understood);
        parsed.target
    }

    pub(super) fn reference(&mut self, words: &[&str]) -> Reference {
        if matches!(words, ["me" | "us" | "here" | "myself" | "you"] | ["where", "i", "am"]) {
            Reference::Observer
        } else {
            Reference::Object(Box::new(self.object(words)))
        }
    }
}
