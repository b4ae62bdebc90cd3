//! Parses words into phrases: reads from left to right with a stack of open phrases, the innermost
//! on top.

mod closing;
mod opening;

use super::affordances::{self, Affordance};
use super::beginnings;
use super::corrections;
use super::distances;
use super::forms::{self, Form};
use super::languages;
use super::observers;
use super::pieces::{Piece, address, has_noun_ahead, is_bare_noun, is_filler, pieces};
use super::rewrites::rewrite;
use super::situations;
use super::tokens::{BREAK, correct_spelling, tokenize};
use super::words::{self, Meaning};
use super::{
    Look, ME, Measure, ParsedQuery, Phrase, Quantity, Relation, RelationKind, Superlative,
    instance_in, instances_in,
};
use uniground_models::attributes::Lexicon;

/// What a relation belongs to when it follows an object that is not the target.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Attach {
    /// The last object named: in "the cup on the table by the door", the table is by the door.
    Nearest,
    /// The target: the cup is by the door.
    Target,
}

/// The role of an open phrase.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Role {
    Target,
    /// A further statement after the target is known: "the chair is ...", "there is a lamp on it".
    More,
    /// Anchor of the last relation of the phrase below. `joined` by "and".
    Anchor {
        joined: bool,
    },
    With {
        absent: bool,
    },
    View(Look),
    /// The object that the viewer sits at and looks at.
    Seated,
    /// A phrase beyond the limit: read, but not used.
    Surplus,
}

/// Maximum number of relations that are used in one question, because each costs work. Real
/// questions have fewer.
const MAX_RELATIONS: u32 = 24;

#[derive(Debug, Clone, PartialEq)]
struct Frame {
    phrase: Phrase,
    role: Role,
    /// Unknown words since the last noun.
    unknown: Vec<String>,
    /// An article came after the noun: another object follows, in no relation that was understood.
    another: bool,
    /// "a", "an", "some" before the noun.
    indefinite: bool,
    /// Any article before the noun: what comes after it is no verb.
    determined: bool,
}

/// Reads a query. Never fails: words that are not understood are listed.
#[must_use]
pub fn parse(query: &str) -> ParsedQuery {
    let tokens = tokenize(query);
    let foreign = languages::is_foreign(&tokens);
    let is_one_of_several = tokens.first().is_some_and(|word| word == "which")
        && tokens.get(1).is_some_and(|word| word == "of")
        && tokens.iter().any(|word| word == "is");
    let tokens = distances::join(join_ids(tokens));
    let forms::Request { form, target, except, not_understood, unit } =
        forms::recognize(tokens, &|tokens| read_object(tokens.to_vec()));
    let mut parsed = read_object(target);
    parsed.not_understood.extend(not_understood);
    // "which of the two chairs is closer" asks for one of them.
    if is_one_of_several {
        parsed.quantity = Quantity::One;
    }
    let form = match (form, parsed.quantity) {
        (Form::Object, Quantity::All | Quantity::Exactly(_)) => Form::List,
        (form, _) => form,
    };
    for later in &mut parsed.later {
        later.form.clone_from(&form);
        later.except.clone_from(&except);
        later.unit = unit;
    }
    ParsedQuery { foreign, form, except, unit, ..parsed }
}

/// Joins an enumeration of instances to one token: "#3, #4 and #5" is `#3+#4+#5`.
fn join_ids(tokens: Vec<String>) -> Vec<String> {
    let mut joined: Vec<String> = Vec::with_capacity(tokens.len());
    let is_id = |token: Option<&String>| token.is_some_and(|token| instance_in(token).is_some());
    let mut at = 0;
    while at < tokens.len() {
        let mut end = at + 1;
        let mut ids = vec![tokens[at].clone()];
        while is_id(tokens.get(at)) {
            let between =
                tokens[end..].iter().take_while(|t| matches!(t.as_str(), BREAK | "and")).count();
            if between == 0 || !is_id(tokens.get(end + between)) {
                break;
            }
            ids.push(tokens[end + between].clone());
            end += between + 1;
        }
        // "the distance between #3 and #4" names two objects.
        if ids.len() > 2 || ids.len() == 2 && at > 0 && is_of_a_group(&tokens[..at]) {
            joined.push(ids.join("+"));
            at = end;
        } else {
            joined.push(tokens[at].clone());
            at += 1;
        }
    }
    joined
}

