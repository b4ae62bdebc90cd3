//! Words that open phrases, or say which of its like a thing is: what follows them, and what they belong to.

use super::{Attach, Frame, MAX_RELATIONS, Reader, Role};
use crate::grounding::query::pieces::{Piece, structural};
use crate::grounding::query::words::Meaning;
use crate::grounding::query::{Look, Measure, Relation, RelationKind, Superlative};

impl Reader {
    pub(super) fn relation(&mut self, kind: RelationKind, text: &str) {
        // "between the sofa and next to the lamp", "on the": an anchor that never came.
        while self.stack.len() > 1 && self.stack.last().is_some_and(Frame::is_empty) {
            let joined = self.stack.last().is_some_and(|f| f.role == Role::Anchor { joined: true });
            self.pop();
            if joined {
                self.unwind(1);
            }
        }
        if self.stack.is_empty() {
            self.top();
        }
        // The floor has no place of its own: "on the floor next to the sofa" speaks of the thing.
        if self
            .stack
            .last()
            .is_some_and(|f| matches!(f.role, Role::Anchor { .. }) && structural(&f.phrase.head))
        {
            self.unwind(1);
        }
        // Comparisons single out the target; the rest belongs to the last thing, or to the target, by reading.
        let of_a_view = self.awaits_target() && self.stack[1..].iter().any(|frame| matches!(frame.role, Role::View(_) | Role::Seated));
        if self.stack.len() > 1 && !of_a_view && (self.attach == Attach::Target || kind.is_comparison() || self.stack[0].phrase.is_empty())
        {
            self.unwind(1);
        }
        self.relations += 1;
        if self.relations > MAX_RELATIONS {
            self.query.not_understood.push(text.to_owned());
            self.unwind(1);
            return self.push(Role::Surplus);
        }
        let negated = std::mem::take(&mut self.negated);
        let rank = if kind.is_comparison() { self.ordinal.take().unwrap_or(1) } else { 1 };
        let relation = Relation { kind, text: text.to_owned(), anchors: Vec::new(), negated, rank };
        self.top().phrase.relations.push(relation);
        if !kind.is_of_the_room() {
            self.push(Role::Anchor { joined: false });
        }
    }

    /// "facing the window, the curtain": how somebody looks; after a noun ("the chair facing the window") a relation of that thing.
    pub(super) fn view(&mut self, role: Role, text: &str) {
        // "the chair facing the window", "the chair standing by the door": of the thing, not of somebody.
        let after_noun = self.stack.last().is_some_and(|f| f.role != Role::View(Look::From) && !f.phrase.head.is_empty());
        let somebody = ["you", "i ", "when", "while", "seen", "viewed", "perspective", "view", "your", "my", "as "]
            .iter()
            .any(|word| text.contains(word));
        if after_noun && !somebody {
            let kind = if text == "facing" || text == "facing towards" || text == "facing toward" {
                RelationKind::Facing
            } else {
                RelationKind::Near
            };
            return self.relation(kind, text);
        }
        let keep = usize::from(self.stack.first().is_some_and(|f| !f.phrase.is_empty()));
        self.unwind(keep);
        self.push(role);
    }

    /// "the tallest bookcase", "the one on the left": an extreme; with "of" behind it, the sides become relations.
    pub(super) fn superlative(&mut self, measure: Measure, text: &str, rest: &[Piece]) {
        let followed_by_of = matches!(rest.first(), Some(Piece::Word(Meaning::Of, _)));
        let side = match measure {
            Measure::Leftmost => Some(RelationKind::LeftOf),
            Measure::Rightmost => Some(RelationKind::RightOf),
            Measure::Frontmost => Some(RelationKind::InFrontOf),
            Measure::Backmost => Some(RelationKind::Behind),
            Measure::Highest => Some(RelationKind::On),
            Measure::Lowest | Measure::Middle => Some(RelationKind::Inside),
            _ => None,
        };
        // "the back of the chair" is the chair.
        if followed_by_of && text.starts_with("the ") && self.stack.last().is_none_or(Frame::is_empty) {
            return;
        }
        if let Some(kind) = side.filter(|_| followed_by_of) {
            return self.relation(kind, text);
        }
        // "from the door, the first chair on the left": of those to the left, the one met first.
        if let Some(kind) = side.filter(|k| matches!(k, RelationKind::LeftOf | RelationKind::RightOf))
            && self.query.standpoint.is_some()
            && let Some(rank) = self.ordinal.take()
        {
            let relation = |kind, rank| Relation { kind, text: text.to_owned(), anchors: Vec::new(), negated: false, rank };
            self.from_here.extend([relation(kind, 1), relation(RelationKind::Closest, rank)]);
            return;
        }
        // "facing the wall left monitor"
        if matches!(text, "left" | "right") && self.awaits_target() {
            self.unwind(1);
        }
        let rank = self.ordinal.take().unwrap_or(1);
        let superlative = Some(Superlative { measure, rank });
        // "the tallest bookcase" speaks of what follows, "the mug ... on the left" of the target.
        let of_what_follows = self.stack.last().is_some_and(|f| f.phrase.head.is_empty());
        if of_what_follows { self.top().phrase.superlative = superlative } else { self.bottom().superlative = superlative }
    }
}
