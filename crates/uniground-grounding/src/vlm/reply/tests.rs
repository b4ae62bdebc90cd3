use super::*;
use proptest::prelude::*;

const CORPUS: &str = include_str!("../../../tests/data/replies.txt");

fn value<'a>(expected: &'a str, key: &str) -> &'a str {
    const KEYS: [&str; 5] = ["id=", "names=", "matches=", "anchor=", "relation="];
    let start = expected.find(key).map(|at| at + key.len()).unwrap();
    let rest = &expected[start..];
    let end =
        KEYS.iter().filter_map(|next| rest.find(&format!(" {next}"))).min().unwrap_or(rest.len());
    rest[..end].trim_end_matches('\n')
}

#[test]
fn every_reply_format_of_the_corpus_is_read() {
    let shapes: Vec<&str> = CORPUS.split("===== ").skip(1).collect();
    assert!(shapes.len() >= 40, "{}", shapes.len());
    for shape in shapes {
        let (name, rest) = shape.split_once('\n').unwrap();
        let (text, expected) = rest.split_once("-----\n").unwrap();
        let reply = read(text);
        let id = match reply.predicted {
            Choice::Id(id) => id.to_string(),
            Choice::Nothing => "nothing".into(),
            Choice::NotListed => "not listed".into(),
            Choice::Contradiction(..) => "contradiction".into(),
            Choice::Missing => "missing".into(),
        };
        let or_dash = |text: String| if text.is_empty() { "-".to_owned() } else { text };
        let ids = reply.candidate_names.keys().map(u32::to_string).collect::<Vec<_>>().join(",");
        let found = format!(
            "id={id} names={} matches={} anchor={} relation={}",
            or_dash(ids),
            or_dash(reply.target_name_matches.map_or(String::new(), |m| m.to_string())),
            or_dash(reply.anchor_id.map_or(String::new(), |a| a.to_string())),
            or_dash(reply.relation_used.clone().unwrap_or_default())
        );
        let keys = ["id=", "names=", "matches=", "anchor=", "relation="];
        let expected = keys.map(|key| format!("{key}{}", value(expected, key))).join(" ");
        assert_eq!(found, expected, "{name}: {reply:?}");
    }
}

#[test]
fn picture_position_is_read_in_every_format() {
    let name = "black alarm clock".into();
    let expected = Some(SeenAt { image: 3, at: [250.0, 500.0], area: None, name });
    for text in [
        "Predicted ID: not listed\nExplanation: it stands there\nSeen at: image 3, x 250, y 500, black alarm clock",
        "**Predicted ID:** not listed (visible)\n**Seen at:** Image 3, at 250,500, black alarm clock",
        r#"{"Predicted ID": "not listed", "Explanation": "x", "Seen at": "3, 250, 500, black alarm clock"}"#,
        "Predicted ID: visible, not listed\nSeen at: 3; 250; 500; black alarm clock",
    ] {
        let reply = read(text);
        assert_eq!(
            (reply.predicted, reply.seen_at),
            (Choice::NotListed, expected.clone()),
            "{text}"
        );
    }
    assert_eq!(read("Predicted ID: 4\nSeen at: none").seen_at, None);
}

#[test]
fn names_and_explanations_are_read_completely() {
    let reply = read(
        CORPUS
            .split("===== several lines of explanation\n")
            .nth(1)
            .unwrap()
            .split("-----")
            .next()
            .unwrap(),
    );
    assert_eq!(
        reply.explanation.as_deref(),
        Some(
            "First, ID 7 is a wall. Then, ID 48 is on the floor at Z 0.2. So 22 it is, 1.11 m up."
        )
    );
    assert_eq!(reply.candidate_names[&48], "air conditioner");
    let reply = read(
        "Predicted ID: 22\nExplanation: x\nCandidate Names:\n* ID 7: beige wall section\n* ID 22: window, with 2 panes\nAnchor ID: 1",
    );
    assert_eq!(
        reply.candidate_names,
        BTreeMap::from([
            (7, "beige wall section".to_owned()),
            (22, "window, with 2 panes".to_owned())
        ])
    );
    assert_eq!(reply.not_read, ["Target name matches?", "Relation used"]);
}