/// Returns whether the words before ids name what they are: "which of the mugs", "the mugs".
fn is_of_a_group(before: &[String]) -> bool {
    before.last().is_some_and(|word| {
        matches!(word.as_str(), "of" | "things") || Lexicon::get().is_plural(word)
    })
}

/// Reads words that describe an object.
fn read_object(tokens: Vec<String>) -> ParsedQuery {
    let tokens = observers::rewrite_viewpoints(&rewrite(corrections::apply_corrections(
        situations::drop_situation(tokens),
    )));
    let tokens = &tokens[address(&tokens)..];
    let (query, later) = beginnings::readings(tokens, read);
    ParsedQuery { later, ..query }
}

fn read(tokens: &[String]) -> ParsedQuery {
    let affordance = affordances::find(tokens);
    let (described, rest) = affordance.as_ref().map_or((&[][..], tokens), |found| {
        (&tokens[found.described.clone()], &tokens[found.taken..])
    });
    let pieces = pieces(&[described, rest].concat());
    let read = |attach: Attach| Reader::new(attach, affordance.as_ref()).run(&pieces);
    let mut nearest = read(Attach::Nearest);
    let target = read(Attach::Target);
    nearest.other_reading = (target.target != nearest.target).then_some(target.target);
    nearest
}

// Each flag records a word whose partner has not been read yet.
#[allow(clippy::struct_excessive_bools)]
struct Reader {
    attach: Attach,
    query: ParsedQuery,
    /// The target, or a further statement about it, is at the bottom. Empty between clauses.
    stack: Vec<Frame>,
    target: Option<Phrase>,
    relations: u32,
    negated: bool,
    /// Whether the last color was an excluded one: "not red or white".
    last_negated: bool,
    /// Nouns that the target must not have.
    other_things: Vec<String>,
    ordinal: Option<u32>,
    number: Option<u32>,
    /// "of" was read between two nouns.
    of: bool,
    same: bool,
    /// A comparison in front of its noun: "the closest chair to".
    compared: Option<(RelationKind, u32, String)>,
    /// Relations to the viewer's position; a later phrase may give it.
    from_here: Vec<Relation>,
    /// A new sentence about another object than the target begins.
    there_is: bool,
}

impl Reader {
    fn new(attach: Attach, affordance: Option<&Affordance>) -> Self {
        let mut reader = Self {
            attach,
            query: ParsedQuery::default(),
            stack: vec![Frame::new(Role::Target)],
            target: None,
            relations: 0,
            negated: false,
            last_negated: false,
            other_things: Vec::new(),
            ordinal: None,
            number: None,
            of: false,
            same: false,
            compared: None,
            from_here: Vec::new(),
            there_is: false,
        };
        if let Some(found) = affordance {
            let phrase = &mut reader.stack[0].phrase;
            "something".clone_into(&mut phrase.head);
            phrase.uses.clone_from(&found.uses);
            phrase.purpose.clone_from(&found.words);
        }
        reader
    }

    fn run(mut self, pieces: &[Piece]) -> ParsedQuery {
        for (i, piece) in pieces.iter().enumerate() {
            match piece {
                Piece::Noun(head) => self.noun(head, &pieces[i + 1..]),
                // "that is not plastic": the negation does not apply to the next object.
                Piece::Unknown(word) if std::mem::take(&mut self.negated) => {
                    self.last_negated = true;
                    if !words::is_material(word) {
                        self.query.not_understood.push(format!("not {word}"));
                    }
                    self.top().phrase.excluded.push(word.clone());
                }
                Piece::Unknown(word) => self.top().unknown.push(word.clone()),
                Piece::Break if self.describes() && has_noun_ahead(&pieces[i + 1..]) => {}
                Piece::Break => self.pause(),
                Piece::Word(meaning, text) => self.word(*meaning, text, &pieces[i + 1..]),
            }
        }
        self.pause();
        self.finish()
    }

