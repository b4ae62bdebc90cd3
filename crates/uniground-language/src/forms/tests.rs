use super::*;
use crate::parse;

#[track_caller]
fn form(query: &str) -> Form {
    parse(query).form
}

fn head(reference: &Reference) -> &str {
    match reference {
        Reference::Observer => "me",
        Reference::Object(phrase) => &phrase.head,
    }
}

#[test]
fn distances_have_a_target_and_a_reference() {
    for (query, target, from) in [
        ("how far is the green stool from the TV?", "stool", "tv"),
        ("How far away is the stool from the door?", "stool", "door"),
        ("how far apart are the sofa and the lamp?", "sofa", "lamp"),
        ("what's the distance between the desk and the bed?", "desk", "bed"),
        ("distance from the desk to the bed", "desk", "bed"),
        ("how much space is there between the sofa and the coffee table", "sofa", "coffee table"),
        ("how many meters is the bed from the wall", "bed", "wall"),
        ("how far is the door", "door", "me"),
        ("how many meters from the door to the window?", "door", "window"),
        ("how far am I from the door?", "door", "me"),
        ("how far is it from the desk to the window", "desk", "window"),
        ("how close is the lamp to the curtain?", "lamp", "curtain"),
        ("give me the distance between the two round stools", "stools", "stools"),
        ("Straight-line distance lamp to curtain?", "lamp", "curtain"),
        ("the shortest distance between the desk and the bed", "desk", "bed"),
        ("can you tell me how far the desk is", "", ""),
    ] {
        if target.is_empty() {
            continue;
        }
        let parsed = parse(query);
        let Form::Distance(reference) = &parsed.form else { panic!("{query}: {parsed:?}") };
        assert_eq!((parsed.target.head.as_str(), head(reference)), (target, from), "{query}");
    }
    let parsed = parse("how far is the nearest chair from the door");
    assert_eq!(parsed.target.relations[0].anchors[0].head, "door");
}

#[test]
fn sizes_have_a_dimension() {
    for (query, target, dimension) in [
        ("how big is the sofa?", "sofa", Dimension::All),
        ("how tall is the white bookshelf", "bookshelf", Dimension::Height),
        ("how wide is the desk?", "desk", Dimension::Width),
        ("how high is the picture above the floor?", "picture", Dimension::Elevation),
        ("what are the dimensions of the rug", "rug", Dimension::All),
        ("what is the height of the floor lamp?", "floor lamp", Dimension::Height),
        ("how much space does the wardrobe take up?", "wardrobe", Dimension::Area),
        ("what size is the rug?", "rug", Dimension::All),
        ("Length of the rug, in meters", "rug", Dimension::Length),
        ("how many centimeters wide is the desk", "desk", Dimension::Width),
        ("how much of the floor does the rug cover", "rug", Dimension::Area),
    ] {
        let parsed = parse(query);
        assert_eq!(
            (parsed.form, parsed.target.head.as_str()),
            (Form::Size(dimension), target),
            "{query}"
        );
    }
}

#[test]
fn lists_are_about_things_of_any_kind_or_of_one() {
    for (query, head, anchor) in [
        ("what is on the desk?", "things", "desk"),
        ("what's standing on the coffee table", "things", "coffee table"),
        ("everything on the dining table", "things", "dining table"),
        ("what can you see on the shelf?", "things", "shelf"),
        ("which things are next to the sofa", "things", "sofa"),
        ("list everything under the desk", "things", "desk"),
        ("what does the table carry", "things", "table"),
        ("There is a wooden desk in the corner. What is standing on it?", "things", "desk"),
        ("all the chairs around the dining table", "chairs", "dining table"),
        ("which chairs are next to the window?", "chairs", "window"),
        ("what objects are within 1 m of the bed?", "things", "bed"),
        ("what is not on the shelf?", "things", "shelf"),
    ] {
        let parsed = parse(query);
        assert_eq!(parsed.form, Form::List, "{query}: {parsed:?}");
        assert_eq!(parsed.target.head, head, "{query}");
        assert_eq!(parsed.target.relations[0].anchors[0].head, anchor, "{query}");
    }
    assert_eq!(form("list all chairs"), Form::List);
    assert_eq!(form("what is in the room?"), Form::List);
    let parsed = parse("list chairs except red ones and except blue ones");
    assert_eq!(parsed.except.len(), 2, "{parsed:?}");
    let parsed = parse("everything on the desk except the laptop and the mug");
    let except: Vec<&str> = parsed.except.iter().map(|phrase| phrase.head.as_str()).collect();
    assert_eq!(except, ["laptop", "mug"]);
    assert_eq!(parsed.target.relations[0].anchors[0].head, "desk");
}