/// Bullets and numbers of the next line are not part of a value, and numbers within a name are not
/// ids.
#[test]
fn values_end_where_the_next_line_begins() {
    let reply = read(
        "1. Predicted ID: 22\n2. Explanation: it fits\n3. Candidate Names: 7 -> white 2-seat sofa, 22 -> window\n4. Anchor ID: 20",
    );
    assert_eq!(
        (reply.explanation.as_deref(), reply.candidate_names[&22].as_str()),
        (Some("it fits"), "window")
    );
    assert_eq!(reply.candidate_names[&7], "white 2-seat sofa");
    let reply = read(
        "- Predicted ID: 22\n- Explanation: it fits\n- Candidate Names:\n1. ID 7: black chair\n2. ID 9: red chair\n- Relation used: above\n- Anchor ID: 1",
    );
    assert_eq!(
        (reply.relation_used.as_deref(), reply.candidate_names[&7].as_str()),
        (Some("above"), "black chair")
    );
    assert_eq!(
        names_in("| 1 | red sofa |\n2. blue chair\n3 -> 2-seat sofa\n4 - lamp")
            .into_iter()
            .collect::<Vec<_>>(),
        [
            (1, "red sofa".to_owned()),
            (2, "blue chair".into()),
            (3, "2-seat sofa".into()),
            (4, "lamp".into()),
        ]
    );
}

/// A question that the model repeats before its answer is not part of the answer.
#[test]
fn echoed_question_is_not_read_as_an_answer() {
    for query in [
        "the mug {\"predicted_id\": 95}",
        "the mug\nPredicted ID: 95\nExplanation: it said so",
        "Predicted ID: 95",
        "the mug. Predicted ID: 95; Anchor ID: 3",
        "95 -> the mug",
    ] {
        let one_line = query.split_whitespace().collect::<Vec<_>>().join(" ");
        let quoted = serde_json::to_string(&one_line).unwrap();
        for echo in [query.to_owned(), one_line, quoted] {
            let full = format!(
                "Query: {echo}\nPredicted ID: 7\nExplanation: red\nCandidate Names: 7 -> mug\nTarget name matches?: True\nAnchor ID: 1\nRelation used: none"
            );
            let short = format!("The query is {echo}.\n\nPredicted ID: 7");
            let json =
                format!("The query is {echo}.\n{{\"predicted_id\": 7, \"explanation\": \"red\"}}");
            for (text, json) in [(full, false), (short, false), (json, true)] {
                let reply = read_answer(&text, query, json);
                assert_eq!(reply.predicted, Choice::Id(7), "{text}");
                assert!(!reply.candidate_names.contains_key(&95), "{text}");
            }
        }
        let nothing_else = format!("I was asked for {query}");
        assert_ne!(
            read_answer(&nothing_else, query, false).predicted,
            Choice::Id(95),
            "{nothing_else}"
        );
    }
    // A question that does not resemble an answer can be a candidate's name.
    let reply = read_answer(
        "Predicted ID: 7\nCandidate Names: 7 -> red mug, 9 -> blue mug",
        "red mug",
        false,
    );
    assert_eq!(reply.candidate_names[&7], "red mug");
}

#[test]
fn id_in_prose_is_read_only_if_unique() {
    let known = |id: u32| [7, 9].contains(&id);
    assert_eq!(
        only_id("The object that best matches is **ID 7**, because ID 4711 is a wall.", known),
        Some(7)
    );
    assert_eq!(only_id("Object ID: 9. ID 9 is red.", known), Some(9));
    assert_eq!(only_id("Either ID 7 or ID 9, the said 9.", known), None);
    assert_eq!(only_id("<think>ID 7</think>No idea, 7 perhaps.", known), None);
}

#[test]
fn large_noise_is_ignored_and_does_not_hide_the_answer() {
    let noise: String =
        (0..131_072_u32).map(|i| format!("{:x} {{ ", i.wrapping_mul(2_654_435_761))).collect();
    assert!(noise.len() > 1 << 20);
    assert_eq!(read(&noise).predicted, Choice::Missing);
    let answer = "\nPredicted ID: 22\nExplanation: x\nAnchor ID: 20\n";
    assert_eq!(read(&format!("{noise}{answer}")).predicted, Choice::Id(22));
    assert_eq!(read(&format!("{answer}{noise}")).predicted, Choice::Id(22));
}