    fn top(&mut self) -> &mut Frame {
        if self.stack.is_empty() {
            let role = if self.target.is_some() { Role::More } else { Role::Target };
            self.stack.push(Frame::new(role));
        }
        let last = self.stack.len() - 1;
        &mut self.stack[last]
    }

    fn noun(&mut self, head: &str, rest: &[Piece]) {
        let (of, number) = (std::mem::take(&mut self.of), self.number.take());
        // "which of the mugs #3, #4 and #5"
        if let Some(ids) = instances_in(head) {
            let frame = self.top();
            if frame.phrase.head.is_empty() {
                "things".clone_into(&mut frame.phrase.head);
            }
            frame.phrase.among = ids;
            return;
        }
        // "that is not glass"
        if self.negated && words::is_material(head) {
            (self.negated, self.last_negated) = (false, true);
            self.top().phrase.excluded.push(head.to_owned());
            return;
        }
        // "not the chair by the door" negates the relation, "not the armchair" the noun.
        let relation_follows = rest.iter().find(|piece| !is_filler(piece)).is_some_and(|piece| {
            matches!(
                piece,
                Piece::Word(
                    Meaning::Relation(_)
                        | Meaning::Color(_)
                        | Meaning::With { .. }
                        | Meaning::Superlative(_),
                    _
                )
            )
        });
        if self.negated && !relation_follows && !words::is_anything(head) {
            self.negated = false;
            self.other_things.push(head.to_owned());
            return;
        }
        let frame = self.top();
        frame.phrase.count = number.or(frame.phrase.count);
        let before = frame.phrase.head.clone();
        if before.is_empty()
            || words::is_anything(&before) && !head.is_empty() && frame.phrase.uses.is_empty()
        {
            // "filing cabinets ... the one": a pronoun never replaces a noun, a noun replaces a
            // pronoun.
            head.clone_into(&mut frame.phrase.head);
        } else if of
            && words::is_part_of_furniture(&before)
            && matches!(frame.role, Role::Anchor { .. })
        {
            // "over the headboard of the bed" is over the bed.
            head.clone_into(&mut frame.phrase.head);
        } else if of && words::is_measure(head) {
            // "the box at the top of the stack": identified by the side.
        } else if of && !words::is_measure(&before) && !words::is_part(&before) {
            // "the bowl of apples" is a bowl.
            frame.phrase.unchecked.push(head.to_owned());
        } else if frame.another {
            frame.unknown.push(head.to_owned());
            frame.another = false;
            self.query.not_understood.append(
                &mut self
                    .stack
                    .last_mut()
                    .map(|f| std::mem::take(&mut f.unknown))
                    .unwrap_or_default(),
            );
            return;
        } else if !words::is_anything(head) {
            // "computer desk": in English the last noun is the head.
            frame.phrase.unchecked.push(before);
            head.clone_into(&mut frame.phrase.head);
        }
        let unknown = std::mem::take(&mut frame.unknown);
        frame.phrase.unchecked.extend(unknown);
    }