#[test]
fn yes_or_no_questions_have_a_subject_or_ask_for_existence() {
    for query in [
        "is there a piano?",
        "Is there a plant on the desk?",
        "are there any towels",
        "are any of the plants on the floor",
        "do any of the chairs have a cushion?",
        "aren't there two beds?",
        "do you see a clock?",
        "is there anything under the bed?",
    ] {
        assert_eq!(form(query), Form::Exists, "{query}: {:?}", parse(query));
    }
    for (query, subject, target) in [
        ("is the mug on the coffee table?", "mug", "mug"),
        ("is the sofa red?", "sofa", "sofa"),
        ("is the lamp next to the bed", "lamp", "lamp"),
        ("is #4 a chair?", "#4", "chair"),
    ] {
        let parsed = parse(query);
        let Form::Holds(said) = &parsed.form else { panic!("{query}: {parsed:?}") };
        let heads = (said.subject.head.as_str(), parsed.target.head.as_str());
        assert_eq!(heads, (subject, target), "{query}");
        assert!(!said.is_negated && !said.of_all, "{query}: {said:?}");
    }
    assert_eq!(parse("is the sofa red?").target.colors.len(), 1);
}

#[track_caller]
fn claim(query: &str) -> (Claim, Phrase) {
    let parsed = parse(query);
    let Form::Holds(claim) = parsed.form else { panic!("{query}: {parsed:?}") };
    assert!(parsed.not_understood.is_empty(), "{query}: {:?}", parsed.not_understood);
    (claim, parsed.target)
}

#[test]
fn claims_can_be_negated() {
    for (query, is_negated) in [
        ("is the cup not on the table?", true),
        ("is the cup on the table?", false),
        // It expects a yes.
        ("isn't the lamp on the desk", false),
        ("isn't the lamp not on the desk", true),
        ("aren't the shoes next to the door", false),
        ("is the sofa not red", true),
        ("is the sofa beside the door not red", true),
        ("are none of the chairs red", true),
        ("doesn't the desk have a lamp on it", false),
        ("does the desk not have a lamp", true),
    ] {
        let (claim, target) = claim(query);
        assert_eq!(claim.is_negated, is_negated, "{query}: {target:?}");
        assert!(claim.subject.other_than.is_empty() && target.other_than.is_empty(), "{query}");
        assert!(target.relations.iter().all(|relation| !relation.negated), "{query}: {target:?}");
    }
}

#[test]
fn claims_can_be_about_all_objects_of_a_kind() {
    for (query, subject) in [
        ("are all chairs on the floor?", "chairs"),
        ("are all of the chairs red", "chairs"),
        ("are the chairs all red?", "chairs"),
        ("are the chairs red", "chairs"),
        ("is every mug on the table", "mug"),
        ("are both lamps on the nightstand", "lamps"),
        ("are the two lamps on the nightstand", "lamps"),
        ("does every trash can stand on the floor?", "trash can"),
        ("do all the nightstands have a lamp on them?", "nightstands"),
        ("are no chairs red", "chairs"),
    ] {
        let (claim, _) = claim(query);
        assert_eq!((claim.subject.head.as_str(), claim.of_all), (subject, true), "{query}");
    }
    let (one, target) = claim("does the desk have a lamp on it?");
    assert!(!one.of_all && one.subject.with.is_empty(), "{one:?}");
    assert_eq!((target.head.as_str(), target.with[0].phrase.head.as_str()), ("desk", "lamp"));
}

#[test]
fn claims_that_no_scan_shows_are_still_yes_or_no_questions() {
    for query in ["is the window open?", "is the suitcase heavier than the guitar"] {
        let parsed = parse(query);
        assert!(matches!(parsed.form, Form::Holds(_)), "{query}: {parsed:?}");
        assert!(!parsed.not_understood.is_empty(), "{query}");
    }
}

