//! Checks whether names and decision agree (paper: MATCHTARGET, INCONSISTENT).

use super::PromptContext;
use super::reply::Reply;
use crate::GivenName;
use crate::names::singular;
use crate::readings::Readings;
use std::collections::{BTreeMap, BTreeSet};
use uniground_language::{Meaning, Phrase};

/// Returns whether a given name matches the object that a phrase asks for: "window with an air
/// conditioner" is a window.
pub(crate) fn matches(name: &str, target: &Phrase) -> bool {
    target.meaning() == Meaning::Anything
        || GivenName::read(name).is_some_and(|name| Readings::of(target).called(&name) > 0.0)
}

/// Returns the candidates whose names match the target.
fn matching_candidates(target: &Phrase, names: &BTreeMap<u32, String>) -> Vec<u32> {
    names.iter().filter(|(_, name)| matches(name, target)).map(|(id, _)| *id).collect()
}

/// Returns why the chosen candidate's name contradicts the choice; `None` when it does not. Where
/// no name matches at all, the target is identified by its anchor, and no name can contradict.
pub(super) fn disagreement(
    target: &Phrase,
    names: &BTreeMap<u32, String>,
    chosen: u32,
    reply: &Reply,
) -> Option<String> {
    let fitting = matching_candidates(target, names);
    let own = names.get(&chosen)?;
    let others: Vec<String> = fitting
        .iter()
        .filter(|id| **id != chosen)
        .filter_map(|id| Some(format!("ID {id} is named \"{}\"", names.get(id)?)))
        .collect();
    let asked = target.text();
    // A model that says what differs knows that not everything is as asked for.
    if others.is_empty() || reply.differs.is_some() {
        return None;
    }
    if reply.target_name_matches == Some(false) {
        return Some(format!(
            "its name was said not to match \"{asked}\", while {}",
            others.join(" and ")
        ));
    }
    (!fitting.contains(&chosen) && !has_words_of(own, &target.head)).then(|| {
        format!(
            "it is named \"{own}\" and \"{asked}\" is asked for, while {}",
            others.join(" and ")
        )
    })
}

/// Returns whether a name has all words of a noun of several words, as "pile of folded towels" has
/// those of "pile of towels". Which of them is its noun is then hard to tell.
fn has_words_of(name: &str, noun: &str) -> bool {
    let words = |text: &str| {
        let words = text.split(|c: char| !c.is_alphanumeric()).filter(|word| *word != "of");
        let words = words.filter(|word| !word.is_empty());
        words.map(|word| singular(&word.to_lowercase()).to_owned()).collect::<BTreeSet<_>>()
    };
    let wanted = words(noun);
    wanted.len() > 1 && wanted.is_subset(&words(name))
}

/// Number of best candidates whose photographs are shown when no name matches.
const LOOKED_AT_WITHOUT_NAME: usize = 3;

/// Returns the candidates whose photographs are needed beside their names: those without a name,
/// and those that the question cannot distinguish by name. Relations and comparisons distinguish
/// namesakes by their places; colors, traits and parts do not.
pub(super) fn candidates_to_show(
    context: &PromptContext,
    names: &BTreeMap<u32, String>,
) -> BTreeSet<u32> {
    let ids = || context.candidates.iter().map(|c| c.id.0);
    let mut needed: BTreeSet<u32> = ids().filter(|id| !names.contains_key(id)).collect();
    let fitting: Vec<u32> = matching_candidates(&context.target, names)
        .into_iter()
        .filter(|id| context.is_candidate(*id))
        .collect();
    match fitting.len() {
        0 => needed.extend(ids().take(LOOKED_AT_WITHOUT_NAME)),
        1 => {}
        _ if !is_distinguished(&context.target, &fitting, names) => needed.extend(fitting),
        _ => {}
    }
    needed
}