    fn word(&mut self, meaning: Meaning, text: &str, rest: &[Piece]) {
        match meaning {
            Meaning::Relation(kind)
                if kind.is_comparison()
                    && !text.ends_with(" to")
                    && !text.ends_with(" from")
                    && (is_bare_noun(rest)
                        || matches!(rest.first(), Some(Piece::Word(Meaning::Of, _)))) =>
            {
                let rank = self.ordinal.take().unwrap_or(1);
                self.compared = Some((kind, rank, text.to_owned()));
            }
            Meaning::Relation(kind) => self.relation(kind, text),
            Meaning::With { absent } => {
                let absent = absent || std::mem::take(&mut self.negated);
                if self.stack.last().is_some_and(|f| {
                    matches!(f.role, Role::Anchor { .. } | Role::With { .. }) && f.is_empty()
                }) {
                    self.pop();
                }
                self.number = None;
                self.push(Role::With { absent });
            }
            Meaning::View(look) => self.view(Role::View(look), text),
            Meaning::Seated => self.view(Role::Seated, text),
            Meaning::Entering => {
                let anchor = Phrase { head: "door".into(), ..Phrase::default() };
                self.finish_viewpoint(Look::From, anchor);
            }
            Meaning::Superlative(measure) => self.superlative(measure, text, rest),
            Meaning::FromSide(measure) => {
                let rank = self.ordinal.take().unwrap_or(1);
                self.bottom().superlative = Some(Superlative { measure, rank });
            }
            Meaning::Ordinal(rank) => self.ordinal = Some(rank),
            Meaning::Number(count) => self.number = Some(count),
            // "not on a nightstand or a desk": on neither.
            Meaning::Or if self.repeats_negated_relation() => {}
            Meaning::Or => self.negated = self.last_negated,
            Meaning::Bare => {
                self.push(Role::With { absent: true });
                "thing".clone_into(&mut self.top().phrase.head);
                self.pop();
            }
            Meaning::Side(measure) => {
                let kind = if measure == Measure::Leftmost {
                    RelationKind::LeftOf
                } else {
                    RelationKind::RightOf
                };
                self.relation(kind, text);
                self.pronoun();
            }
            Meaning::Color(color) => {
                let negated = std::mem::take(&mut self.negated);
                self.last_negated = negated;
                let phrase = &mut self.top().phrase;
                phrase.roughly |= words::is_rough_color(text);
                if negated { phrase.other_than.push(color) } else { phrase.colors.push(color) }
            }
            Meaning::Trait(seen) => self.top().phrase.traits.push(seen),
            Meaning::Not => {
                self.agree(text);
                self.negated = true;
            }
            Meaning::And => self.and(rest),
            // "the closest of the chairs" asks for a chair.
            Meaning::Of => {
                self.of = self.compared.is_none();
                // "at the head of the bed" is at the bed.
                if let Some(frame) = self.stack.last_mut() {
                    frame.unknown.pop_if(|word| words::is_part(word));
                }
            }
            Meaning::Same => self.same = true,
            Meaning::As => {
                if std::mem::take(&mut self.same) {
                    self.push(Role::With { absent: false });
                }
            }
            // A description comes next: "it is facing the door" describes the object, not a viewer.
            Meaning::OfTarget => {
                self.unwind(0);
                self.top();
            }
            Meaning::Determiner => self.determiner(text),
            Meaning::All => {
                if self.target.is_none()
                    && self.stack.len() <= 1
                    && self.top().phrase.head.is_empty()
                {
                    self.query.quantity = Quantity::All;
                }
            }
            Meaning::Filler => self.filler(text),
            // "the slim case that is squeezed in": the words before name it.
            Meaning::OfLast => {
                self.name_by_unknown();
                self.agree(text);
            }
            Meaning::ThereIs => {
                self.unwind(0);
                self.there_is = self.target.is_some();
            }
            Meaning::Pronoun => self.pronoun(),
        }
    }

    /// Begins another anchor of a negated relation; returns whether the last one is negated.
    fn repeats_negated_relation(&mut self) -> bool {
        let [.., below, anchor] = &self.stack[..] else { return false };
        let is_anchor = matches!(anchor.role, Role::Anchor { .. }) && !anchor.is_empty();
        let Some(relation) =
            below.phrase.relations.last().filter(|relation| is_anchor && relation.negated)
        else {
            return false;
        };
        let (kind, text) = (relation.kind, relation.text.clone());
        self.pop();
        self.negated = true;
        self.relation(kind, &text);
        true
    }

