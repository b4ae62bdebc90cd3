//! Explains decisions in words that a person can check against the room.

use super::builtin::MIN_COLOR;
use crate::answer::{describe_instance, superlative_words};
use crate::assess::{Assessment, Assessor};
use crate::fit::{
    CALLED_SO, can_check_word, color_fit, colors_fit, excluded_words_fit, most_plausible,
};
use crate::readings::Readings;
use crate::relations::SeenBy;
use crate::{GivenName, SceneView};
use std::fmt::Write;
use uniground_geometry::color::ColorName;
use uniground_geometry::scene::Instance;
use uniground_language::{ME, Meaning, ParsedQuery, Phrase, Relation, RelationKind};

/// Explains a choice: "Instance 13 (brown chair, 0.45 x 0.48 x 0.90 m) is taken for "chair" (0.93),
/// is brown (0.80); closest to instance 2 (brown table), 0.40 m apart, of 4 chairs (1.00)."
// Writing to a String cannot fail.
pub(super) fn explain(
    assessor: &Assessor,
    phrase: &Phrase,
    read: &Assessment,
    best: usize,
    looked_by: &[usize],
) -> String {
    let instances = assessor.scene.instances;
    let instance = &instances[best];
    let size = instance.aabb.size;
    let (is_named, taken) = name_reason(assessor.scene, phrase, read.nouns[best], best);
    let described = if is_named {
        describe_instance(instance)
    } else {
        // Its name would contradict the sentence.
        main_color(instance).map_or("of no clear color", ColorName::as_str).to_owned()
    };
    let mut text = format!(
        "Instance {} ({described}, {:.2} x {:.2} x {:.2} m) {taken}",
        instance.id, size.x, size.y, size.z
    );
    for &color in &phrase.colors {
        let fit = color_fit(assessor.scene, color, best);
        let _ = write!(text, ", {} ({fit:.2})", color_reason(assessor.scene, color, fit, best));
    }
    for word in &phrase.excluded {
        let seen = if can_check_word(assessor.scene, word) { "" } else { " cannot be checked" };
        let _ = write!(text, ", \"not {word}\"{seen}");
        if seen.is_empty() {
            let fit = excluded_words_fit(assessor.scene, phrase, best);
            let _ = write!(text, " ({fit:.2})");
        }
    }
    if !phrase.other_than.is_empty() {
        let names: Vec<_> = phrase.other_than.iter().map(|c| c.as_str()).collect();
        let _ = write!(
            text,
            ", is not {} ({:.2})",
            names.join(" or "),
            colors_fit(assessor.scene, phrase, best)
        );
    }
    let rivals = || most_plausible(&read.own, usize::MAX).len();
    for (relation, bonds) in phrase.relations.iter().zip(&read.bonds) {
        let bond = bonds[best];
        let not = if relation.negated { "not " } else { "" };
        let of = if relation.kind.is_comparison() {
            format!(", of {}", rivals())
        } else {
            String::new()
        };
        match bond.anchor.map(|id| id.0 as usize - 1) {
            Some(a) => {
                let anchor = &instances[a];
                let gap = assessor.solids[best].gap(&assessor.solids[a]);
                let (name, score) = (describe_instance(anchor), bond.score);
                // "(brown table, the likeliest "cabinet")" shows what the answer is based on.
                let mistaken = relation.anchors.first().filter(|said| {
                    assessor.scene.names.get(a).is_none() && !is_called(anchor, said)
                });
                let taken = mistaken
                    .map_or_else(String::new, |said| format!(", the likeliest \"{}\"", said.head));
                let faced = relation.kind.is_a_side()
                    && assessor.at_side(relation.kind, best, a).1 == SeenBy::WhoFacesIt;
                let seen = if faced { " as who faces it sees it" } else { "" };
                let _ = write!(
                    text,
                    "; {not}{} instance {} ({name}{taken}){seen}, {gap:.2} m apart{of} ({score:.2})",
                    in_words(relation),
                    anchor.id
                );
            }
            // A relation without an anchor cannot have decided.
            None if relation.anchors.is_empty() && !relation.kind.is_of_the_room() => {}
            None if relation.anchors.iter().any(|anchor| anchor.head == ME) => {
                let words = in_words(relation);
                let _ = match &assessor.observer {
                    Some(observer) => write!(
                        text,
                        "; {not}{words} you, {:.2} m apart{of} ({:.2})",
                        assessor.solids[best].gap(observer),
                        bond.score
                    ),
                    None => write!(
                        text,
                        "; \"{words} me\" is not checked, as the request has no observer"
                    ),
                };
            }
            None => {
                let _ = write!(text, "; {not}{} ({:.2})", relation.text, bond.score);
            }
        }
    }
    for with in &phrase.with {
        let _ = write!(
            text,
            "; {} {}",
            if with.absent { "without" } else { "with" },
            with.phrase.text()
        );
    }
    if let Some(superlative) = phrase.superlative {
        let seen = if read.place_seen_by[best] == SeenBy::WhoFacesIt {
            " as who stands before them sees them"
        } else {
            ""
        };
        let _ = write!(text, "; {} of {}{seen}", superlative_words(&superlative), rivals());
    }
    if let [by, others @ ..] = looked_by {
        let _ = write!(
            text,
            "; seen with regard to instance {} ({})",
            instances[*by].id,
            describe_instance(&instances[*by])
        );
        let others: Vec<String> = others.iter().map(|&i| instances[i].id.to_string()).collect();
        let _ = if others.is_empty() {
            Ok(())
        } else {
            write!(text, ", though {} may be meant", others.join(" or "))
        };
    }
    text.push('.');
    text
}

