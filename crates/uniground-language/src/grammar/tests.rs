use super::*;
use crate::Trait;
use proptest::prelude::*;
use uniground_geometry::color::ColorName;

/// Writes a phrase in a compact notation: words; with; relations(anchors, nested in brackets);
/// superlative.
fn notation(phrase: &Phrase) -> String {
    let count = phrase.count.map_or_else(String::new, |n| format!("{n} "));
    let mut parts = vec![format!("{count}{}", phrase.text())];
    for with in &phrase.with {
        parts.push(format!(
            "{} [{}]",
            if with.absent { "without" } else { "with" },
            notation(&with.phrase)
        ));
    }
    for relation in &phrase.relations {
        let not = if relation.negated { "not " } else { "" };
        let rank = if relation.rank > 1 { format!(" {}", relation.rank) } else { String::new() };
        let anchors: Vec<_> = relation.anchors.iter().map(notation).collect();
        parts.push(format!("{not}{:?}{rank}({})", relation.kind, anchors.join(" & ")));
    }
    parts.extend(phrase.superlative.map(|s| format!("{:?} {}", s.measure, s.rank)));
    parts.join("; ")
}

fn summary(query: &str) -> String {
    let parsed = parse(query);
    let viewpoint = parsed
        .viewpoint
        .map_or_else(String::new, |v| format!("; {:?} {}", v.look, notation(&v.anchor)));
    notation(&parsed.target) + &viewpoint
}

fn check(cases: &[(&str, &str)]) {
    for (query, expected) in cases {
        assert_eq!(summary(query), *expected, "{query}: {:?}", parse(query));
    }
}

#[test]
fn common_questions_are_parsed() {
    check(&[
        ("the black chair closest to the door", "black chair; Closest(door)"),
        ("find the television", "television"),
        ("the bookcase between the red sofa and the desk", "bookcase; Between(red sofa & desk)"),
        ("a window that sits above the dresser", "window; Above(dresser)"),
        ("the small box in the corner", "small box; InCorner()"),
        ("the mug to the left of the laptop", "mug; LeftOf(laptop)"),
        ("the tallest bookcase", "bookcase; Tallest 1"),
        ("where is the backpack?", "backpack"),
        ("the chair next to the sofa and the lamp", "chair; Near(sofa & lamp)"),
        ("the rug in the middle of the room", "rug; InMiddle()"),
        ("the chairs around the table", "chairs; Around(table)"),
    ]);
}

#[test]
fn colloquial_descriptions_are_parsed() {
    check(&[
        ("facing the bed the lamp on the left", "lamp; Leftmost 1; Facing bed"),
        (
            "if i sit on the red sofa and look at the tv, the speaker on the right",
            "speaker; Rightmost 1; Facing tv",
        ),
        (
            "facing the two wardrobes, the one on the right",
            "wardrobes; Rightmost 1; Facing 2 wardrobes",
        ),
        ("facing the wall left monitor", "monitor; Leftmost 1; Facing wall"),
        ("facing the windows it is second from the left", "windows; Leftmost 2; Facing windows"),
        (
            "facing the wall of windows the one on the right",
            "windows; Rightmost 1; Facing windows wall",
        ),
        (
            "on the wall with three paintings it is the one in the middle",
            "paintings; On(wall; with [3 paintings]); Middle 1",
        ),
        (
            "facing the back wall of books it is the table on the right",
            "table; Rightmost 1; Facing books wall; Backmost 1",
        ),
        ("facing the mural the table on the left", "table; Leftmost 1; Facing mural"),
        ("the monitor on the right desk", "monitor; On(desk; Rightmost 1)"),
        ("the top cabinet by the sink", "cabinet; Near(sink); Highest 1"),
        (
            "the slim case that is squeezed in between the stove and the barrel",
            "slim case; Between(stove & barrel)",
        ),
        ("some logs for the stove by the door", "logs; Near(door)"),
        ("somebody put a book on the shelf", "book; On(shelf)"),
        ("go stand by the stool", "stool"),
        ("the grass is high again. which lamp is by the door", "lamp; Near(door)"),
        ("the higher of the shelves", "shelves; Highest 1"),
        ("the box at the bottom of the stack", "box; Lowest 1"),
        ("the pillow in the middle of the two chairs", "pillow; Between(2 chairs)"),
        ("the desk with two monitors on top", "desk; with [2 monitors]"),
        (
            "it is a window with a brown frame. is directly above the bed",
            "window; with [brown frame]; Above(bed)",
        ),
        ("this is a blue chair. it is facing the table.", "blue chair; Facing(table)"),
        ("the door stands in the hall", "door; Inside(hall)"),
        ("the lamp, not the middle one, on the desk", "lamp; On(desk)"),
        (
            "facing the tv on the wall, the speaker on the left",
            "speaker; Leftmost 1; Facing tv; On(wall)",
        ),
        ("there is a large , red couch", "large red couch"),
        ("the trash can closest to brown chairs", "trash can; Closest(brown chairs)"),
        ("the picture over the headboard of the bed", "picture; Above(bed)"),
        ("over at the round table, the chair", "chair; Near(round table)"),
        (
            "facing the dresser, counting from the left, the fourth thing on it",
            "thing; On(dresser); Leftmost 4; Facing dresser",
        ),
        ("the stove in the kitchen", "stove; Inside(kitchen)"),
        ("the lamp closest to me", "lamp; Closest(me)"),
    ]);
}

