//! Lists, counts, and whether something exists.

use super::sentences::{capitalized, joined, with_article};
use super::{
    Anchors, AnswerValue, Grounding, NoMatchReason, Resolved, Status, Writer, is_about_anything,
    to_target, value_of,
};
use crate::answer::CANNOT_TELL_WHETHER;
use crate::assess::carried::is_part;
use crate::reasoner::NamesFrom;
use std::collections::BTreeSet;
use std::ops::RangeInclusive;
use uniground_geometry::scene::{InstanceId, Structure, Support};
use uniground_language::{Meaning, Phrase, Relation, RelationKind, plural_of};
use uniground_models::attributes::Lexicon;

/// A relation with at least this score holds.
const HOLDS: f32 = 0.5;
/// The same for objects of a kind, which the words describe better: "the chairs around the table".
const HOLDS_OF_A_KIND: f32 = 0.4;
/// An object has the requested colors and traits with at least this share of its noun's fit.
const DESCRIBED: f32 = 0.5;
/// An object that fits an exception with at least this share of the best fit is left out.
const EXCEPTED: f32 = 0.8;
/// A named object of a list has the noun with at least this share of the best fit.
const OF_THE_KIND: f32 = 0.85;
/// An object that was left out, with at least this share of the best fit, may belong to the list.
const MAY_BELONG: f32 = 0.4;
/// How much an object that was left out lowers the confidence in a number, times its share of the
/// best fit.
const LEFT_OUT_DOUBT: f32 = 0.4;
/// Below this confidence in its anchor, an empty list is not sure.
const SURE_OF_ANCHOR: f32 = 0.7;
/// Below this confidence, whether an object exists cannot be told.
const CANNOT_TELL: f32 = 0.5;
/// An object that fits less well is no exception.
const LEAST_EXCEPTED: f32 = 0.3;
/// Names in a sentence; the rest is counted.
const MOST_NAMED: usize = 12;

/// Objects of a kind whose places are told.
const MOST_PLACED: usize = 8;

/// An object of a list.
struct Listed {
    index: usize,
    confidence: f32,
    distance_m: Option<f32>,
}

/// What a list has, or the anchor that was not found.
enum Listing {
    /// The objects, and the confidence in the anchors.
    Found(Vec<Listed>, f32),
    NoAnchor(Box<(Phrase, Resolved)>),
    /// The anchor may be any of these.
    Tied(Vec<usize>),
    /// The question has no anchor.
    Unclear,
}