#[test]
fn measures_are_compared_with_given_lengths() {
    use Bound::{About, Above, Below};
    use Dimension::{All, Depth, Elevation, Height, Length, Width};
    for (query, target, dimension, bound, given_m) in [
        ("is the door wider than 90 cm?", "door", Width, Above, 0.9),
        ("is the door at least 80cm wide", "door", Width, Above, 0.8),
        ("is the shelf lower than two meters", "shelf", Elevation, Below, 2.0),
        ("is the shelf no more than 2 m tall", "shelf", Height, Below, 2.0),
        ("is the sofa bigger than 2 m", "sofa", All, Above, 2.0),
        ("is the desk 1.5 m long?", "desk", Length, About, 1.5),
        ("isn't the bookcase over 6 feet tall", "bookcase", Height, Above, 1.8288),
        ("is the picture more than 1.5 m above the floor", "picture", Elevation, Above, 1.5),
        ("is the depth of the shelf less than 30 cm", "shelf", Depth, Below, 0.3),
        ("is the ceiling higher than 2.5 meters?", "ceiling", Elevation, Above, 2.5),
        ("is the desk longer than a meter and a half", "desk", Width, Above, 1.5),
        ("is the desk at least as long as 1.5 m", "desk", Length, Above, 1.5),
    ] {
        let parsed = parse(query);
        let Form::Limit(limit) = &parsed.form else { panic!("{query}: {parsed:?}") };
        assert_eq!(parsed.target.head, target, "{query}");
        assert_eq!(limit.by, ComparedBy::Dimension(dimension), "{query}");
        assert_eq!((limit.bound, limit.of_all), (bound, false), "{query}");
        assert!((limit.given_m - given_m).abs() < 1e-4, "{query}: {}", limit.given_m);
    }
    for (query, target, from) in [
        ("is the gap between the sofa and the table wider than 60 cm?", "sofa", "table"),
        ("is the distance from the desk to the bed more than a meter?", "desk", "bed"),
        ("is the distance between the beds more than a meter?", "beds", "beds"),
        ("are the sofa and the TV more than 2 m apart", "sofa", "tv"),
        ("is there at least 60 cm between the desk and the bed", "desk", "bed"),
        ("is there more than 1 m of space between the desk and the bed", "desk", "bed"),
        ("is the door more than 3 m away", "door", "me"),
        ("is the bin more than 50 cm from the door", "bin", "door"),
    ] {
        let parsed = parse(query);
        let Form::Limit(limit) = &parsed.form else { panic!("{query}: {parsed:?}") };
        let ComparedBy::Distance(reference) = &limit.by else { panic!("{query}: {limit:?}") };
        assert_eq!((parsed.target.head.as_str(), head(reference)), (target, from), "{query}");
        assert_eq!(limit.bound, Above, "{query}");
    }
    let parsed = parse("are all shelves lower than 2 m");
    assert!(matches!(parsed.form, Form::Limit(Limit { of_all: true, .. })), "{parsed:?}");
}

#[test]
fn the_unit_of_the_answer_can_be_given() {
    for (query, form, unit) in [
        ("how wide is the door in inches?", Form::Size(Dimension::Width), LengthUnit::Inches),
        ("how many feet long is the sofa", Form::Size(Dimension::Length), LengthUnit::Feet),
        (
            "what is the height of the shelf in cm",
            Form::Size(Dimension::Height),
            LengthUnit::Centimeters,
        ),
        (
            "how much space does the bed take up in square feet",
            Form::Size(Dimension::Area),
            LengthUnit::Feet,
        ),
    ] {
        let parsed = parse(query);
        assert_eq!((&parsed.form, parsed.unit), (&form, Some(unit)), "{query}: {parsed:?}");
        assert!(parsed.not_understood.is_empty(), "{query}: {parsed:?}");
    }
    let parsed = parse("how far is the stool from the TV in feet");
    assert!(matches!(parsed.form, Form::Distance(Reference::Object(_))), "{parsed:?}");
    assert_eq!(parsed.unit, Some(LengthUnit::Feet));
    assert_eq!(parse("how wide is the door in the corner").unit, None);
    assert_eq!(parse("the ruler in inches").unit, None);
}

#[test]
fn comparisons_and_choices_have_two_objects() {
    for (query, target, other, more) in [
        ("is the sofa longer than the rug?", "sofa", "rug", true),
        ("is the lamp closer to the door than the chair", "lamp", "chair", false),
    ] {
        let parsed = parse(query);
        let Form::Comparison(found) = &parsed.form else { panic!("{query}: {parsed:?}") };
        assert_eq!(parsed.target.head, target, "{query}");
        assert_eq!((found.other.head.as_str(), found.more), (other, more), "{query}");
    }
    for (query, target, other) in [
        ("which is taller, the lamp or the shelf?", "lamp", "shelf"),
        ("which is closer to the door: the bed or the desk", "bed", "desk"),
        ("is the bed or the desk bigger?", "bed", "desk"),
        ("is the chair closer to the door or the window?", "door", "window"),
    ] {
        let parsed = parse(query);
        let Form::Choice(found) = &parsed.form else { panic!("{query}: {parsed:?}") };
        assert_eq!((parsed.target.head.as_str(), found.other.head.as_str()), (target, other));
    }
}

