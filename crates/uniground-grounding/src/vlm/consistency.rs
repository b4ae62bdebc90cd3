//! Whether names and decision agree (paper: MATCHTARGET, INCONSISTENT).

use super::PromptContext;
use super::reply::Reply;
use crate::GivenName;
use crate::readings::Readings;
use std::collections::{BTreeMap, BTreeSet};
use uniground_language::{Meaning, Phrase};

/// Whether a name somebody gave means what a phrase asks for: "window with an air conditioner" is a
/// window.
pub(super) fn matches(name: &str, target: &Phrase) -> bool {
    target.meaning() == Meaning::Anything
        || GivenName::read(name).is_some_and(|name| Readings::of(target).called(&name) > 0.0)
}

/// Candidates whose names match the target.
fn matching(target: &Phrase, names: &BTreeMap<u32, String>) -> Vec<u32> {
    names.iter().filter(|(_, name)| matches(name, target)).map(|(id, _)| *id).collect()
}

/// Why the chosen candidate's name speaks against it; `None` when nothing does. Where no name
/// matches at all, the target is found by its anchor, and no name can object.
pub(super) fn disagreement(
    target: &Phrase,
    names: &BTreeMap<u32, String>,
    chosen: u32,
    reply: &Reply,
) -> Option<String> {
    let fitting = matching(target, names);
    let own = names.get(&chosen)?;
    let others: Vec<String> = fitting
        .iter()
        .filter(|id| **id != chosen)
        .filter_map(|id| Some(format!("ID {id} is named \"{}\"", names.get(id)?)))
        .collect();
    let asked = target.text();
    if others.is_empty() {
        return None;
    }
    if reply.target_name_matches == Some(false) {
        return Some(format!(
            "says itself that its name does not match \"{asked}\", while {}",
            others.join(" and ")
        ));
    }
    (!fitting.contains(&chosen)).then(|| {
        format!(
            "it is named \"{own}\" and \"{asked}\" is asked for, while {}",
            others.join(" and ")
        )
    })
}

/// Best candidates looked at when no name matches.
const LOOKED_AT_WITHOUT_NAME: usize = 3;

/// Candidates whose photographs are needed beside their names: those without a name, and those that
/// the question can not tell apart by name. Relations and comparisons tell namesakes apart by where
/// they are; colours, traits and parts do not.
pub(super) fn to_be_looked_at(
    context: &PromptContext,
    names: &BTreeMap<u32, String>,
) -> BTreeSet<u32> {
    let ids = || context.candidates.iter().map(|c| c.id.0);
    let mut needed: BTreeSet<u32> = ids().filter(|id| !names.contains_key(id)).collect();
    let fitting: Vec<u32> = matching(&context.target, names)
        .into_iter()
        .filter(|id| context.is_candidate(*id))
        .collect();
    match fitting.len() {
        0 => needed.extend(ids().take(LOOKED_AT_WITHOUT_NAME)),
        1 => {}
        _ if !told_apart(&context.target, &fitting, names) => needed.extend(fitting),
        _ => {}
    }
    needed
}

/// Whether a question tells namesakes apart without a look at them.
fn told_apart(target: &Phrase, namesakes: &[u32], names: &BTreeMap<u32, String>) -> bool {
    let by_place = !target.relations.is_empty() || target.superlative.is_some();
    let looks: Vec<&str> = target
        .colours
        .iter()
        .map(|c| c.word())
        .chain(target.traits.iter().map(|t| t.word()))
        .collect();
    let by_looks_alone =
        !looks.is_empty() || !target.other_than.is_empty() || !target.with.is_empty();
    if !by_looks_alone {
        return by_place;
    }
    // "The green chair" among a green and two blue ones: their names say it.
    let says = |id: &&u32| {
        GivenName::read(&names[*id]).is_some_and(|name| looks.iter().all(|word| name.says(word)))
    };
    let said_by = namesakes.iter().filter(says).count();
    let by_names = !looks.is_empty() && target.other_than.is_empty() && target.with.is_empty();
    by_names && (said_by == 1 || said_by > 1 && by_place)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn target(query: &str) -> Phrase {
        uniground_language::parse(query).target
    }

    fn names(of: &[(u32, &str)]) -> BTreeMap<u32, String> {
        of.iter().map(|(id, name)| (*id, (*name).to_owned())).collect()
    }

    #[test]
    fn names_mean_what_is_asked_for() {
        for (name, query, expected) in [
            ("window with air conditioner", "the window above the dresser", true),
            ("white radiator cabinet under window", "the window above the dresser", false),
            ("brown leather sofa", "the couch", true),
            ("red swivel office chair", "the chair next to the desk", true),
            ("beige wall section", "the window", false),
            ("wooden theremin", "the theremin", true),
            ("tall bookshelf", "the thing next to the sofa", true),
            ("black stool", "something to sit on", true),
            ("small white lamp on a desk", "the desk", false),
        ] {
            assert_eq!(matches(name, &target(query)), expected, "{name} for {query}");
        }
    }

    #[test]
    fn a_choice_is_doubted_when_another_name_fits_better() {
        let named = names(&[(7, "beige wall section"), (22, "window with air conditioner")]);
        let asked = target("the window above the dresser");
        let reply = |matches| Reply { target_name_matches: matches, ..Reply::default() };
        assert!(
            disagreement(&asked, &named, 7, &reply(Some(true))).unwrap().contains("ID 22 is named")
        );
        assert_eq!(disagreement(&asked, &named, 22, &reply(Some(true))), None);
        // Nobody is a fridge: the anchor decides, names can not object.
        assert_eq!(disagreement(&target("the fridge"), &named, 7, &reply(Some(false))), None);
        // It says itself that the name does not match, and another's does.
        let both = names(&[(1, "window"), (2, "window")]);
        assert!(disagreement(&asked, &both, 1, &reply(Some(false))).is_some());
    }
}
