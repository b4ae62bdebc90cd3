//! Closes phrases, attaches each to the phrase it belongs to, and builds the query.

use super::{Frame, ITSELF, Reader, Role};
use crate::tokens::correct_spelling;
use crate::words;
use crate::zones;
use crate::{
    Look, ME, Meaning, ParsedQuery, Phrase, Quantity, Relation, RelationKind, Viewpoint, With,
};
use uniground_models::attributes::{Lexicon, WordNet};

/// The use of seats in the lexicon.
const SIT_ON: &str = "sit on";

impl Reader {
    /// Returns the query after the last piece.
    pub(super) fn finish(mut self) -> ParsedQuery {
        let mut target = self.target.unwrap_or_default();
        target.other_things.append(&mut self.other_things);
        // "the chair beside the green one": another chair.
        for anchor in target
            .relations
            .iter_mut()
            .flat_map(|r| &mut r.anchors)
            .filter(|a| matches!(a.head.as_str(), "one" | "ones"))
        {
            anchor.head.clone_from(&target.head);
        }
        if let Some(meant) = group_of(&target, self.query.viewpoint.as_ref()) {
            target.head.clone_from(&meant.head);
            target.uses.clone_from(&meant.uses);
            // The target belongs to the group, so the group is not its anchor. Other anchors, such
            // as the wall that the group is on, stay.
            target.relations.retain(|relation| !relation.anchors.contains(&meant));
            target.with.retain(|with| with.phrase != meant);
        }
        // "counting from the left, the fourth": the rank comes after the side to count from.
        if let (Some(rank), Some(superlative)) = (self.ordinal, &mut target.superlative)
            && superlative.rank == 1
        {
            superlative.rank = rank;
            self.ordinal = None;
        }
        // "counting from the door, the third"
        let compared = target
            .relations
            .iter_mut()
            .find(|r| r.kind.is_comparison() && !r.negated && r.rank == 1);
        if let (Some(rank), Some(relation)) = (self.ordinal, compared) {
            relation.rank = rank;
            self.ordinal = None;
        }
        // "the second chair left of the door": counted from it.
        let sided = target
            .relations
            .iter()
            .find(|r| r.kind.is_a_side() && !r.negated && r.anchors.len() == 1);
        if let (Some(rank), Some(anchors)) = (self.ordinal, sided.map(|r| r.anchors.clone())) {
            target.relations.push(Relation {
                kind: RelationKind::Closest,
                text: "counted from".into(),
                anchors,
                negated: false,
                rank,
            });
            self.ordinal = None;
        }
        if let Some(rank) = self.ordinal.take() {
            self.query.not_understood.push(format!("number {rank}"));
        }
        // Relative to the viewer's position, otherwise to the observer; the request may give the
        // position.
        if self.query.standpoint.is_none() {
            self.query.not_understood.extend(self.from_here.iter().map(|r| r.text.clone()));
        }
        let here = self
            .query
            .standpoint
            .clone()
            .unwrap_or_else(|| Phrase { head: ME.into(), ..Phrase::default() });
        target.relations.extend(
            self.from_here.into_iter().map(|r| Relation { anchors: vec![here.clone()], ..r }),
        );
        // "facing the desk with two monitors, the monitor on the left": one of those two.
        if let Some(viewpoint) = &self.query.viewpoint
            && viewpoint.anchor.with.iter().any(|with| same_thing(&with.phrase, &target))
        {
            let anchors = vec![viewpoint.anchor.clone()];
            target.relations.push(Relation {
                kind: RelationKind::Near,
                text: "at".into(),
                anchors,
                negated: false,
                rank: 1,
            });
        }
        if self.query.quantity == Quantity::One
            && target.superlative.is_none()
            && target.uses.is_empty()
        {
            self.query.quantity = match target.count {
                Some(1) => Quantity::One,
                Some(count) => Quantity::Exactly(count),
                None if Lexicon::get().is_plural(&target.head) => Quantity::All,
                None => Quantity::One,
            };
        }
        self.query.target = target;
        self.query
    }