    /// Closes the objects that a verb does not agree with: in "the chairs around the table that
    /// are green" the chairs are green. Where it agrees with several, the reading decides.
    fn agree(&mut self, text: &str) {
        let is_plural = match text.rsplit(' ').next() {
            Some("are" | "aren't") => true,
            Some("is" | "isn't") => false,
            _ => return,
        };
        let agrees = |frame: &Frame| {
            let phrase = &frame.phrase;
            let several =
                phrase.count.map_or_else(|| Lexicon::get().is_plural(&phrase.head), |n| n > 1);
            !phrase.head.is_empty() && several == is_plural
        };
        let Some(last) = self.stack.len().checked_sub(1) else { return };
        let is_anchor = |frame: &Frame| {
            matches!(frame.role, Role::Anchor { .. } | Role::With { .. })
                && !frame.phrase.head.is_empty()
        };
        // "everything on the table that is not red"
        let is_list_of_anything =
            |frame: &Frame| matches!(frame.phrase.head.as_str(), "things" | "objects" | "items");
        if self.stack.first().is_some_and(is_list_of_anything)
            && self.stack[1..].iter().all(is_anchor)
        {
            return self.unwind(1);
        }
        let Some(keep) = (0..=last).rev().find(|&i| agrees(&self.stack[i])) else { return };
        if self.stack[keep + 1..].iter().all(is_anchor) {
            self.unwind(keep + 1);
        }
        let is_first_meant = self.attach == Attach::Target
            && self.stack.len() > 1
            && agrees(&self.stack[0])
            && self.stack[1..].iter().all(is_anchor);
        if is_first_meant {
            self.unwind(1);
        }
    }

    /// Handles an article: a noun will follow, and a phrase without a noun cannot get one anymore.
    fn determiner(&mut self, text: &str) {
        let of = self.of;
        let frame = self.top();
        frame.indefinite |= frame.is_empty() && matches!(text, "a" | "an" | "some" | "any");
        let another =
            !frame.phrase.head.is_empty() && !words::is_anything(&frame.phrase.head) && !of;
        frame.another = another;
        // "facing the mural the table": an unknown noun ends here.
        let unknown = frame.phrase.head.is_empty() && !frame.unknown.is_empty() && !of;
        let determined = frame.determined;
        frame.determined |= frame.is_empty();
        if (another || unknown) && self.awaits_target() {
            self.unwind(1);
        } else if unknown && determined {
            self.name_by_unknown();
            self.top().another = true;
        }
    }

    /// Returns whether the innermost phrase has a description, but no noun.
    fn describes(&self) -> bool {
        self.stack.last().is_some_and(|Frame { phrase, unknown, .. }| {
            let described =
                !(phrase.colors.is_empty() && phrase.traits.is_empty() && unknown.is_empty());
            described
                && phrase.head.is_empty()
                && phrase.uses.is_empty()
                && phrase.relations.is_empty()
        })
    }

    /// Makes the last unknown word the noun of the innermost phrase, because no other noun can
    /// come.
    fn name_by_unknown(&mut self) {
        let Some(frame) = self
            .stack
            .last_mut()
            .filter(|frame| frame.phrase.head.is_empty() && frame.phrase.uses.is_empty())
        else {
            return;
        };
        if let Some(word) = frame.unknown.pop() {
            frame.phrase.head = correct_spelling(&word).map_or(word, str::to_owned);
            frame.phrase.unchecked.append(&mut frame.unknown);
        }
    }