#[test]
fn quantity_is_read_from_plurals_and_numbers() {
    for (query, quantity) in [
        ("the chair", Quantity::One),
        ("the tallest of the chairs", Quantity::One),
        ("the chairs around the table", Quantity::All),
        ("how many mugs do we have", Quantity::All),
        ("count all the lamps", Quantity::All),
        ("both chairs", Quantity::Exactly(2)),
        ("the three mugs on the desk", Quantity::Exactly(3)),
        ("the chair next to the two desks", Quantity::One),
    ] {
        assert_eq!(parse(query).quantity, quantity, "{query}");
    }
}

#[test]
fn several_sentences_describe_one_target() {
    check(&[
        ("this is a teapot. it is standing on the dining table.", "teapot; On(dining table)"),
        (
            "this is a brown chair. it is at the end of the long table.",
            "brown chair; Near(long table)",
        ),
        ("there is a lamp. the lamp is black and it is on the desk.", "black lamp; On(desk)"),
        ("it is a sofa. there is a mug on it.", "sofa; Carrying(mug)"),
        ("this is a chair. there is a window to the left of it.", "chair; RightOf(window)"),
        ("the chair is next to the table. it is red.", "red chair; Near(table)"),
    ]);
}

#[test]
fn ranks_and_counts_are_parsed() {
    check(&[
        ("the second chair from the left", "chair; Leftmost 2"),
        ("the third largest box", "box; Largest 3"),
        ("the second closest chair to the door", "chair; Closest 2(door)"),
        ("the table with four chairs", "table; with [4 chairs]"),
        ("the desk with a single monitor", "desk; with [1 monitor]"),
        ("the middle window", "window; Middle 1"),
        (
            "of the three filing cabinets, the one closest to the desk",
            "filing cabinet; Closest(desk)",
        ),
    ]);
}

#[test]
fn negation_applies_only_to_its_own_phrase() {
    check(&[
        ("the one that is not next to the door", "one; not Near(door)"),
        ("not the one by the door, the other one", "one; not Near(door)"),
        ("the sofa that is not red near the blue chair", "not red sofa; Near(blue chair)"),
        ("the sofa which isn't red", "not red sofa"),
        (
            "the stool in front of the white bookcase without books",
            "stool; InFrontOf(white bookcase; without [books])",
        ),
        ("the table that does not have a lamp", "table; without [lamp]"),
        ("the mug that is neither red nor white", "not red not white mug"),
        ("the cabinet with nothing on top of it", "cabinet; without [thing]"),
        ("the chair beside the green one", "chair; Near(green chair)"),
        ("the plant on the floor next to the sofa", "plant; On(floor); Near(sofa)"),
    ]);
}

#[test]
fn viewpoints_are_parsed() {
    check(&[
        ("facing the window, the curtain on the left", "curtain; Leftmost 1; Facing window"),
        ("the curtain on the right when facing the window", "curtain; Rightmost 1; Facing window"),
        (
            "as you walk in, the first chair on the left",
            "chair; LeftOf(door); Closest(door); From door",
        ),
        ("from the perspective of the sofa, the lamp on the right", "lamp; Rightmost 1; From sofa"),
        ("with your back to the door, the desk on the left", "desk; Leftmost 1; BackTo door"),
        ("the chair facing the window", "chair; Facing(window)"),
        (
            "standing at the door facing the window, the nearest stool",
            "stool; Closest(door); Facing window",
        ),
        (
            "when you look at the tv from the red sofa, the plant on the right",
            "plant; Rightmost 1; Facing tv",
        ),
        (
            "seen from the sofa, the farther of the two stools",
            "2 stools; Farthest(sofa); From sofa",
        ),
        ("facing the tv, the bookcase just to the left of it", "bookcase; LeftOf(tv); Facing tv"),
    ]);
}