    /// Closes the innermost phrase and attaches it to the phrase it belongs to.
    pub(super) fn pop(&mut self) {
        let Some(Frame { mut phrase, role, unknown, another: _, indefinite, determined: _ }) =
            self.stack.pop()
        else {
            return;
        };
        // "the nearer of the two" compares distances to the viewer's position.
        if matches!(role, Role::Anchor { .. })
            && phrase.is_empty()
            && unknown.is_empty()
            && let Some(below) = self.stack.last_mut()
            && let Some(relation) =
                below.phrase.relations.pop_if(|r| r.kind.is_comparison() && r.anchors.is_empty())
        {
            self.from_here.push(relation);
            return;
        }
        self.settle_head(&mut phrase, unknown, role);
        if phrase.is_empty() {
            return;
        }
        phrase.indefinite = indefinite && matches!(role, Role::Anchor { .. });
        match role {
            Role::Target => self.target = Some(phrase),
            Role::More => self.add_to_target(phrase),
            Role::Anchor { .. } => {
                if let Some(relation) =
                    self.stack.last_mut().and_then(|below| below.phrase.relations.last_mut())
                {
                    relation.anchors.push(phrase);
                }
            }
            Role::With { absent } => {
                if let Some(below) = self.stack.last_mut() {
                    below.phrase.with.push(With { phrase, absent });
                }
            }
            Role::Surplus => self.query.not_understood.push(phrase.head),
            Role::View(look) => self.finish_viewpoint(look, phrase),
            Role::Seated => {
                let anchors = vec![phrase.clone()];
                let at = Relation {
                    kind: RelationKind::Near,
                    text: "at".into(),
                    anchors,
                    negated: false,
                    rank: 1,
                };
                let seat = Phrase {
                    head: "something".into(),
                    uses: vec![SIT_ON.into()],
                    relations: vec![at],
                    ..Phrase::default()
                };
                self.query.standpoint = Some(seat);
                self.finish_viewpoint(Look::Facing, phrase);
            }
        }
    }

    /// Handles the end of a viewpoint phrase. A question may give both the viewer's position and
    /// what the viewer looks at; the latter gives the direction.
    pub(super) fn finish_viewpoint(&mut self, look: Look, anchor: Phrase) {
        if look == Look::From {
            self.query.standpoint = Some(anchor.clone());
        }
        // "at the foot of the bed, looking at the headboard": at the bed.
        let anchor = match &self.query.standpoint {
            Some(standpoint)
                if look == Look::Facing && words::is_part_of_furniture(&anchor.head) =>
            {
                standpoint.clone()
            }
            _ => anchor,
        };
        let keeps = look == Look::From
            && self.query.viewpoint.as_ref().is_some_and(|v| v.look != Look::From);
        if !keeps {
            self.query.viewpoint = Some(Viewpoint { look, anchor });
        }
    }

    /// Sets the noun of a phrase without a known one to its last word: a misspelled or unknown noun
    /// ("the theremin").
    fn settle_head(&mut self, phrase: &mut Phrase, mut unknown: Vec<String>, role: Role) {
        if phrase.head.is_empty() && phrase.uses.is_empty() && role != Role::More {
            // "the cat sleeping on the sofa" is a cat.
            let is_thing = |word: &String| !WordNet::get().kinds_of(word).is_empty();
            let things = unknown.iter().rposition(is_thing);
            let noun = things.or_else(|| {
                unknown.iter().rposition(|word| !word.ends_with("ing") && !word.contains(' '))
            });
            let last = unknown.len().checked_sub(1);
            if let Some(word) = noun.or(last).map(|i| unknown.remove(i)) {
                phrase.head = correct_spelling(&word).map_or(word, str::to_owned);
            }
            phrase.unchecked.append(&mut unknown);
        }
        self.query.not_understood.append(&mut unknown);
        if !phrase.head.is_empty()
            && phrase.meaning() == Meaning::Unknown
            && phrase.head != ITSELF
            && zones::nouns_of_zone(&phrase.head).is_none()
        {
            phrase.could_be = Lexicon::get()
                .container_nouns(&phrase.head)
                .into_iter()
                .map(|noun| noun.name.clone())
                .collect();
            if phrase.could_be.is_empty() {
                self.query.not_understood.push(phrase.head.clone());
            }
        }
        self.query.not_understood.extend(phrase.unchecked.iter().cloned());
    }