#[test]
fn fits_have_a_guest_and_a_place() {
    for (query, target, place, way) in [
        ("does the stool fit under the desk?", "stool", "desk", Way::Under),
        ("would the sofa fit through the door", "sofa", "door", Way::Through),
        ("can the box go under the bed?", "box", "bed", Way::Under),
        ("is the chair small enough to fit under the table?", "chair", "table", Way::Under),
        ("is there room for the chair under the desk?", "chair", "desk", Way::Under),
    ] {
        let parsed = parse(query);
        let Form::Fit(found) = &parsed.form else { panic!("{query}: {parsed:?}") };
        assert_eq!(
            (parsed.target.head.as_str(), found.place.head.as_str(), found.way),
            (target, place, way),
            "{query}"
        );
    }
    for (query, way, given_m) in [
        ("I'm 25 cm tall. Do I fit under the sofa?", Way::Under, 0.25),
        ("I have a crate 40 cm tall, would it slide under the table?", Way::Under, 0.4),
        ("My robot is 0.5 m wide, can it drive through the door?", Way::Through, 0.5),
        (
            "Can I push a cart 80 cm wide between the bed and the desk without moving anything?",
            Way::Between,
            0.8,
        ),
    ] {
        let parsed = parse(query);
        let Form::Fit(found) = &parsed.form else { panic!("{query}: {parsed:?}") };
        assert!((found.given_m.unwrap() - given_m).abs() < 1e-5, "{query}: {found:?}");
        assert_eq!(found.way, way, "{query}");
    }
    let parsed = parse("would a robot 60 cm wide fit through the door");
    let Form::Fit(found) = &parsed.form else { panic!("{parsed:?}") };
    assert!((found.given_m.unwrap() - 0.6).abs() < 1e-5);
}

#[test]
fn descriptions_and_places_keep_their_target() {
    for (query, target, form) in [
        ("what color is the rug?", "rug", Form::Description(Aspect::Color)),
        ("what is the red thing on the table", "thing", Form::Description(Aspect::All)),
        ("describe the armchair", "armchair", Form::Description(Aspect::All)),
        ("what is #7?", "#7", Form::Description(Aspect::All)),
        ("what is the table made of?", "table", Form::Description(Aspect::Material)),
        ("where is the remote?", "remote", Form::Place),
        ("where can I find the scissors", "scissors", Form::Place),
        ("what is the lamp standing on?", "lamp", Form::Place),
        ("what is closest to the door?", "thing", Form::Description(Aspect::All)),
    ] {
        let parsed = parse(query);
        assert_eq!((parsed.form, parsed.target.head.as_str()), (form, target), "{query}");
    }
}

#[test]
fn descriptions_of_one_object_ask_for_the_object() {
    for query in [
        "the red mug",
        "the chair closest to the door",
        "which chair is closest to the window?",
        "bring me the mug that is on the table",
        "the lamp behind the sofa",
        "I need something to sit on",
        "how do I turn on the lamp",
        "the sofa that is not brown",
    ] {
        assert_eq!(form(query), Form::Object, "{query}: {:?}", parse(query));
    }
    assert_eq!(form("how many chairs are there"), Form::Count);
}