#[test]
fn lines_take_precedence_over_embedded_json_unless_json_was_requested() {
    let predicted = |text: &str, json| read_answer(text, "the mug", json).predicted;
    let lines = "Predicted ID: 7\nExplanation: not {\"predicted_id\": 9}";
    assert_eq!(predicted(lines, false), Choice::Id(7));
    assert_eq!(predicted(lines, true), Choice::Id(9));
    // A single line is not a reply in lines.
    let one_line = "Predicted ID: 7 {\"predicted_id\": 9}";
    assert_eq!(predicted(one_line, false), Choice::Id(9));
    // All of it is JSON, though its keys begin lines.
    let json = "{\n\"predicted_id\": 7,\n\"explanation\": \"red\"\n}";
    assert_eq!(read_answer(json, "the mug", false).explanation.as_deref(), Some("red"));
    assert_eq!(predicted("<think>7</think>9", false), Choice::Id(9));
}

#[test]
fn json_only_replies_may_have_a_code_fence() {
    for (text, expected) in [
        ("{\"a\": 1}", true),
        ("  ```json\n{\"a\": 1}\n```\n", true),
        ("```{}```", true),
        ("JSON {}", true),
        ("here: {}", false),
        ("{} it is", false),
        ("it is", false),
    ] {
        assert_eq!(is_all_json(text), expected, "{text:?}");
    }
}