    /// Handles a later sentence: it adds to the target ("it is brown"), or describes something in a
    /// relation to it.
    fn add_to_target(&mut self, mut more: Phrase) {
        let Some(target) = &mut self.target else {
            self.target = Some(more);
            return;
        };
        // "The grass is high again. Which machine do I take": the first noun is unknown, and a
        // known one follows.
        let of_it = more
            .relations
            .iter()
            .any(|relation| relation.anchors.iter().any(|anchor| anchor.head == ITSELF));
        if target.meaning() == Meaning::Unknown
            && matches!(more.meaning(), Meaning::Nouns(_))
            && !of_it
        {
            *target = more;
            return;
        }
        // "over at the table, the chair": the place came first.
        let unnamed = words::is_anything(&target.head) && target.uses.is_empty();
        let same = unnamed
            || words::is_anything(&more.head)
            || more.head == target.head
            || same_thing(&more, target);
        // "the red stool, the green one wobbles" describes another stool.
        let of_another = same
            && !target.colors.is_empty()
            && !more.colors.is_empty()
            && !more.colors.iter().any(|color| target.colors.contains(color))
            && matches!(more.head.as_str(), "one" | "ones" | "thing");
        if of_another {
            return;
        }
        if same {
            target.unchecked.append(&mut more.unchecked);
            target.count = target.count.or(more.count);
            target.colors.append(&mut more.colors);
            target.roughly |= more.roughly;
            target.other_than.append(&mut more.other_than);
            target.excluded.append(&mut more.excluded);
            target.traits.append(&mut more.traits);
            target.with.append(&mut more.with);
            target.relations.append(&mut more.relations);
            target.superlative = target.superlative.or(more.superlative);
            if unnamed && !words::is_anything(&more.head) {
                target.head = more.head;
            }
            return;
        }
        let to_target =
            |r: &Relation| r.anchors.iter().any(|a| a.head == ITSELF || a.head == target.head);
        let Some(i) = more.relations.iter().position(to_target) else {
            self.query.not_understood.push(more.head);
            return;
        };
        let Relation { kind, text, negated, .. } = more.relations.remove(i);
        target.relations.push(Relation {
            kind: kind.inverse(),
            text,
            anchors: vec![more],
            negated,
            rank: 1,
        });
    }
}

/// Returns the group that "the one on the right" belongs to: the wardrobes that the viewer faces,
/// the pictures on the wall it is on, the group it is in.
fn group_of(target: &Phrase, viewpoint: Option<&Viewpoint>) -> Option<Phrase> {
    let said = matches!(target.head.as_str(), "one" | "ones");
    if !(said || target.head.is_empty()) || !target.uses.is_empty() {
        return None;
    }
    let several = |phrase: &&Phrase| {
        phrase.count.is_some_and(|count| count > 1) || Lexicon::get().is_plural(&phrase.head)
    };
    let faced = viewpoint.map(|viewpoint| &viewpoint.anchor);
    let picked = target.superlative.is_some();
    // "the wall with five windows", "the wall of windows"
    let made_of = |phrase: &Phrase| {
        let plural = phrase.unchecked.iter().find(|word| Lexicon::get().is_plural(word));
        plural.map(|word| Phrase { head: word.clone(), ..Phrase::default() })
    };
    let within = |phrase: &Phrase| {
        phrase
            .with
            .iter()
            .map(|with| &with.phrase)
            .find(several)
            .cloned()
            .or_else(|| made_of(phrase))
    };
    if let Some(meant) = faced
        .and_then(within)
        .or_else(|| faced.filter(several).cloned())
        .or_else(|| faced.filter(|_| said).cloned())
    {
        return Some(meant).filter(|_| said || picked);
    }
    let anchors = || target.relations.iter().flat_map(|relation| &relation.anchors);
    let group = target
        .relations
        .iter()
        .filter(|relation| relation.kind == RelationKind::Inside)
        .flat_map(|relation| &relation.anchors);
    // "along the wall with five shelves it is the second": the question does not say "the one with
    // five shelves".
    let own = || within(target).filter(|_| !said);
    anchors()
        .find_map(within)
        .or_else(|| group.into_iter().find(several).cloned())
        .or_else(own)
        .filter(|_| picked)
}

/// Returns whether two phrases may name the same object: "armchair" and "chair".
fn same_thing(a: &Phrase, b: &Phrase) -> bool {
    match (a.meaning(), b.meaning()) {
        (Meaning::Nouns(a), Meaning::Nouns(b)) => match (a.first(), b.first()) {
            (Some(first), Some(second)) => b.contains(first) || a.contains(second),
            _ => false,
        },
        _ => false,
    }
}