/// Returns whether an instance's own name is what a phrase asks for, and what the instance is taken
/// for, with its fit: `is taken for "mug" (0.93)`, or `may be a "bowl" (0.50), though it measures
/// more like a laptop`.
fn name_reason(scene: SceneView, phrase: &Phrase, fit: f32, index: usize) -> (bool, String) {
    let instance = &scene.instances[index];
    let head = match (&phrase.head, phrase.uses.is_empty()) {
        (_, false) => return (true, format!("is {} ({fit:.2})", phrase.text())),
        (_, true) if !phrase.among.is_empty() => {
            return (true, "is one of those that the question is about".to_owned());
        }
        (head, true) if head.is_empty() => return (true, format!("is a thing ({fit:.2})")),
        (head, true) => head,
    };
    if let (Some(name), Some(given)) = (scene.names.get(index), &instance.given_name) {
        let noun = Readings::of(phrase);
        let noun = noun.best_noun(name);
        let reason = if fit >= CALLED_SO || given.contains(noun) {
            format!("is named as \"{noun}\" ({fit:.2})")
        } else if fit > 0.0 {
            format!("is named \"{given}\", which may be a \"{noun}\" ({fit:.2})")
        } else {
            format!("is named \"{given}\", not \"{noun}\" ({fit:.2})")
        };
        return (true, reason);
    }
    if is_called(instance, phrase) {
        return (true, format!("is taken for \"{head}\" ({fit:.2})"));
    }
    let compared = if scene.appearance.is_some() { "looks" } else { "measures" };
    let label = instance.label();
    (false, format!("may be \"{head}\" ({fit:.2}), though it {compared} more like \"{label}\""))
}

/// Returns what an instance shows of a requested color: "is grey", "is white, not grey".
fn color_reason(scene: SceneView, color: ColorName, fit: f32, index: usize) -> String {
    let named = scene.names.get(index).map(GivenName::colors).unwrap_or_default();
    let main = named.first().copied().or_else(|| main_color(&scene.instances[index]));
    let asked = color.as_str();
    match main.filter(|main| *main != color && !named.contains(&color)) {
        None => format!("is {asked}"),
        Some(main) if fit < MIN_COLOR => format!("is {}, not {asked}", main.as_str()),
        Some(main) => format!("is {asked} in part and mostly {}", main.as_str()),
    }
}

fn main_color(instance: &Instance) -> Option<ColorName> {
    instance.colors.dominant().first().map(|(color, _)| *color)
}

/// Returns a relation in words: "further away" becomes "further away from".
fn in_words(relation: &Relation) -> String {
    let preposition = match relation.kind {
        RelationKind::Closest => " to",
        RelationKind::Farthest => " from",
        _ => "",
    };
    let ends = [" to", " from", " of", " by"].iter().any(|word| relation.text.ends_with(word));
    format!("{}{}", relation.text, if ends { "" } else { preposition })
}

/// Returns whether the measures' first guess for an instance is what a phrase says.
fn is_called(instance: &Instance, said: &Phrase) -> bool {
    match said.meaning() {
        Meaning::Anything | Meaning::Unknown => true,
        Meaning::Instance(id) => instance.id == id,
        Meaning::Structure(structure) => instance.structure == Some(structure),
        Meaning::Nouns(nouns) => instance
            .names
            .first()
            .is_none_or(|guess| nouns.iter().any(|noun| noun.name == guess.name)),
    }
}

pub(super) fn explain_several(scene: SceneView, target: &Phrase, several: &[usize]) -> String {
    let ids: Vec<String> = several.iter().map(|&i| scene.instances[i].id.to_string()).collect();
    format!("{} instances fit \"{}\": {}.", several.len(), target.text(), ids.join(", "))
}

pub(super) fn explain_tie(scene: SceneView, target: &Phrase, tied: &[usize]) -> String {
    let ids: Vec<String> =
        tied.iter().take(6).map(|&i| scene.instances[i].id.to_string()).collect();
    format!(
        "{} instances fit \"{}\" alike: {}. Say more about the one you mean.",
        tied.len(),
        target.text(),
        ids.join(", ")
    )
}

pub(super) fn why_nothing_fits(parsed: &ParsedQuery) -> String {
    match parsed.target.meaning() {
        Meaning::Unknown => {
            format!(
                "The built-in encoder does not know what \"{}\" looks like; a model-backed encoder may.",
                parsed.target.head
            )
        }
        _ => format!("Nothing in the room fits \"{}\".", parsed.target.text()),
    }
}

/// Returns the relations in the question's words; `None` when it has none.
pub(crate) fn relation_words(phrase: &Phrase) -> Option<String> {
    let relations = phrase.relations.iter().map(|r| {
        let anchors: Vec<String> = r.anchors.iter().map(Phrase::text).collect();
        let words = if anchors.is_empty() {
            r.text.clone()
        } else {
            format!("{} the {}", r.text, anchors.join(" and the "))
        };
        if r.negated { format!("not {words}") } else { words }
    });
    let words: Vec<String> =
        relations.chain(phrase.superlative.map(|s| superlative_words(&s))).collect();
    (!words.is_empty()).then(|| words.join("; "))
}