#[test]
fn nested_anchors_are_parsed() {
    check(&[
        ("the mug on the table by the door", "mug; On(table; Near(door))"),
        ("the lamp on the desk with two monitors", "lamp; On(desk; with [2 monitors])"),
        ("the phone on the same desk as the grey lamp", "phone; On(desk; with [grey lamp])"),
        ("the mug on the table closest to the door", "mug; On(table); Closest(door)"),
    ]);
    let parsed = parse("the mug on the table by the door");
    assert_eq!(notation(&parsed.other_reading.unwrap()), "mug; On(table); Near(door)");
    assert!(parse("the mug on the table").other_reading.is_none());
}

#[test]
fn commands_and_misspellings_are_parsed() {
    check(&[
        ("bring me the red mug on the coffee table", "red mug; On(coffee table)"),
        ("could you please pick up the blue cup", "blue cup"),
        ("go to the refrigeratr", "refrigerator"),
        ("robot, fetch the laptop from the desk", "laptop; Near(desk)"),
        ("turn on the lamp next to the bed", "lamp; Near(bed)"),
    ]);
}

#[test]
fn head_is_the_last_noun_except_with_of() {
    let parsed = parse("the bowl of apples on the computer desk");
    assert_eq!(
        (parsed.target.head.as_str(), parsed.target.relations[0].anchors[0].head.as_str()),
        ("bowl", "computer desk")
    );
    assert_eq!(parse("a pair of shoes").target.head, "shoes");
    assert_eq!(parse("the back of the chair").target.head, "chair");
}

#[test]
fn attributes_belong_to_their_noun() {
    let parsed = parse("the large red chair next to the small white table");
    assert_eq!(
        (parsed.target.colors, parsed.target.traits),
        (vec![ColorName::Red], vec![Trait::Large])
    );
    let anchor = &parsed.target.relations[0].anchors[0];
    assert_eq!((&anchor.colors, &anchor.traits), (&vec![ColorName::White], &vec![Trait::Small]));
    assert_eq!(
        parse("the table that isn't the dining table").target.other_things,
        ["dining table"]
    );
    let both = parse("the orange and black desk");
    assert_eq!(both.target.colors, [ColorName::Orange, ColorName::Black]);
}

#[test]
fn every_word_is_used_or_listed() {
    let parsed = parse("the shiny theremin on the desk");
    assert_eq!(parsed.target.head, "theremin");
    assert_eq!(parsed.not_understood, ["theremin", "shiny"]);
    assert_eq!(parsed.target.relations[0].anchors[0].head, "desk");
    // Every word is either part of the parse or listed.
    for query in ["zorgle blip the chair", "the frobnicated chair", "qwerty"] {
        let parsed = parse(query);
        for word in query.split(' ').filter(|w| !["the", "chair"].contains(w)) {
            let listed = parsed.not_understood.iter().chain(&parsed.passed_over).any(|w| w == word)
                || parsed.target.unchecked.iter().any(|w| w == word);
            assert!(listed, "{query}: {word} in {parsed:?}");
        }
    }
}

#[test]
fn contradictory_nonsense_and_overlong_questions_do_not_panic() {
    for query in [
        "the chair that is on the table and not on the table",
        "the chair next to the chair next to the chair",
        "it",
        "the of and with not",
        "SELECT * FROM scenes; DROP TABLE scenes",
        "椅子在哪里",
        "🪑🪑🪑",
    ] {
        let _ = parse(query);
    }
    let many = format!("the mug {}", "near the chair ".repeat(50));
    let crowded = parse(&many);
    assert_eq!(crowded.target.head, "mug");
    // Words beyond the limit are listed, so that the work stays bounded.
    assert!(
        crowded.not_understood.iter().filter(|w| *w == "chair").count() >= 20,
        "{:?}",
        crowded.not_understood.len()
    );
}

proptest! {
    #[test]
    fn any_text_is_read_without_panic(query in "\\PC{0,200}") {
        let _ = parse(&query);
    }

    #[test]
    fn any_order_of_known_words_is_read_without_panic(words in prop::collection::vec(prop::sample::select(vec![
        "the", "chair", "red", "between", "and", "on", "it", "is", "not", "facing", ",", "left", "of", "second", "from", "without", "theremin",
        "something", "to", "sit", "there", "the same", "as", "with", "two", "closest", "on the left", "you walk in", "that is",
    ]), 0..30)) {
        let _ = parse(&words.join(" "));
    }
}