/// Returns whether a question distinguishes namesakes without photographs of them.
fn is_distinguished(target: &Phrase, namesakes: &[u32], names: &BTreeMap<u32, String>) -> bool {
    let by_place = !target.relations.is_empty() || target.superlative.is_some();
    let looks: Vec<&str> = target
        .colors
        .iter()
        .map(|c| c.as_str())
        .chain(target.traits.iter().map(|t| t.as_str()))
        .collect();
    let by_looks_alone =
        !looks.is_empty() || !target.other_than.is_empty() || !target.with.is_empty();
    if !by_looks_alone {
        return by_place;
    }
    // "The green chair" among a green and two blue ones: their names state the color.
    let says = |id: &&u32| {
        GivenName::read(&names[*id])
            .is_some_and(|name| looks.iter().all(|word| name.has_word(word)))
    };
    let said_by = namesakes.iter().filter(says).count();
    let by_names = !looks.is_empty() && target.other_than.is_empty() && target.with.is_empty();
    by_names && (said_by == 1 || said_by > 1 && by_place)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ParsedQuerySummary;
    use crate::direction::DirectionConvention;
    use crate::vlm::PromptCandidate;
    use uniground_geometry::boxes::Aabb;
    use uniground_geometry::color::ColorName;
    use uniground_geometry::scene::InstanceId;
    use uniground_geometry::{Point3, Vector3};
    use uniground_language::{Trait, With};

    fn target(query: &str) -> Phrase {
        uniground_language::parse(query).target
    }

    fn names(of: &[(u32, &str)]) -> BTreeMap<u32, String> {
        of.iter().map(|(id, name)| (*id, (*name).to_owned())).collect()
    }

    #[test]
    fn names_match_only_the_requested_object() {
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
    fn choice_is_questioned_when_another_name_fits_better() {
        let named = names(&[(7, "beige wall section"), (22, "window with air conditioner")]);
        let asked = target("the window above the dresser");
        let reply = |matches| Reply { target_name_matches: matches, ..Reply::default() };
        assert!(
            disagreement(&asked, &named, 7, &reply(Some(true))).unwrap().contains("ID 22 is named")
        );
        assert_eq!(disagreement(&asked, &named, 22, &reply(Some(true))), None);
        // No candidate is a fridge: the anchor decides, and names cannot contradict.
        assert_eq!(disagreement(&target("the fridge"), &named, 7, &reply(Some(false))), None);
        // The model says that the name does not match, and another name does.
        let both = names(&[(1, "window"), (2, "window")]);
        assert!(disagreement(&asked, &both, 1, &reply(Some(false))).is_some());
    }

    fn phrase(head: &str) -> Phrase {
        Phrase { head: head.into(), ..Phrase::default() }
    }

    fn context(query: &str, ids: &[u32]) -> PromptContext {
        let aabb = Aabb { center: Point3::origin(), size: Vector3::repeat(1.0) };
        let candidate =
            |id: &u32| PromptCandidate { id: InstanceId(*id), score: 0.5, belief: 0.5, aabb };
        PromptContext {
            query: query.into(),
            summary: ParsedQuerySummary {
                target: String::new(),
                attributes: Vec::new(),
                anchors: Vec::new(),
                relations: Vec::new(),
                not_understood: Vec::new(),
            },
            target: target(query),
            candidates: ids.iter().map(candidate).collect(),
            anchors: Vec::new(),
            shown_anchors: Vec::new(),
            boxes: Vec::new(),
            oriented_boxes: Vec::new(),
            mentions_wall: false,
            directions: DirectionConvention::Paper.into(),
            seen_by: String::new(),
        }
    }

    #[test]
    fn any_name_matches_thing_and_unclear_matches_no_noun() {
        assert!(matches("beige wall section", &target("the thing by the door")));
        assert!(matches("unclear", &target("the thing by the door")));
        assert!(!matches("unclear", &target("the window")));
        let of = names(&[(3, "window"), (5, "lamp"), (7, "window with air conditioner")]);
        assert_eq!(matching_candidates(&target("the window"), &of), [3, 7]);
    }

    #[test]
    fn name_contradicts_a_choice_only_if_another_name_matches() {
        let asked = target("the window above the dresser");
        let reply = |matches| Reply { target_name_matches: matches, ..Reply::default() };
        let of = |named: &[(u32, &str)], chosen, matches| {
            disagreement(&asked, &names(named), chosen, &reply(matches))
        };
        let wall = [(7, "beige wall section"), (22, "window"), (23, "tall window")];
        for said in [None, Some(true)] {
            assert_eq!(
                of(&wall, 7, said).as_deref(),
                Some(
                    "it is named \"beige wall section\" and \"window\" is asked for, while ID 22 \
                     is named \"window\" and ID 23 is named \"tall window\""
                )
            );
            assert_eq!(of(&wall, 22, said), None);
        }
        // The model itself says that the name does not match.
        for (chosen, other) in [(7, "ID 22 is named \"window\" and ID 23"), (22, "ID 23")] {
            let told = of(&wall, chosen, Some(false)).unwrap();
            let begins =
                format!("its name was said not to match \"window\", while {other} is named");
            let begins = begins.trim_end_matches(" is named");
            assert!(told.starts_with(begins), "{told:?} begins with {begins:?}");
        }
        // The model knows that something differs.
        let differing = Reply { differs: Some("it is blue".into()), ..reply(Some(false)) };
        assert_eq!(disagreement(&asked, &names(&wall), 7, &differing), None);
        // The name has all words of a noun of several words.
        let piles = names(&[(3, "pile of folded towels"), (4, "pile towels")]);
        let asked_for = |noun: &str| {
            let asked = Phrase { head: noun.into(), ..Phrase::default() };
            disagreement(&asked, &piles, 3, &reply(None))
        };
        let towels = Phrase { head: "pile towels".into(), ..Phrase::default() };
        assert_eq!(matching_candidates(&towels, &piles), [4], "by its noun");
        assert_eq!(asked_for("pile towels"), None);
        assert!(!has_words_of("pile of folded towels", "towel"), "one word tells its noun");
        // No other name fits, or the choice has no name: nothing contradicts.
        assert_eq!(of(&[(7, "lamp"), (22, "window")], 22, Some(false)), None);
        assert_eq!(of(&[(22, "window")], 7, Some(false)), None);
    }

    #[test]
    fn candidates_without_a_name_are_shown() {
        let needed = |query: &str, ids: &[u32], named: &[(u32, &str)]| {
            let needed = candidates_to_show(&context(query, ids), &names(named));
            needed.into_iter().collect::<Vec<_>>()
        };
        let one = [(4, "chair"), (5, "lamp")];
        assert_eq!(needed("the chair", &[4, 5, 6], &one), [6]);
        assert_eq!(needed("the chair", &[4, 5], &one), [0_u32; 0]);
        // No candidate has the name: the first three are shown, and those without a name.
        let none = [(4, "lamp"), (9, "lamp"), (5, "lamp"), (2, "lamp")];
        assert_eq!(needed("the chair", &[9, 4, 5, 2, 3], &none), [3, 4, 5, 9]);
        // Namesakes are shown, unless the question gives a place.
        let two = [(4, "chair"), (5, "chair"), (6, "lamp")];
        assert_eq!(needed("the chair", &[4, 5, 6], &two), [4, 5]);
        assert_eq!(needed("the chair by the lamp", &[4, 5, 6], &two), [0_u32; 0]);
        // A namesake that cannot be chosen does not count.
        assert_eq!(needed("the chair", &[4, 6], &two), [0_u32; 0]);
        assert_eq!(needed("the chair", &[6], &two), [6]);
    }

    #[test]
    fn namesakes_are_distinguished_by_place_or_by_colors_in_their_names() {
        let place = || target("the chair by the desk").relations;
        let largest = || target("the largest chair").superlative;
        assert!(place().len() == 1 && largest().is_some());
        let green = || Phrase { colors: vec![ColorName::Green], ..phrase("chair") };
        let with = || vec![With { phrase: phrase("cushion"), absent: false }];
        let one = ["green chair", "blue chair"];
        let both = ["green chair", "green chair"];
        let neither = ["blue chair", "chair"];
        for (asked, names_are, expected) in [
            (phrase("chair"), one, false),
            (Phrase { relations: place(), ..phrase("chair") }, one, true),
            (Phrase { superlative: largest(), ..phrase("chair") }, one, true),
            // One name, both names, or no name has the color.
            (green(), one, true),
            (green(), both, false),
            (green(), neither, false),
            (Phrase { relations: place(), ..green() }, one, true),
            (Phrase { relations: place(), ..green() }, both, true),
            (Phrase { relations: place(), ..green() }, neither, false),
            (Phrase { traits: vec![Trait::Large], ..phrase("chair") }, one, false),
            (Phrase { traits: vec![Trait::Large], ..green() }, one, false),
            (
                Phrase { traits: vec![Trait::Large], ..green() },
                ["large green chair", "green chair"],
                true,
            ),
            // Names do not say excluded colors or carried objects.
            (Phrase { other_than: vec![ColorName::Blue], ..phrase("chair") }, one, false),
            (Phrase { other_than: vec![ColorName::Blue], ..green() }, one, false),
            (Phrase { with: with(), ..phrase("chair") }, one, false),
            (Phrase { with: with(), ..green() }, one, false),
            (Phrase { with: with(), relations: place(), ..phrase("chair") }, one, false),
        ] {
            let named = names(&[(1, names_are[0]), (2, names_are[1])]);
            let found = is_distinguished(&asked, &[1, 2], &named);
            assert_eq!(found, expected, "{asked:?} of {names_are:?}");
        }
    }
}