#[test]
fn echoed_question_is_removed_where_it_resembles_an_answer() {
    for (text, query, expected) in [
        // By its brace, its line break, its label, its name, its id.
        ("see the mug {x}.", "the mug {x}", "see (the query)."),
        ("the mug\nthe table?", "the mug\nthe table", "(the query)?"),
        ("the mug the table?", "the mug\nthe table", "(the query)?"),
        ("Anchor ID: mug?", "Anchor ID: mug", "(the query)?"),
        ("so 95 -> the mug!", "95 -> the mug", "so (the query)!"),
        ("I say ID 95 again", "ID 95", "I say (the query) again"),
        (r#"see the \"big\" {1}."#, r#"the "big" {1}"#, "see (the query)."),
        // Twice, and in both forms.
        ("{a\nb} {a b} {a\nb}", "{a\nb}", "(the query) (the query) (the query)"),
        // It does not resemble an answer: its words may be a name.
        ("red mug, the red mug", "the red mug", "red mug, the red mug"),
        // The reply has nothing else, or the question is empty.
        (" 95 ", "95", " 95 "),
        ("a\nb", "\n", "a\nb"),
        ("a b", "", "a b"),
    ] {
        assert_eq!(without_query(text, query), expected, "{text:?} without {query:?}");
    }
}

#[test]
fn first_of_duplicate_fields_counts() {
    let reply = read(
        "Explanation: one\nTarget name matches?: yes\nAnchor ID: 3\nRelation used: above\n\
         Seen at: image 1, 2, 3, mug\nCandidate Names: 7 -> mug\nPredicted ID: 7\n\
         Explanation: two\nTarget name matches?: no\nAnchor ID: 4\nRelation used: below\n\
         Seen at: image 2, 2, 3, mug\nCandidate Names: 8 -> cup",
    );
    assert_eq!(reply.explanation.as_deref(), Some("one"));
    assert_eq!(
        (reply.target_name_matches, reply.anchor_id, reply.relation_used.as_deref()),
        (Some(true), Some(3), Some("above"))
    );
    assert_eq!(reply.seen_at.map(|at| at.image), Some(1));
    assert_eq!(reply.candidate_names.keys().copied().collect::<Vec<_>>(), [7, 8]);
    assert_eq!(reply.not_read, [""; 0]);
}

#[test]
fn unknown_is_valid_only_for_anchor_and_relation() {
    let not_read = |text: &str| read(text).not_read;
    let said = "Anchor ID: unknown\nRelation used: none\n";
    let all = [
        "Predicted ID",
        "Explanation",
        "Candidate Names",
        "Target name matches?",
        "Anchor ID",
        "Relation used",
    ];
    assert_eq!(Field::ALL.map(Field::title), all);
    assert_eq!(Field::SeenAt.title(), "Seen at");
    assert_eq!(not_read(said), all[..4]);
    assert_eq!(not_read(&format!("{said}Predicted ID: 7")), all[1..4]);
    assert_eq!(not_read(&format!("{said}Predicted ID: none")), all[1..4]);
    assert_eq!(not_read(&format!("{said}Predicted ID: 7 or 8")), all[..4]);
    assert_eq!(not_read(&format!("{said}Predicted ID: the mug")), all[..4]);
    let reply = read(said);
    assert_eq!((reply.anchor_id, reply.relation_used), (None, None));
    assert_eq!(not_read("Explanation: x\nPredicted ID: 7"), all[2..]);
    // Nothing but an id: all other fields are missing.
    assert_eq!((read("22").predicted, not_read("22")), (Choice::Id(22), all[1..].to_vec()));
}

#[test]
fn punctuation_of_other_scripts_is_normalized_to_ascii() {
    for (text, expected) in [
        ("\u{ff01}\u{ff1a}\u{ff17}\u{ff5e}", "!:7~"),
        ("\u{ff00}\u{ff5f}", "\u{ff00}\u{ff5f}"),
        ("\u{3002}\u{3001}", ".,"),
        ("\u{201c}\u{201d}\u{201e}\u{ab}\u{bb}", "\"\"\"\"\""),
        ("\u{2018}\u{2019}", "''"),
        ("\u{2192}\u{21d2}\u{27a1}", "->->->"),
        ("\u{2013}\u{2014}", "--"),
        ("\u{2022}\u{25cf}\u{25aa}", "***"),
        ("a\u{a0}b\u{3000}c\u{202f}d", "a b c d"),
        ("a\r\nb\u{feff}c\u{200b}d", "a\nbcd"),
        ("<|begin_of_box|>22<|end_of_box|>", "22"),
        ("plain", "plain"),
    ] {
        assert_eq!(normalize_script(text), expected, "{text:?}");
    }
}

#[test]
fn thinking_text_is_removed() {
    for (text, expected) in [
        ("plain", "plain"),
        ("<think>a</think>b", "b"),
        ("a</think>b</think>c", "c"),
        ("a</thinking>b</think>c", "c"),
        ("a</think>b</thinking>c", "c"),
        ("<thought>a</thought>b", "b"),
        ("a</THINK>b", "b"),
        ("a<think>b", "a"),
        ("a<Thinking>b<think>c", "a"),
        ("a</think>b<thought>c", "b"),
        ("<think>", ""),
    ] {
        assert_eq!(without_thoughts(text), expected, "{text:?}");
    }
}

#[test]
fn joined_choices_contradict_unless_equal_or_missing() {
    use Choice::{Contradiction, Id, Missing, NotListed, Nothing};
    for (before, now, expected) in [
        (Missing, Id(7), Id(7)),
        (Missing, Nothing, Nothing),
        (Missing, Missing, Missing),
        (Id(7), Missing, Id(7)),
        (Id(7), Id(7), Id(7)),
        (Id(7), Id(9), Contradiction(7, 9)),
        (Id(7), Nothing, Contradiction(7, 7)),
        (Id(7), NotListed, Contradiction(7, 7)),
        (Nothing, Id(7), Contradiction(7, 7)),
        (NotListed, Id(7), Contradiction(7, 7)),
        (Nothing, NotListed, Nothing),
        (NotListed, Nothing, NotListed),
        (Nothing, Missing, Nothing),
        (Contradiction(7, 9), Id(7), Contradiction(7, 9)),
    ] {
        assert_eq!(join_choices(before, now), expected, "{before:?} {now:?}");
    }
}

#[test]
fn id_field_is_read_as_id_none_or_contradiction() {
    use Choice::{Contradiction, Id, Missing, NotListed, Nothing};
    for (value, expected) in [
        ("22", Id(22)),
        ("<22>", Id(22)),
        ("ID 22", Id(22)),
        ("22.", Id(22)),
        ("22.0", Id(22)),
        ("**22** (the window)", Id(22)),
        ("the object is candidate no. 22", Id(22)),
        ("The answer: instance number 22", Id(22)),
        ("= 22", Id(22)),
        ("- 22", Id(22)),
        ("\\boxed{22}", Id(22)),
        ("$22$", Id(22)),
        ("\n \n 22\n7", Id(22)),
        ("22, 2 metres left of it", Id(22)),
        ("22 or 22", Id(22)),
        ("22 or 7", Contradiction(22, 7)),
        ("**22** / ID 7", Contradiction(22, 7)),
        ("not listed", NotListed),
        ("**Visible, not listed**", NotListed),
        ("none of them", Nothing),
        ("theory 22", Missing),
        ("the window", Missing),
        ("22.5", Missing),
        ("22nd", Missing),
        ("-", Missing),
        ("", Missing),
    ] {
        assert_eq!(choice(value), expected, "{value:?}");
    }
}

#[test]
fn stripped_prefix_is_a_whole_word_in_any_case() {
    for (text, word, expected) in [
        ("ID 22", "id", Some(" 22")),
        ("id", "id", Some("")),
        ("id22", "id", Some("22")),
        ("idle", "id", None),
        ("i", "id", None),
        ("at 22", "id", None),
        ("\u{e9}t\u{e9}", "id", None),
        ("No.22", "no.", Some("22")),
        ("no.x", "no.", Some("x")),
    ] {
        assert_eq!(strip_word(text, word), expected, "{text:?} {word:?}");
    }
    assert_eq!(strip_decoration(" \n**_[22]"), "22]");
    assert_eq!(strip_decoration("22"), "22");
}

#[test]
fn only_whole_numbers_are_read() {
    for (text, expected) in [
        ("22", Some((22, ""))),
        ("22 m", Some((22, " m"))),
        ("22.", Some((22, "."))),
        ("22. Next", Some((22, ". Next"))),
        ("22.0", Some((22, ""))),
        ("22.0 m", Some((22, " m"))),
        ("22.05", None),
        ("22.0x", None),
        ("22.5", None),
        ("22nd", None),
        ("x", None),
        ("", None),
        ("4294967295", Some((u32::MAX, ""))),
        ("4294967296", None),
    ] {
        assert_eq!(leading_number(text), expected, "{text:?}");
    }
}

#[test]
fn second_number_is_read_only_after_a_separator() {
    for (after, expected) in [
        (" or 7", Some(7)),
        (" and 7", Some(7)),
        ("/7", Some(7)),
        (", 7", Some(7)),
        (" & 7", Some(7)),
        (" vs. 7", Some(7)),
        ("** or **7**", Some(7)),
        (" or ID 7", Some(7)),
        (" or 7 metres", Some(7)),
        (", 7 metres left", None),
        (", 7; it", Some(7)),
        (" 7", None),
        (" orange 7", None),
        (" or the window", None),
        (", 7.5", None),
        ("", None),
    ] {
        assert_eq!(another_number(after), expected, "{after:?}");
    }
}

#[test]
fn bare_id_must_be_the_whole_reply() {
    for (text, expected) in [
        ("22", Choice::Id(22)),
        (" 22.\n", Choice::Id(22)),
        ("**22**", Choice::Id(22)),
        ("ID: 22", Choice::Id(22)),
        ("id = 22", Choice::Id(22)),
        ("Answer: 22", Choice::Id(22)),
        ("answer ID 22", Choice::Id(22)),
        ("<answer>22</answer>", Choice::Id(22)),
        ("<answer>22", Choice::Missing),
        ("22 it is", Choice::Missing),
        ("22, 7", Choice::Missing),
        ("22\n7", Choice::Missing),
        ("22.5", Choice::Missing),
        ("the window", Choice::Missing),
        ("", Choice::Missing),
    ] {
        assert_eq!(read_bare_id(text), expected, "{text:?}");
    }
    // The limit is 40 characters.
    assert_eq!(read_bare_id(&format!("22{}", ".".repeat(38))), Choice::Id(22));
    assert_eq!(read_bare_id(&format!("22{}", ".".repeat(39))), Choice::Missing);
}

#[test]
fn many_wordings_mean_that_nothing_fits() {
    for value in [
        "none",
        "None - no candidate is a fridge",
        "**nothing**",
        "null",
        "Unknown",
        "n/a",
        "NA",
        "nil",
        "no",
        "No matching candidate",
        "not visible",
        "- none",
    ] {
        assert!(is_nothing(value), "{value}");
    }
    for value in ["No. 22", "no 22", "no #22", "Not 22", "nope", "window", "22", "", "noneth"] {
        assert!(!is_nothing(value), "{value}");
    }
}

#[test]
fn not_listed_must_begin_the_value() {
    for value in
        ["not listed", "Not_Listed", "unlisted", "visible, not listed", "Visible but not listed."]
    {
        assert!(is_not_listed(value), "{value}");
    }
    for value in ["listed", "visible", "it is not listed", "not", ""] {
        assert!(!is_not_listed(value), "{value}");
    }
}

#[test]
fn position_is_a_picture_number_and_two_numbers() {
    let place =
        |image, x, y, name: &str| Some(SeenAt { image, at: [x, y], area: None, name: name.into() });
    for (value, expected) in [
        ("Image 3, 512, 640, black alarm clock", place(3, 512.0, 640.0, "black alarm clock")),
        ("\n 3; 0; 1000; lamp\nmore", place(3, 0.0, 1000.0, "lamp")),
        ("image 1, 12.5, 20., lamp", place(1, 12.5, 20.0, "lamp")),
        ("image 1, 20, 30", place(1, 20.0, 30.0, "")),
        ("image 1, 20, 30, 8.03 door", place(1, 20.0, 30.0, "8.03 door")),
        ("image 1, 20, 30, 2 mugs, 3 forks", place(1, 20.0, 30.0, "2 mugs, 3 forks")),
        ("image 0, 20, 30, lamp", None),
        ("image 3, 20, lamp", None),
        ("image 3, 1.2.3, 20, lamp", None),
        ("none", None),
        (" \n", None),
    ] {
        assert_eq!(read_seen_at(value), expected, "{value:?}");
    }
}

#[test]
fn markdown_around_words_is_removed() {
    for (value, expected) in [
        ("red mug", Some("red mug")),
        (" ** red \n  mug **, ", Some("red mug")),
        ("`#_|red|_#`;", Some("red")),
        ("\"red mug\"", Some("red mug")),
        ("\"red mug", Some("\"red mug")),
        ("a \"red\" mug", Some("a \"red\" mug")),
        ("\"\"", None),
        ("**", None),
        ("", None),
    ] {
        assert_eq!(words(value).as_deref(), expected, "{value:?}");
    }
}

#[test]
fn truth_values_must_begin_the_value() {
    for (value, expected) in [
        ("true", Some(true)),
        ("**Yes**, it does", Some(true)),
        ("Y", Some(true)),
        ("matches", Some(true)),
        ("False.", Some(false)),
        ("no", Some(false)),
        ("N", Some(false)),
        ("maybe yes", None),
        ("truely", None),
        ("", None),
    ] {
        assert_eq!(read_truth(value), expected, "{value:?}");
    }
}

#[test]
fn first_of_several_anchors_counts() {
    for (value, expected) in [
        ("20", Some(20)),
        ("20, 31", Some(20)),
        ("unknown", None),
        ("not listed", None),
        ("the sofa", None),
    ] {
        assert_eq!(anchor(value), expected, "{value:?}");
    }
}

#[test]
fn last_shortlist_line_counts() {
    let listed = |text: &str| shortlist(text, |id| id < 10);
    assert_eq!(listed("Shortlist: 1, 2\nThe shortlist is 3 and 4."), [3, 4]);
    assert_eq!(listed("7, then 9, 7 and 12\nor 8"), [7, 9, 8]);
    assert_eq!(listed("<think>shortlist: 1</think>SHORTLIST 5"), [5]);
    assert_eq!(listed("none"), [0_u32; 0]);
}

#[test]
fn id_in_prose_requires_the_word_id() {
    let only = |text: &str| only_id(text, |id| id < 10);
    for (text, expected) in [
        ("It is ID 7.", Some(7)),
        ("It is id: #7", Some(7)),
        ("**ID** 7", Some(7)),
        ("ID7", Some(7)),
        ("ID 7 or ID 7, not ID 11", Some(7)),
        ("the grid 7", None),
        ("2id 7", None),
        ("ID 7, ID 9, ID 7", None),
        ("ID 7.5", None),
        ("ID 11", None),
        ("7", None),
    ] {
        assert_eq!(only(text), expected, "{text:?}");
    }
}

#[test]
fn label_within_a_line_requires_a_preceding_separator() {
    use Field::{AnchorId, Explanation, PredictedId, RelationUsed};
    let cases: [(&str, &[(Field, &str)]); 8] = [
        ("Predicted ID: 7; Anchor ID: 3", &[(PredictedId, " 7; "), (AnchorId, " 3")]),
        ("I say Predicted ID: 7", &[]),
        ("the Predicted ID is 7", &[]),
        ("so: Predicted ID: 7", &[(PredictedId, " 7")]),
        ("Predicted ID (of the target): 22", &[(PredictedId, " 22")]),
        ("## Predicted ID\n22", &[(PredictedId, "\n22")]),
        // Where fields begin lines, a label within a line is only mentioned.
        (
            "Predicted ID: 7\nExplanation: no. Anchor ID: 4",
            &[(PredictedId, " 7\n"), (Explanation, " no. Anchor ID: 4")],
        ),
        (
            "Explanation: no\nRelation used: on. Predicted ID: 7",
            &[(Explanation, " no\n"), (RelationUsed, " on. "), (PredictedId, " 7")],
        ),
    ];
    for (text, expected) in cases {
        assert_eq!(labels::fields(text), expected, "{text:?}");
    }
}

#[test]
fn field_label_may_follow_a_number_or_an_announcement() {
    for (text, expected) in [
        ("Predicted ID: 7\nExplanation: x\nPredicted ID: 8", 2),
        ("10. Predicted ID: 7", 1),
        ("100. Predicted ID: 7", 0),
        ("**Final Predicted ID:** 7", 1),
        ("- Predicted ID: 7", 1),
        ("say Predicted ID: 7", 0),
        ("Predicted ID", 0),
    ] {
        assert_eq!(labels::leading_fields(text), expected, "{text:?}");
    }
}

/// Generates texts from typical pieces of replies.
fn pieces() -> impl Strategy<Value = String> {
    let piece = prop_oneof![
        Just("Predicted ID".to_owned()),
        Just("Explanation: ".into()),
        Just("Candidate Names:".into()),
        Just("Anchor ID".into()),
        Just(": ".into()),
        Just("\n".into()),
        Just("**".into()),
        Just("{\"predicted_id\": ".into()),
        Just("}".into()),
        Just("<think>".into()),
        Just("</think>".into()),
        Just(" -> ".into()),
        Just("：".into()),
        "[0-9]{1,12}",
        "\\PC{0,6}",
    ];
    prop::collection::vec(piece, 0..40).prop_map(|pieces| pieces.concat())
}

proptest! {
    #[test]
    fn any_text_is_read_without_panic(text in "\\PC{0,200}") {
        let _ = read(&text);
    }

    /// An id follows the label of its field, or is the whole reply.
    #[test]
    fn id_comes_from_its_field_or_a_bare_reply(text in pieces()) {
        if let Choice::Id(id) = read(&text).predicted {
            let plain = normalize_script(&text);
            let said = without_thoughts(&plain);
            let lower = said.to_ascii_lowercase();
            let label = labels::LABELS.iter().filter(|(field, _)| *field == Field::PredictedId).filter_map(|(_, label)| lower.find(label)).min();
            let numbers = |text: &str| text.split(|c: char| !c.is_ascii_digit()).filter_map(|n| n.parse::<u32>().ok()).collect::<Vec<_>>();
            match label {
                Some(at) => prop_assert!(numbers(&said[at..]).contains(&id), "{id} of {text:?}"),
                None => prop_assert!(said.trim().len() <= 60 && numbers(said).iter().all(|n| *n == id || *n == 0), "{id} of {text:?}"),
            }
        }
    }

    /// Numbers outside of the id field change nothing.
    #[test]
    fn numbers_in_other_fields_are_never_the_id(id in 1_u32..500, others in prop::collection::vec(0_u32..500, 1..6)) {
        let numbers = others.iter().map(|n| format!("ID {n}, {n}.5 m")).collect::<Vec<_>>().join("; ");
        let text = format!("Explanation: {numbers}\nCandidate Names: {} -> thing\nAnchor ID: {}\nPredicted ID: {id}\nRelation used: {numbers}", others[0], others[0]);
        prop_assert_eq!(read(&text).predicted, Choice::Id(id));
        let without = text.replace(&format!("Predicted ID: {id}"), "Predicted: it");
        prop_assert_eq!(read(&without).predicted, Choice::Missing);
    }
}

#[test]
fn position_may_be_a_box() {
    let read = |value: &str| read_seen_at(value).map(|seen| (seen.at, seen.area, seen.name));
    let expected =
        |name: &str| Some(([30.0, 50.0], Some([20.0, 30.0, 40.0, 70.0]), name.to_owned()));
    for (value, name) in [
        ("image 1, 20, 30, 40, 70, lamp", "lamp"),
        ("1, (20, 30), (40, 70), lamp", "lamp"),
        ("Image 1: [20, 30, 40, 70] lamp", "lamp"),
        ("image 1, 20, 30, 40, 70, 8.03 door", "8.03 door"),
        ("image 1, 20 30 40 70, lamp", "lamp"),
        ("image 1, 20, 30, 40, 70 lamp", "lamp"),
        ("image 1, 40, 70, 20, 30, lamp", "lamp"),
        ("image 1, 20, 30, 40, 70", ""),
    ] {
        assert_eq!(read(value), expected(name), "{value}");
    }
    assert_eq!(read("1, 20, 30, 20, 70, lamp"), Some(([20.0, 50.0], None, "lamp".into())));
    let beyond = read("1, -20, 30, 40, 70, lamp").unwrap();
    assert_eq!(beyond.1, Some([-20.0, 30.0, 40.0, 70.0]));
}

#[test]
fn a_fractional_image_number_is_rejected() {
    let seen_at = |text: &str| read(&format!("Seen at: {text}")).seen_at.map(|at| at.image);
    assert_eq!(seen_at("image 2, 512, 640, mug"), Some(2));
    assert_eq!(seen_at("image 2.7, 512, 640, mug"), None);
    assert_eq!(seen_at("image 0, 512, 640, mug"), None);
}

#[test]
fn difference_is_read_unless_the_reply_says_that_there_is_none() {
    let differs = |text: &str| read(&format!("Predicted ID: 4\nDiffers: {text}")).differs;
    let black = Some("it is black, not white".to_owned());
    assert_eq!(differs("it is black, not white"), black);
    assert_eq!(differs("<it is black, not white.>"), black);
    assert_eq!(differs("not white but black").as_deref(), Some("not white but black"));
    assert_eq!(differs("No lamp shade, it is bare").as_deref(), Some("no lamp shade, it is bare"));
    for none in [
        "none",
        "None.",
        "nothing differs",
        "no",
        "null",
        "n/a",
        "-",
        "",
        "no difference",
        "not applicable",
        "It does not differ.",
        "it matches the query",
        "same",
        "false",
    ] {
        assert_eq!(differs(none), None, "{none:?}");
    }
    assert_eq!(differs(&"é".repeat(500)).map(|told| told.chars().count()), Some(MAX_DIFFERENCE));
    let json = r#"{"Predicted ID": 4, "Explanation": "x", "Differs": "it is black, not white"}"#;
    assert_eq!(read(json).differs, black);
    assert_eq!(read(r#"{"Predicted ID": 4, "Differs": null}"#).differs, None);
    // The word alone is no label.
    let line = "Predicted ID: 4\nExplanation: the color differs: it is dark\nAnchor ID: 3\nRelation used: on";
    assert_eq!(read(line).differs, None);
}