#[test]
fn actions_in_a_question_are_not_read_as_targets() {
    check(&[
        ("heading out, i need the umbrella by the door", "umbrella; Near(door)"),
        (
            "I want to ride, so the green one with the basket",
            "green something to ride; with [basket]",
        ),
        ("the theremin next to the sofa", "theremin; Near(sofa)"),
        ("two green chairs stand at the table", "2 green chairs; Near(table)"),
        ("counting the stools starting from the door, the third", "stools; Closest 3(door)"),
        ("the wine from the table near the window", "wine; Near(table; Near(window))"),
        ("the box between the sprocket and the lamp", "box; Between(sprocket & lamp)"),
        ("where can i get some fruit", "fruit"),
        ("a place to work on your laptop", "something to work at"),
        (
            "something to heat up my soup in",
            "something to boil water or heat food or heat room or heat water",
        ),
    ]);
    let by_article = parse(
        "wipe off what's written on the board that hangs between the brown door and the darts",
    );
    assert_eq!(
        (by_article.target.head.as_str(), &by_article.passed_over[..1]),
        ("board", &["wipe".to_owned()][..])
    );
    assert!(parse("the pinkish chair").target.roughly && !parse("the pink chair").target.roughly);
    assert_eq!(parse("the wine").target.could_be, ["bottle", "wine glass"]);
    assert!(parse("the tulips").target.could_be.contains(&"vase".to_owned()));
}

#[test]
fn a_relative_clause_belongs_to_the_object_that_its_verb_agrees_with() {
    for query in [
        "the chairs around the table that aren't green",
        "the chairs around the table that are not green",
        "all chairs at the round table which aren't green",
    ] {
        let target = parse(query).target;
        assert_eq!(target.other_than, [ColorName::Green], "{query}: {target:?}");
        assert!(target.relations[0].anchors[0].other_than.is_empty(), "{query}: {target:?}");
    }
    let target = parse("the chair next to the tables that are green").target;
    assert_eq!(target.relations[0].anchors[0].colors, [ColorName::Green]);
    let target = parse("everything on the dining table that is not red").target;
    assert_eq!(target.other_than, [ColorName::Red], "{target:?}");
    // Both agree: the words allow two readings.
    let parsed = parse("the cup on the table that is red");
    assert_eq!(parsed.target.relations[0].anchors[0].colors, [ColorName::Red], "{parsed:?}");
    assert_eq!(parsed.other_reading.map(|other| other.colors), Some(vec![ColorName::Red]));
}

#[test]
fn zones_are_understood_as_places() {
    for query in ["all chairs in the kitchen", "how many stools are in the living room"] {
        let parsed = parse(query);
        assert!(parsed.not_understood.is_empty() && parsed.doubt().is_none(), "{parsed:?}");
        assert_eq!(parsed.target.relations.len(), 1, "{parsed:?}");
    }
}

#[test]
fn a_negated_relation_is_repeated_for_each_anchor() {
    let parsed = parse("the lamp that isn't on a nightstand or a desk");
    let anchors: Vec<(&str, bool)> = parsed
        .target
        .relations
        .iter()
        .map(|relation| (relation.anchors[0].head.as_str(), relation.negated))
        .collect();
    assert_eq!(anchors, [("nightstand", true), ("desk", true)], "{parsed:?}");
    assert!(parsed.not_understood.is_empty(), "{parsed:?}");
}

#[test]
fn materials_can_be_excluded() {
    for (query, words) in [
        ("the chair that is not wooden", vec!["wooden"]),
        ("the chairs that aren't metal or plastic", vec!["metal", "plastic"]),
        ("the table that is not glass", vec!["glass"]),
        ("the chairs not made of wood", vec!["wood"]),
        ("the non-wooden table", vec!["wooden"]),
    ] {
        let parsed = parse(query);
        assert_eq!(parsed.target.excluded, words, "{query}: {parsed:?}");
        assert!(parsed.not_understood.is_empty(), "{query}: {:?}", parsed.not_understood);
    }
    // What is no material is still a word that was not understood.
    let parsed = parse("the chair that is not wobbly");
    assert_eq!(parsed.not_understood, ["not wobbly"]);
}