#[test]
fn spoken_variants_have_the_same_form() {
    for (query, target) in [
        ("Hey, where did I leave my laptop?", "laptop"),
        ("Where'd I put the kettle?", "kettle"),
        ("I can't find my headphones, where are they?", "headphones"),
    ] {
        let parsed = parse(query);
        assert_eq!((parsed.form, parsed.target.head.as_str()), (Form::Place, target), "{query}");
    }
    for (query, anchor) in [
        ("What's on the coffee table right now?", "coffee table"),
        ("Tell me everything that's sitting on the white dresser.", "dresser"),
        ("What did somebody leave on the armchair?", "armchair"),
        ("What all is on the long dining table?", "dining table"),
        ("What has been left on the desk?", "desk"),
    ] {
        let parsed = parse(query);
        assert_eq!(parsed.form, Form::List, "{query}: {parsed:?}");
        assert_eq!(parsed.target.relations[0].anchors[0].head, anchor, "{query}");
    }
    for query in [
        "Have we got a guitar in here somewhere?",
        "Is there a fire extinguisher, and if so where?",
        "Are there any balls lying around on the floor?",
        "Is anything standing on the shelves?",
        "Can you find my umbrella?",
        "Do you see the vacuum cleaner anywhere?",
        "Does the kitchen have a dishwasher?",
    ] {
        assert_eq!(form(query), Form::Exists, "{query}: {:?}", parse(query));
    }
    for (query, target, other) in [
        (
            "Which armchair is closer to the desk, the white one or the dark grey one?",
            "armchair",
            "armchair",
        ),
        ("Which one's closer to the TV, the green stool or the orange one?", "stool", "stool"),
        (
            "Which of the two wardrobes is wider, the white one or the red one?",
            "wardrobe",
            "wardrobe",
        ),
    ] {
        let parsed = parse(query);
        let Form::Choice(found) = &parsed.form else { panic!("{query}: {parsed:?}") };
        assert_eq!((parsed.target.head.as_str(), found.other.head.as_str()), (target, other));
    }
    let parsed = parse("About how far apart are the green and the purple beanbag?");
    let Form::Distance(other) = &parsed.form else { panic!("{parsed:?}") };
    assert_eq!((parsed.target.head.as_str(), head(other)), ("beanbag", "beanbag"));
    let parsed = parse("Which toaster is next to the microwave, the green one or the yellow one?");
    assert_eq!((parsed.form, parsed.target.head.as_str()), (Form::Object, "toaster"));
    let parsed = parse("which beanbag is the basketball next to, green or orange");
    assert_eq!((parsed.form, parsed.target.head.as_str()), (Form::Object, "beanbag"));
    assert_eq!(parsed.target.relations[0].anchors[0].head, "basketball");
    let parsed = parse("Confirm: teddy bear is on the orange sofa");
    assert!(matches!(&parsed.form, Form::Holds(claim) if claim.subject.head == "teddy bear"));
    assert_eq!(parsed.target.relations[0].anchors[0].head, "sofa");
    let parsed = parse("Toaster beside the microwave: green or yellow? Give the box.");
    assert_eq!((parsed.form, parsed.target.head.as_str()), (Form::Object, "toaster"));
    let parsed = parse("Bring me the blue mug from the table");
    assert_eq!(parsed.target.head, "mug");
    assert_eq!(parsed.target.relations[0].anchors[0].head, "table");
    let parsed = parse("there's a plant within a meter or so of the door, which");
    assert_eq!(parsed.target.relations[0].text, "within 1 m of", "{parsed:?}");
    let parsed = parse("How many refrigerators are there, and where do they stand?");
    assert_eq!((parsed.form, parsed.target.head.as_str()), (Form::Count, "refrigerators"));
}

#[test]
fn differences_compare_two_objects() {
    for (query, target, other, word, more) in [
        (
            "how much higher is the bar table than the dining table?",
            "bar table",
            "dining table",
            "higher",
            true,
        ),
        ("How much shorter is the red sofa than the blue one?", "sofa", "sofa", "shorter", false),
        ("how much closer to the door is the lamp than the desk", "lamp", "desk", "closer", false),
    ] {
        let parsed = parse(query);
        let Form::Difference(comparison) = &parsed.form else { panic!("{query}: {parsed:?}") };
        assert_eq!((parsed.target.head.as_str(), comparison.other.head.as_str()), (target, other));
        assert_eq!((comparison.word.as_str(), comparison.more), (word, more), "{query}");
    }
}

#[test]
fn floor_that_is_taken_up_is_an_area() {
    for (query, more) in [
        ("which takes up more floor, the round rug or the square one?", true),
        ("which rug needs less space, the round one or the square one?", false),
    ] {
        let Form::Choice(comparison) = form(query) else { panic!("{query}") };
        assert_eq!(comparison.by, ComparedBy::Dimension(Dimension::Area), "{query}");
        assert_eq!((comparison.more, comparison.other.head.as_str()), (more, "rug"), "{query}");
    }
}

#[test]
fn exceptions_may_come_first() {
    for query in [
        "apart from the doormat, which rugs are there?",
        "Except for the doormat, what is on the floor?",
    ] {
        let parsed = parse(query);
        assert_eq!(parsed.form, Form::List, "{query}");
        assert_eq!(parsed.except.len(), 1, "{query}");
        assert_eq!(parsed.except[0].head, "doormat", "{query}");
    }
    // "Besides" is often meant as "beside".
    assert_eq!(parse("besides the sofa, the lamp").except, []);
}
