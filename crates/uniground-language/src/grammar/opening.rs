//! Handles words that open phrases or select one object of its kind: what follows them, and what
//! they belong to.

use super::{Attach, Frame, MAX_RELATIONS, Reader, Role};
use crate::pieces::{Piece, is_filler, is_structural};
use crate::words::{self, Meaning};
use crate::{Look, Measure, Relation, RelationKind, Superlative};
use uniground_models::attributes::Lexicon;

impl Reader {
    pub(super) fn relation(&mut self, kind: RelationKind, text: &str) {
        // "between the sofa and next to the lamp", "on the": an anchor without a noun.
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
        // The floor has no place of its own: "on the floor next to the sofa" describes the object.
        if self
            .stack
            .last()
            .is_some_and(|f| matches!(f.role, Role::Anchor { .. }) && is_structural(&f.phrase.head))
        {
            self.unwind(1);
        }
        // Comparisons single out the target. Other relations belong to the last object, or to the
        // target, depending on the reading.
        let of_a_view = self.awaits_target()
            && self.stack[1..]
                .iter()
                .any(|frame| matches!(frame.role, Role::View(_) | Role::Seated));
        if self.stack.len() > 1
            && !of_a_view
            && (self.attach == Attach::Target
                || kind.is_comparison()
                || self.stack[0].phrase.is_empty())
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

    /// Handles "facing the window, the curtain": a viewpoint. After a noun ("the chair facing the
    /// window") it is a relation of that object.
    pub(super) fn view(&mut self, role: Role, text: &str) {
        // "the chair facing the window", "the chair standing by the door": the object is meant, not
        // a viewer.
        let after_noun = self
            .stack
            .last()
            .is_some_and(|f| f.role != Role::View(Look::From) && !f.phrase.head.is_empty());
        let somebody = [
            "you",
            "i ",
            "when",
            "while",
            "seen",
            "viewed",
            "perspective",
            "view",
            "your",
            "my",
            "as ",
        ]
        .iter()
        .any(|word| text.contains(word));
        let of_the_target =
            text.starts_with("facing") && self.stack.len() == 1 && self.stack[0].role == Role::More;
        if (after_noun || of_the_target) && !somebody {
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

    /// Handles an extreme: "the tallest bookcase", "the one on the left". With "of" and an object
    /// after it, the sides become relations.
    pub(super) fn superlative(&mut self, measure: Measure, text: &str, rest: &[Piece]) {
        // "not the middle one": any but that one may be meant.
        if std::mem::take(&mut self.negated) {
            return self.query.not_understood.push(format!("not {text}"));
        }
        let of = parse_of(rest);
        // "the back of the chair" is the chair.
        if matches!(of, Some(Of::Thing))
            && text.starts_with("the ")
            && self.stack.last().is_none_or(Frame::is_empty)
        {
            return;
        }
        // "the desk with two monitors on top": the place of the monitors.
        if text.ends_with("top")
            && self
                .stack
                .last()
                .is_some_and(|f| matches!(f.role, Role::With { .. }) && !f.is_empty())
        {
            return;
        }
        let unnamed =
            self.stack.last().is_none_or(|f| f.phrase.head.is_empty() && f.role == Role::Target);
        let kind = match (measure, of) {
            // "the higher of the shelves", "the box at the top of the stack": one of a group.
            (_, Some(Of::Group) | None) => None,
            (_, Some(Of::Several)) if unnamed => None,
            (Measure::Middle, Some(Of::Several)) => Some(RelationKind::Between),
            (Measure::Leftmost, _) => Some(RelationKind::LeftOf),
            (Measure::Rightmost, _) => Some(RelationKind::RightOf),
            (Measure::Frontmost, _) => Some(RelationKind::InFrontOf),
            (Measure::Backmost, _) => Some(RelationKind::Behind),
            (Measure::Highest, _) => Some(RelationKind::On),
            (Measure::Lowest | Measure::Middle, _) => Some(RelationKind::Inside),
            _ => None,
        };
        if let Some(kind) = kind {
            return self.relation(kind, text);
        }
        let side = matches!(measure, Measure::Leftmost | Measure::Rightmost);
        // "from the door, the first chair on the left": of those to the left, the one nearest to
        // the door.
        if side
            && self.query.standpoint.is_some()
            && let Some(rank) = self.ordinal.take()
        {
            let kind = if measure == Measure::Leftmost {
                RelationKind::LeftOf
            } else {
                RelationKind::RightOf
            };
            let relation = |kind, rank| Relation {
                kind,
                text: text.to_owned(),
                anchors: Vec::new(),
                negated: false,
                rank,
            };
            self.from_here.extend([relation(kind, 1), relation(RelationKind::Closest, rank)]);
            return;
        }
        // "facing the wall left monitor"
        let named = self.stack.last().is_some_and(|frame| !frame.is_empty());
        if (matches!(text, "left" | "right") || text.starts_with("the "))
            && named
            && self.awaits_target()
        {
            self.unwind(1);
        }
        let rank = self.ordinal.take().unwrap_or(1);
        let superlative = Some(Superlative { measure, rank });
        // "the tallest bookcase" applies to the next noun, "the mug ... on the left" to the target.
        let of_what_follows = !IN_A_PLACE.iter().any(|begin| text.starts_with(begin))
            && self.stack.last().is_some_and(|f| f.phrase.head.is_empty());
        if of_what_follows {
            self.top().phrase.superlative = superlative;
        } else {
            self.bottom().superlative = superlative;
        }
    }
}

/// Beginnings of extremes that give a position, rather than select one of the objects named next.
const IN_A_PLACE: [&str; 4] = ["on ", "in ", "at ", "to "];

/// What follows "of" after an extreme.
enum Of {
    /// "the stack", "the three", "them": objects of its own kind.
    Group,
    /// "the two chairs": more than one, by name.
    Several,
    /// "the table".
    Thing,
}

fn parse_of(rest: &[Piece]) -> Option<Of> {
    let [Piece::Word(Meaning::Of, _), rest @ ..] = rest else { return None };
    let counted = rest
        .iter()
        .take_while(|piece| !matches!(piece, Piece::Noun(_) | Piece::Unknown(_) | Piece::Break))
        .any(|piece| matches!(piece, Piece::Word(Meaning::Number(2..), _)));
    let told = |piece: &&Piece| {
        !is_filler(piece)
            && !matches!(
                piece,
                Piece::Word(Meaning::Number(_) | Meaning::Color(_) | Meaning::Trait(_), _)
            )
    };
    Some(match rest.iter().find(told) {
        Some(Piece::Noun(noun) | Piece::Unknown(noun)) if words::is_measure(noun) => Of::Group,
        Some(Piece::Noun(noun))
            if !words::is_anything(noun) && (counted || Lexicon::get().is_plural(noun)) =>
        {
            Of::Several
        }
        Some(Piece::Noun(noun)) if !words::is_anything(noun) => Of::Thing,
        Some(Piece::Unknown(_)) if !counted => Of::Thing,
        _ => Of::Group,
    })
}