impl Writer<'_> {
    pub(super) fn list(&mut self, grounding: &mut Grounding) {
        let listing = self.listing(grounding);
        self.apply(listing, grounding);
        grounding.count = Some(grounding.targets.len() as u32);
        if !matches!(grounding.status, Status::NoMatch | Status::Ambiguous) {
            grounding.text = self.list_sentence(grounding);
        }
    }

    pub(super) fn count(&mut self, grounding: &mut Grounding) {
        let listing = self.listing(grounding);
        self.apply(listing, grounding);
        self.doubt_number(grounding);
        let count = grounding.targets.len() as u32;
        grounding.count = Some(count);
        let is_unknown = grounding.no_match_reason == Some(NoMatchReason::NotRecognised);
        grounding.value = (!is_unknown)
            .then(|| AnswerValue { number: Some(count as f32), ..value_of(&ids(grounding)) });
        if grounding.status == Status::Ambiguous {
            (grounding.value, grounding.count) = (None, None);
        }
        if matches!(grounding.status, Status::NoMatch | Status::Ambiguous) {
            return;
        }
        grounding.text = if count == 1 {
            format!("There is one: {}.", self.named_with_places(grounding))
        } else {
            format!("There are {count}: {}.", self.named_with_places(grounding))
        };
    }

    /// "Are there more than three chairs"
    pub(super) fn number(&mut self, range: &RangeInclusive<u32>, grounding: &mut Grounding) {
        self.count(grounding);
        let Some(number) = grounding.value.as_ref().and_then(|value| value.number) else { return };
        let yes = range.contains(&(number as u32));
        grounding.value = Some(AnswerValue { yes: Some(yes), ..value_of(&ids(grounding)) });
        grounding.count = None;
        let answer = if yes { "Yes" } else { "No" };
        grounding.text = format!("{answer}. {}", grounding.text);
    }

    /// Lowers the confidence in a number: all objects have to be right, and none may be missing.
    fn doubt_number(&self, grounding: &mut Grounding) {
        if matches!(grounding.status, Status::NoMatch | Status::Ambiguous)
            || is_about_anything(&self.parsed.target)
        {
            return;
        }
        let assessed = self.assessor.assess_target(&self.parsed.target);
        let best = assessed.own.iter().copied().fold(f32::EPSILON, f32::max);
        let is_counted =
            |i: usize| grounding.targets.iter().any(|target| target.id == self.instances()[i].id);
        let missing: f32 = (0..self.instances().len())
            .filter(|&i| self.instances()[i].is_shown() && !is_counted(i))
            .filter(|&i| self.assessor.scene.names.get(i).is_none())
            .map(|i| assessed.own[i] / best)
            .filter(|share| *share >= MAY_BELONG)
            .map(|share| 1.0 - LEFT_OUT_DOUBT * share)
            .product();
        let all: f32 = grounding.targets.iter().map(|target| target.confidence).product();
        grounding.confidence = all * missing;
    }

    /// "Is there a piano", "is there anything on the table"
    pub(super) fn exists(&mut self, grounding: &mut Grounding) {
        let target = &self.parsed.target;
        // No parse finds the cushion of a chair.
        if let Some(part) = target.with.iter().find(|with| is_part(&with.phrase)) {
            let part = with_article(&super::sentences::spoken(&part.phrase));
            grounding.confidence = grounding.confidence.min(CANNOT_TELL);
            (grounding.value, grounding.count) = (None, None);
            grounding.text = format!("I cannot tell. A scan does not show {part}.");
            return;
        }
        let several = target.count.filter(|count| *count > 1);
        if is_about_anything(target) || self.parsed.quantity != uniground_language::Quantity::One {
            let listing = self.listing(grounding);
            let is_tied = matches!(listing, Listing::Tied(_));
            self.apply(listing, grounding);
            if is_tied {
                grounding.count = None;
                return;
            }
        }
        let yes = match (grounding.status, grounding.no_match_reason) {
            (Status::NoMatch, Some(NoMatchReason::NotRecognised | NoMatchReason::NotEnglish)) => {
                None
            }
            (Status::NoMatch, Some(NoMatchReason::NotListed)) | (Status::Ambiguous, _) => {
                Some(true)
            }
            (Status::NoMatch, _) => Some(false),
            _ => Some(several.is_none_or(|count| grounding.targets.len() as u32 >= count)),
        };
        // Several that share the belief are as good as one for "is there a chair".
        if !is_about_anything(target) && grounding.targets.len() <= 1 && yes == Some(true) {
            let others = grounding.alternatives.iter().map(|other| other.confidence);
            let chosen = grounding.targets.iter().map(|target| target.confidence);
            let all: f32 = others.chain(chosen).sum();
            // But many that are unlikely do not make it likely: their names err together.
            let most = self.chosen(grounding).map_or(1.0, |index| {
                let fit = self.assessor.assess_target(target).nouns[index];
                NamesFrom::of(self.assessor.scene, target, index).share_right(fit)
            });
            grounding.confidence = grounding.confidence.max(all.min(most));
        }
        let is_found = matches!(grounding.status, Status::Grounded | Status::Uncertain);
        if is_found && !is_about_anything(target) && grounding.confidence < CANNOT_TELL {
            let best = self.chosen(grounding).map(|index| {
                let place = self.names().place(&self.assessor, index).unwrap_or_default();
                format!(" The best match is {} {place}", self.names().the(index))
            });
            let best = best.unwrap_or_default();
            grounding.value = None;
            grounding.count = None;
            grounding.text = format!(
                "{CANNOT_TELL_WHETHER} {}.{}.",
                with_article(&super::sentences::spoken(target)),
                best.trim_end()
            );
            return;
        }
        if grounding.status == Status::Ambiguous && grounding.alternatives.is_empty() {
            grounding.value = None;
            grounding.text = format!(
                "{CANNOT_TELL_WHETHER} {}.",
                with_article(&super::sentences::spoken(target))
            );
            return;
        }
        let mut found = ids(grounding);
        if grounding.status == Status::Ambiguous {
            found.extend(grounding.alternatives.iter().map(|other| other.id));
        }
        grounding.value = yes.map(|yes| AnswerValue { yes: Some(yes), ..value_of(&found) });
        let text = match (yes, grounding.status) {
            (None, _) => Self::nothing(target, grounding.no_match_reason),
            (Some(_), Status::NoMatch) if !grounding.text.is_empty() => grounding.text.clone(),
            (Some(false), Status::NoMatch) => {
                format!("No. {}", Self::nothing(target, grounding.no_match_reason))
            }
            (Some(false), _) => {
                format!("No, only {}: {}.", grounding.targets.len(), Self::named(grounding))
            }
            (Some(true), Status::NoMatch) => {
                format!("Yes. {}", Self::nothing(target, grounding.no_match_reason))
            }
            (Some(true), Status::Ambiguous) => {
                let names: Vec<String> = found.iter().map(|id| self.described(*id)).collect();
                format!("Yes, several may be meant: {}.", joined(&names))
            }
            (Some(true), _) => match (&grounding.targets[..], self.chosen(grounding)) {
                ([_], Some(index)) => match self.names().place(&self.assessor, index) {
                    Some(place) => format!("Yes, {} {place}.", self.a_target(index)),
                    None => format!("Yes, {}.", self.a_target(index)),
                },
                _ if is_about_anything(target) => format!("Yes: {}.", Self::named(grounding)),
                _ => format!("Yes: {}.", self.named_with_places(grounding)),
            },
        };
        grounding.text = text;
        grounding.count = None;
    }

    /// Returns how a sentence calls the target, with "a": in the question's words where they say
    /// what it is.
    fn a_target(&self, index: usize) -> String {
        let target = &self.parsed.target;
        if is_about_anything(target) || !target.uses.is_empty() {
            return self.names().a(index);
        }
        with_article(&super::sentences::spoken(target))
    }

    /// Returns the objects of a list: of any kind, all that are at the place; of one kind, those that
    /// were decided on before and are at the place. Exceptions are left out.
    fn listing(&mut self, grounding: &Grounding) -> Listing {
        let target = self.parsed.target.clone();
        let about_anything = is_about_anything(&target);
        // What a model has decided stays.
        let chosen = self.chosen_by_model.filter(|_| !about_anything);
        if !about_anything && grounding.status == Status::NoMatch {
            return Listing::Found(Vec::new(), 1.0);
        }
        let (resolved, anchor_confidence) = match self.resolve_anchors(&target, Anchors::Best) {
            Ok(resolved) => resolved,
            Err(_) if chosen.is_some() => (target.clone(), 1.0),
            Err(missing) => return Listing::NoAnchor(missing),
        };
        // "what is next to it", where nothing tells what "it" is.
        let lost = resolved
            .relations
            .iter()
            .any(|relation| relation.anchors.is_empty() && !relation.kind.is_of_the_room());
        if about_anything && lost {
            return Listing::Unclear;
        }
        let tied = self.tied_anchors(&resolved);
        let assessed = self.assessor.assess_target(&resolved);
        let compares = resolved.superlative.is_some()
            || resolved.relations.iter().any(|relation| relation.kind.is_comparison());
        let anchors: Vec<usize> = resolved
            .relations
            .iter()
            .flat_map(|relation| &relation.anchors)
            .filter_map(|anchor| match anchor.meaning() {
                Meaning::Instance(id) => Some(id.0 as usize - 1),
                _ => None,
            })
            .collect();
        let least = if about_anything { HOLDS } else { HOLDS_OF_A_KIND };
        let score = |i: usize| {
            let related = resolved
                .relations
                .iter()
                .zip(&assessed.bonds)
                .filter(|(relation, _)| !relation.kind.is_comparison())
                .map(|(relation, bonds)| {
                    self.holds_by_support(relation, i, &anchors, bonds[i].score)
                })
                .fold(1.0, f32::min);
            if related >= least { related } else { 0.0 }
        };
        let asks_for_building = matches!(target.meaning(), Meaning::Structure(_));
        let best_noun = assessed.nouns.iter().copied().fold(0.0, f32::max);
        let mut found: Vec<Listed> = if about_anything {
            (0..self.instances().len())
                .filter(|&i| {
                    let instance = &self.instances()[i];
                    instance.is_shown()
                        && instance.structure.is_none()
                        && !anchors.contains(&i)
                        && assessed.nouns[i] > 0.0
                        && assessed.own[i] >= DESCRIBED * assessed.nouns[i]
                })
                .map(|i| (i, score(i)))
                .filter(|(_, score)| *score > 0.0)
                .map(|(index, score)| Listed {
                    index,
                    // The sentence names the object.
                    confidence: score
                        * anchor_confidence
                        * NamesFrom::name_confidence(self.assessor.scene, index),
                    distance_m: None,
                })
                .collect()
        } else {
            grounding
                .targets
                .iter()
                .map(|target| (target.id.0 as usize - 1, target.confidence))
                .filter(|&(i, _)| {
                    chosen.is_some_and(|id| id.0 as usize == i + 1)
                        || i < self.instances().len()
                            && (asks_for_building || self.instances()[i].structure.is_none())
                            && (compares || score(i) > 0.0)
                            && (assessed.nouns[i] >= OF_THE_KIND * best_noun
                                || self.assessor.scene.names.get(i).is_none())
                            && (compares || assessed.own[i] >= DESCRIBED * assessed.nouns[i])
                })
                .map(|(index, confidence)| Listed { index, confidence, distance_m: None })
                .collect()
        };
        // Where only one of the anchors has anything, it is the one that is meant.
        let of_anchors: BTreeSet<InstanceId> = found
            .iter()
            .flat_map(|listed| assessed.bonds.iter().filter_map(|bonds| bonds[listed.index].anchor))
            .filter(|id| tied.contains(&(id.0 as usize - 1)))
            .collect();
        if of_anchors.len() > 1 && chosen.is_none() {
            return Listing::Tied(tied);
        }
        for except in self.parsed.except.clone() {
            let except = self.with_noun_of_target(except);
            let excepted = self.assessor.assess(&except).total;
            let best = excepted.iter().copied().fold(0.0, f32::max);
            found.retain(|listed| excepted[listed.index] < (EXCEPTED * best).max(LEAST_EXCEPTED));
        }
        let reference = match (&anchors[..], &self.assessor.observer) {
            ([anchor, ..], _) => Some(self.assessor.solids[*anchor]),
            ([], Some(observer)) => Some(*observer),
            ([], None) => None,
        };
        if let Some(reference) = reference {
            for listed in &mut found {
                listed.distance_m = Some(self.assessor.solids[listed.index].gap(&reference));
            }
        }
        let by_distance = resolved.relations.iter().any(|relation| {
            matches!(relation.kind, RelationKind::Near | RelationKind::Around | RelationKind::Far)
        });
        if by_distance || anchors.is_empty() && self.assessor.observer.is_some() {
            let distance = |listed: &Listed| listed.distance_m.unwrap_or(f32::INFINITY);
            found.sort_by(|a, b| distance(a).total_cmp(&distance(b)).then(a.index.cmp(&b.index)));
        } else if about_anything {
            let volume = |listed: &Listed| self.assessor.solids[listed.index].volume();
            found.sort_by(|a, b| volume(b).total_cmp(&volume(a)).then(a.index.cmp(&b.index)));
        }
        Listing::Found(found, anchor_confidence)
    }

    /// Returns the objects that an anchor of a list may equally mean: "what is on the nightstand",
    /// where there are two. Empty for a plural, which means all of them.
    fn tied_anchors(&mut self, target: &Phrase) -> Vec<usize> {
        let anchors = target.relations.iter().flat_map(|relation| &relation.anchors);
        for anchor in anchors.cloned().collect::<Vec<_>>() {
            let is_one = matches!(anchor.meaning(), Meaning::Nouns(_) | Meaning::Unknown)
                && anchor.head != uniground_language::ME
                && !anchor.indefinite
                && !Lexicon::get().is_plural(&anchor.head);
            if !is_one {
                continue;
            }
            let found = self.resolve(&anchor);
            if found.is_tied {
                return found.tied();
            }
        }
        Vec::new()
    }

    /// Returns the score of a relation. What the parse found to stand on an object is on it.
    pub(super) fn holds_by_support(
        &self,
        relation: &Relation,
        index: usize,
        anchors: &[usize],
        score: f32,
    ) -> f32 {
        if relation.negated {
            let positive = Relation { negated: false, ..relation.clone() };
            return 1.0 - self.holds_by_support(&positive, index, anchors, 1.0 - score);
        }
        let is_on_floor = relation.kind == RelationKind::On
            && self.instances()[index].support == Support::Floor
            && relation
                .anchors
                .iter()
                .any(|anchor| anchor.meaning() == Meaning::Structure(Structure::Floor));
        if is_on_floor {
            return score.max(0.9);
        }
        let held_by = match self.instances()[index].support {
            Support::Instance { id } | Support::Wall { id } => Some(id.0 as usize - 1),
            Support::Floor | Support::Nothing => None,
        };
        let is_held = held_by.is_some_and(|holder| anchors.contains(&holder));
        match relation.kind {
            RelationKind::On | RelationKind::Inside if is_held => score.max(0.9),
            // It stands on another object, not on this one.
            RelationKind::On if held_by.is_some() && !anchors.is_empty() => {
                let stacked = held_by.is_some_and(|holder| {
                    matches!(self.instances()[holder].support, Support::Instance { id } if anchors.contains(&(id.0 as usize - 1)))
                });
                if stacked { score.max(0.6) } else { 0.6 * score }
            }
            _ => score,
        }
    }

    /// "except the red one": the noun is that of the target.
    fn with_noun_of_target(&self, phrase: Phrase) -> Phrase {
        if phrase.meaning() == Meaning::Anything && !is_about_anything(&self.parsed.target) {
            Phrase { head: self.parsed.target.head.clone(), ..phrase }
        } else {
            phrase
        }
    }

    fn apply(&self, listing: Listing, grounding: &mut Grounding) {
        match listing {
            Listing::NoAnchor(missing) => {
                Self::choose_nothing_without(&missing.0, &missing.1, grounding);
            }
            Listing::Unclear => {
                Self::choose_nothing(NoMatchReason::NotRecognised, 0.5, grounding);
                grounding.text =
                    "I do not know which object you mean. Name it, or select it.".into();
            }
            Listing::Tied(tied) => {
                let confidence = 1.0 / tied.len().max(1) as f32;
                Self::choose_nothing(NoMatchReason::Elsewhere, confidence, grounding);
                grounding.status = Status::Ambiguous;
                grounding.no_match_reason = None;
                grounding.alternatives = tied
                    .iter()
                    .map(|&i| {
                        let instance = &self.instances()[i];
                        let name = crate::answer::describe_instance(instance);
                        crate::answer::to_alternative(instance, name, confidence)
                    })
                    .collect();
                grounding.text = self.which_one(grounding);
            }
            Listing::Found(found, anchor_confidence) => match found.first() {
                None if grounding.status == Status::NoMatch
                    && !is_about_anything(&self.parsed.target) =>
                {
                    grounding.text = Self::nothing(&self.parsed.target, grounding.no_match_reason);
                }
                None => {
                    let reason = NoMatchReason::Elsewhere;
                    let confidence = grounding.confidence.max(0.5).min(anchor_confidence);
                    Self::choose_nothing(reason, confidence, grounding);
                    let doubt =
                        if anchor_confidence < SURE_OF_ANCHOR { "I am not sure. " } else { "" };
                    let nothing = Self::nothing(&self.parsed.target, Some(reason));
                    grounding.text = format!("{doubt}{nothing}");
                }
                Some(first) => {
                    let mean = found.iter().map(|listed| listed.confidence).sum::<f32>()
                        / found.len() as f32;
                    self.choose(first.index, &self.parsed.target, mean, grounding);
                    grounding.targets = found
                        .iter()
                        .map(|listed| super::super::Target {
                            distance_m: listed.distance_m,
                            ..to_target(&self.instances()[listed.index], listed.confidence)
                        })
                        .collect();
                    grounding.alternatives.retain(|other| {
                        grounding.targets.iter().all(|target| target.id != other.id)
                    });
                }
            },
        }
    }

    /// "On the desk: a laptop, a red mug and 2 books."
    fn list_sentence(&self, grounding: &Grounding) -> String {
        let target = &self.parsed.target;
        let place = crate::reasoner::relation_words(target).unwrap_or_default();
        let named = Self::named(grounding);
        match (is_about_anything(target), place.is_empty()) {
            (true, true) => format!("{}.", capitalized(&named)),
            (true, false) => format!("{}: {named}.", capitalized(&place)),
            (false, _) => {
                let named = self.named_with_places(grounding);
                match grounding.targets.len() {
                    1 => format!("One: {named}."),
                    count => {
                        let kind = plural_of(&super::sentences::spoken(target));
                        format!("{count} {kind}: {named}.")
                    }
                }
            }
        }
    }

    /// Returns the targets of a kind with their places: "a red mug on the desk and a blue mug on the
    /// table". Names only where there are many.
    fn named_with_places(&self, grounding: &Grounding) -> String {
        if grounding.targets.len() > MOST_PLACED {
            return Self::named(grounding);
        }
        let names: Vec<String> = grounding
            .targets
            .iter()
            .map(|target| {
                let name = with_article(&target.name);
                match self.names().place(&self.assessor, target.id.0 as usize - 1) {
                    Some(place) => format!("{name} {place}"),
                    None => name,
                }
            })
            .collect();
        names.join("; ")
    }

    /// Returns the names of the targets: "a laptop, 2 red mugs and a book".
    pub(super) fn named(grounding: &Grounding) -> String {
        let mut counted: Vec<(String, u32)> = Vec::new();
        for target in &grounding.targets {
            match counted.iter_mut().find(|(name, _)| *name == target.name) {
                Some((_, count)) => *count += 1,
                None => counted.push((target.name.clone(), 1)),
            }
        }
        let mut names: Vec<String> = counted
            .iter()
            .take(MOST_NAMED)
            .map(|(name, count)| match count {
                1 => with_article(name),
                count => format!("{count} x {name}"),
            })
            .collect();
        let left_out: u32 = counted.iter().skip(MOST_NAMED).map(|(_, count)| count).sum();
        if left_out > 0 {
            names.push(format!("{left_out} more"));
        }
        joined(&names)
    }

    fn described(&self, id: InstanceId) -> String {
        self.instances()
            .get((id.0 as usize).wrapping_sub(1))
            .map_or_else(String::new, |_| self.names().the(id.0 as usize - 1))
    }
}

fn ids(grounding: &Grounding) -> Vec<InstanceId> {
    grounding.targets.iter().map(|target| target.id).collect()
}