    /// Handles words that have a meaning in some positions only.
    fn filler(&mut self, text: &str) {
        match text {
            "me" | "us" | "myself" | "you" if self.awaits_anchor() => {
                ME.clone_into(&mut self.top().phrase.head);
            }
            "to" | "from" if self.compared.is_some() => {
                if let Some((kind, rank, words)) = self.compared.take() {
                    self.ordinal = Some(rank);
                    self.relation(kind, &format!("{words} {text}"));
                }
            }
            // "when you look at the tv from the sofa"
            "from"
                if self
                    .stack
                    .last()
                    .is_some_and(|f| matches!(f.role, Role::View(Look::Facing) | Role::Seated)) =>
            {
                let keep = usize::from(self.stack.first().is_some_and(|f| {
                    !matches!(f.role, Role::View(_) | Role::Seated) && !f.phrase.is_empty()
                }));
                self.unwind(keep);
                self.push(Role::View(Look::From));
            }
            // "fetch the cup from the shelf"
            "from"
                if self.stack.last().is_some_and(|f| {
                    f.phrase.uses.is_empty() && !(f.phrase.head.is_empty() && f.unknown.is_empty())
                }) =>
            {
                self.name_by_unknown();
                self.relation(RelationKind::Near, text);
            }
            _ => {}
        }
    }

    fn awaits_anchor(&self) -> bool {
        self.stack.last().is_some_and(|f| matches!(f.role, Role::Anchor { .. }) && f.is_empty())
    }

    /// Returns whether nothing has been named yet except what the viewer looks at or what the
    /// target is next to: "facing the bed the lamp on the left".
    fn awaits_target(&self) -> bool {
        let target = self.stack.first().filter(|frame| frame.role == Role::Target);
        self.stack.len() > 1
            && target
                .is_some_and(|frame| frame.phrase.head.is_empty() && frame.phrase.uses.is_empty())
    }

    fn and(&mut self, rest: &[Piece]) {
        // "between the sprocket and the lamp": an unknown noun ends here.
        if matches!(rest.first(), Some(Piece::Word(Meaning::Determiner, _))) {
            self.name_by_unknown();
        }
        match self.stack.last() {
            // "orange and black desk": one object of two colors.
            Some(frame) if frame.phrase.head.is_empty() => {}
            Some(Frame { role: Role::Anchor { .. }, .. }) => {
                self.pop();
                self.push(Role::Anchor { joined: true });
            }
            Some(Frame { role: Role::With { absent }, .. }) => {
                let absent = *absent;
                self.pop();
                self.push(Role::With { absent });
            }
            _ => {}
        }
    }

    /// Handles "it" within a relation: the object that the viewer looks at, or the target of a
    /// sentence about another object.
    fn pronoun(&mut self) {
        if !self.awaits_anchor() {
            return;
        }
        if self.there_is && self.stack.first().is_some_and(|f| f.role == Role::More) {
            ITSELF.clone_into(&mut self.top().phrase.head);
        } else if let Some(viewpoint) = self.query.viewpoint.clone() {
            self.top().phrase = viewpoint.anchor;
        }
    }

    /// Handles a comma or full stop. After it a new phrase may begin; further relations describe
    /// the target.
    fn pause(&mut self) {
        self.unwind(0);
        // "the nearest chair": nearest to the viewer, if there is one.
        if let Some((kind, rank, text)) = self.compared.take() {
            self.from_here.push(Relation { kind, text, anchors: Vec::new(), negated: false, rank });
        }
        (self.negated, self.of, self.same, self.number, self.there_is) =
            (false, false, false, None, false);
    }

    fn push(&mut self, role: Role) {
        self.top();
        self.stack.push(Frame::new(role));
    }

    /// Returns the phrase at the bottom: the target, or a further statement about it.
    fn bottom(&mut self) -> &mut Phrase {
        self.top();
        &mut self.stack[0].phrase
    }

    /// Closes open phrases until `keep` are left.
    fn unwind(&mut self, keep: usize) {
        while self.stack.len() > keep {
            self.pop();
        }
    }
}

/// Head of an anchor that is the target itself.
const ITSELF: &str = "it";

impl Frame {
    fn new(role: Role) -> Self {
        Self {
            phrase: Phrase::default(),
            role,
            unknown: Vec::new(),
            another: false,
            indefinite: false,
            determined: false,
        }
    }

    fn is_empty(&self) -> bool {
        self.phrase.is_empty() && self.unknown.is_empty()
    }
}

#[cfg(test)]
mod tests;
