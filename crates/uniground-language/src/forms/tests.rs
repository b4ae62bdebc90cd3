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
        ("how far am I from the door?", "door", "me"),
        ("how far is it from the desk to the window", "desk", "window"),
        ("how close is the lamp to the curtain?", "lamp", "curtain"),
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
        ("how many centimeters wide is the desk", "desk", Dimension::Width),
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
        assert_eq!((said.head.as_str(), parsed.target.head.as_str()), (subject, target), "{query}");
    }
    assert_eq!(parse("is the sofa red?").target.colors.len(), 1);
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
    let parsed = parse("How many refrigerators are there, and where do they stand?");
    assert_eq!((parsed.form, parsed.target.head.as_str()), (Form::Count, "refrigerators"));
}
