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
fn every_shape_of_the_corpus_is_read() {
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
fn a_place_is_read_in_every_shape() {
    let expected = Some(SeenAt { image: 3, at: [0.25, 0.5], name: "black alarm clock".into() });
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
    assert_eq!(seen_at("image 3, 1200, 20, lamp"), None);
}

#[test]
fn names_and_explanations_are_whole() {
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

/// Bullets and numbers of the next line are no part of a value, and numbers within a name are no
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

/// A model that repeats the question before its answer has not said what the question says.
#[test]
fn what_the_question_says_is_no_answer() {
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
    // A harmless question may well be a candidate's name.
    let reply = read_answer(
        "Predicted ID: 7\nCandidate Names: 7 -> red mug, 9 -> blue mug",
        "red mug",
        false,
    );
    assert_eq!(reply.candidate_names[&7], "red mug");
}

#[test]
fn prose_names_one_id_or_none() {
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
fn a_megabyte_of_noise_is_nothing_and_hides_nothing() {
    let noise: String =
        (0..131_072_u32).map(|i| format!("{:x} {{ ", i.wrapping_mul(2_654_435_761))).collect();
    assert!(noise.len() > 1 << 20);
    assert_eq!(read(&noise).predicted, Choice::Missing);
    let answer = "\nPredicted ID: 22\nExplanation: x\nAnchor ID: 20\n";
    assert_eq!(read(&format!("{noise}{answer}")).predicted, Choice::Id(22));
    assert_eq!(read(&format!("{answer}{noise}")).predicted, Choice::Id(22));
}

/// Texts made of what replies are made of.
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
    fn no_text_panics(text in "\\PC{0,200}") {
        let _ = read(&text);
    }

    /// An id stands behind the label of its field, or it is all there is.
    #[test]
    fn an_id_is_in_its_field(text in pieces()) {
        if let Choice::Id(id) = read(&text).predicted {
            let plain = normalised(&text);
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
