//! Sizes, distances, and whether something fits.

use super::patterns::{Found, PatternReader};
use super::words::{after, before, is_one_of, owned, pair_with_nouns, split_last, split_pair};
use super::{Dimension, Form, Passage, Reference, Way};
use crate::distances;

/// Words for what is measured of an object: "the height of".
pub(super) const DIMENSIONS: [(&str, Dimension); 16] = [
    ("size", Dimension::All),
    ("dimensions", Dimension::All),
    ("dimension", Dimension::All),
    ("measurements", Dimension::All),
    ("extent", Dimension::All),
    ("height", Dimension::Height),
    ("width", Dimension::Width),
    ("length", Dimension::Length),
    ("breadth", Dimension::Width),
    ("depth", Dimension::Depth),
    ("thickness", Dimension::Depth),
    ("volume", Dimension::Volume),
    ("area", Dimension::Area),
    ("footprint", Dimension::Area),
    ("floor area", Dimension::Area),
    ("elevation", Dimension::Elevation),
];

/// Words for a way past or below objects.
const PASSES: [&str; 6] = ["through", "between", "under", "underneath", "beneath", "below"];

/// Beginnings of questions whether something can be moved somewhere.
const MOVED: [&str; 14] = [
    "can i push",
    "can i move",
    "can i get",
    "can i fit",
    "can i squeeze",
    "can i roll",
    "can i carry",
    "could i push",
    "could i get",
    "could i fit",
    "can we push",
    "can we get",
    "can we fit",
    "could we fit",
];

/// Words before "distance" that say how it is measured.
const DISTANCE_ADJECTIVES: [&str; 8] =
    ["straight-line", "straight", "line", "direct", "shortest", "closest", "minimum", "euclidean"];

impl PatternReader<'_> {
    pub(super) fn distance(&mut self, words: &[&str]) -> Found {
        // "the distance between A and B", "how much space is there between A and B"
        let named = after(words, &["what is the", "what are the", "measure the", "give me the"])
            .unwrap_or(words);
        let mut named = named.strip_prefix(&["the"]).unwrap_or(named);
        while let [word, rest @ ..] = named
            && DISTANCE_ADJECTIVES.contains(word)
        {
            named = rest;
        }
        let is_distance = named.first() == Some(&"distance");
        let named = after(
            named,
            &[
                "distance",
                "gap",
                "space",
                "spacing",
                "clearance",
                "how much space is there",
                "how much room is there",
                "how much space is",
                "how much room is",
                "how much clearance is there",
                "how wide is the gap",
                "how big is the gap",
                "how large is the gap",
                "how wide is the space",
                "how big is the distance",
                "how long is the distance",
            ],
        );
        if let Some(named) = named {
            let named = named.strip_prefix(&["left"]).unwrap_or(named);
            // "the distance between the two stools"
            if let Some(both) = after(named, &["between the two", "between both", "between the"])
                && !both.contains(&"and")
            {
                let other = Reference::Object(Box::new(self.object(both)));
                return Some((Form::Distance(other), owned(both)));
            }
            let pair = after(named, &["between"])
                .and_then(|pair| split_pair(pair, "and"))
                .or_else(|| {
                    let pair = after(named, &["from"])?;
                    split_last(pair, "to")
                })
                .or_else(|| Some((after(named, &["to"])?, &["me"][..])))
                // "distance sofa to door"
                .or_else(|| {
                    let pair = split_last(named, "to").or_else(|| split_pair(named, "and"));
                    pair.filter(|_| is_distance)
                });
            let (target, other) = pair?;
            let (target, other) = pair_with_nouns(target, other);
            return Some((Form::Distance(self.reference(&other)), owned(&target)));
        }
        // "how far from the door to the window", "how many meters from … to …"
        let pair = match words {
            ["how", "many", unit, rest @ ..] if distances::is_unit(unit) => after(rest, &["from"]),
            ["how", "far", rest @ ..] => after(rest, &["from", "is it from"]),
            _ => None,
        };
        if let Some((target, other)) = pair.and_then(|pair| split_last(pair, "to")) {
            let (target, other) = pair_with_nouns(target, other);
            return Some((Form::Distance(self.reference(&other)), owned(&target)));
        }
        // "how far is A from B"
        let rest = match words {
            ["how", "many", unit, rest @ ..] if distances::is_unit(unit) => {
                let rest = after(rest, &["away", "apart"]).unwrap_or(rest);
                let from = ["from", "between", "apart", "away"];
                rest.iter().any(|word| from.contains(word)).then_some(rest)?
            }
            ["how", "far" | "distant" | "close" | "near", rest @ ..] => rest,
            _ => return None,
        };
        let rest = after(rest, &["away", "apart"]).unwrap_or(rest);
        let rest = after(rest, &["is", "are", "am", "do", "does", "would"])?;
        if let Some(rest) = after(rest, &["i have to go", "i need to go", "i"]) {
            let rest = after(rest, &["away"]).unwrap_or(rest);
            let target = after(rest, &["from", "to"])?;
            return Some((Form::Distance(Reference::Observer), owned(target)));
        }
        let rest = after(rest, &["it"]).filter(|rest| after(rest, &["from", "to"]).is_some());
        if let Some(rest) = rest {
            let (target, other) = match after(rest, &["from"]) {
                Some(pair) => split_last(pair, "to")?,
                None => (after(rest, &["to"])?, &["me"][..]),
            };
            return Some((Form::Distance(self.reference(other)), owned(target)));
        }
        let rest = after(words, &["how"]).and_then(|rest| {
            let be = rest.iter().position(|word| matches!(*word, "is" | "are"))?;
            Some(&rest[be + 1..])
        })?;
        let rest = before(rest, &["away from each other", "from each other", "away", "apart"])
            .unwrap_or(rest);
        let pair = split_last(rest, "from").or_else(|| split_last(rest, "to"));
        let (target, other) = match pair.or_else(|| split_pair(rest, "and")) {
            Some(pair) => pair,
            // "how far apart are the two stools"
            None if words.contains(&"apart") || words.contains(&"other") => {
                let other = Reference::Object(Box::new(self.object(rest)));
                return Some((Form::Distance(other), owned(rest)));
            }
            None => return Some((Form::Distance(Reference::Observer), owned(rest))),
        };
        let target = before(target, &["away"]).unwrap_or(target);
        let (target, other) = pair_with_nouns(target, other);
        // "how far is the nearest chair from the door": nearest to the door.
        let mut said = owned(&target);
        if target.iter().any(|word| matches!(*word, "nearest" | "closest"))
            && !target.contains(&"to")
        {
            said.push("to".into());
            said.extend(owned(&other));
        }
        Some((Form::Distance(self.reference(&other)), said))
    }

    pub(super) fn fit(&mut self, words: &[&str]) -> Found {
        const WAYS: [(&str, Way); 12] = [
            ("through", Way::Through),
            ("underneath", Way::Under),
            ("beneath", Way::Under),
            ("under", Way::Under),
            ("below", Way::Under),
            ("inside", Way::In),
            ("into", Way::In),
            ("in", Way::In),
            ("onto", Way::On),
            ("on top of", Way::On),
            ("on", Way::On),
            ("between", Way::Between),
        ];
        let asks = after(
            words,
            &[
                "does",
                "do",
                "would",
                "will",
                "could",
                "can",
                "is there enough space for",
                "is there enough room for",
                "is there space for",
                "is there room for",
                "should",
            ],
        );
        let found = match asks {
            Some(rest) => verb_of_fitting(rest).map(|(end, way)| (rest[..end].to_vec(), way)),
            // "is the chair small enough to fit under the desk"
            None => after(words, &["is", "are"]).and_then(|rest| {
                let enough = rest.iter().position(|word| *word == "enough")?;
                let target = rest[..enough.checked_sub(1)?].to_vec();
                let rest = &rest[enough + 1..];
                if let Some(guest) = after(rest, &["for"]) {
                    // "is the door wide enough for the sofa"
                    let guest = guest.split(|word| *word == "to").next().unwrap_or(guest);
                    let way = std::iter::once("through").chain(target).collect();
                    return Some((guest.to_vec(), way));
                }
                let rest = after(rest, &["to fit", "to go", "to pass", "to get", "to be put"])?;
                Some((target, rest.to_vec()))
            }),
        };
        // "is there room for the chair under the desk"
        let found = found.or_else(|| {
            let rest = asks.filter(|_| words[0] == "is")?;
            let way = rest.iter().position(|word| WAYS.iter().any(|(said, _)| said == word))?;
            Some((rest[..way].to_vec(), rest[way..].to_vec()))
        });
        // "can I push a cart 80 cm wide between the bed and the desk"
        let found = found.or_else(|| {
            let rest = after(words, &MOVED)?;
            let way = rest.iter().position(|word| is_one_of(Some(word), &PASSES))?;
            Some((rest[..way].to_vec(), rest[way..].to_vec()))
        });
        let (guest, rest) = found?;
        // "drive through between the two armchairs"
        let rest = if let ["through", between @ ..] = &rest[..]
            && between.first() == Some(&"between")
        {
            between.to_vec()
        } else {
            rest
        };
        let (way, place) =
            WAYS.iter().find_map(|(said, way)| Some((*way, after(&rest, &[said])?)))?;
        let pair = split_pair(place, "and").filter(|_| way == Way::Between);
        let (place, second) = match pair {
            Some((first, second)) => {
                let (first, second) = pair_with_nouns(first, second);
                (Box::new(self.object(&first)), Some(Box::new(self.object(&second))))
            }
            None => (Box::new(self.object(place)), None),
        };
        // "a robot 60 cm wide", "a 60 cm wide robot": its size is given.
        let given_m = (0..guest.len()).find_map(|i| Some(distances::length_at(&guest[i..])?.0));
        let target = match (given_m, pair) {
            (Some(_), Some((first, _))) => owned(first),
            (Some(_), None) => owned(&rest[1..]),
            (None, _) => owned(&guest),
        };
        Some((Form::Fit(Passage { way, place, second, given_m }), target))
    }
}

pub(super) fn how(words: &[&str]) -> Found {
    let rest = after(words, &["how"])?;
    let (size, rest) = match rest {
        ["high", "up", rest @ ..] => (Dimension::Elevation, rest),
        ["high", "above" | "off", "the", "floor" | "ground", rest @ ..] => {
            (Dimension::Elevation, rest)
        }
        ["big" | "large" | "small" | "huge" | "bulky", rest @ ..] => (Dimension::All, rest),
        ["tall" | "high" | "short" | "low", rest @ ..] => (Dimension::Height, rest),
        ["long", rest @ ..] => (Dimension::Length, rest),
        ["wide" | "broad" | "narrow", rest @ ..] => (Dimension::Width, rest),
        ["deep" | "thick" | "thin" | "shallow", rest @ ..] => (Dimension::Depth, rest),
        ["much", rest @ ..] => {
            let rest = after(
                rest,
                &[
                    "of the floor does",
                    "of the floor do",
                    "floor space does",
                    "space does",
                    "room does",
                    "area does",
                    "floor does",
                ],
            )?;
            let target = before(
                rest,
                &["take up", "take", "occupy", "cover", "need", "use", "use up", "fill"],
            )?;
            return Some((Form::Size(Dimension::Area), owned(target)));
        }
        ["many", unit, rest @ ..] if distances::is_unit(unit) => match rest {
            ["tall" | "high", rest @ ..] => (Dimension::Height, rest),
            ["long", rest @ ..] => (Dimension::Length, rest),
            ["wide" | "across", rest @ ..] => (Dimension::Width, rest),
            ["deep", rest @ ..] => (Dimension::Depth, rest),
            _ => return None,
        },
        ["many", ..] => return Some((Form::Count, owned(words))),
        _ => return None,
    };
    let target = after(rest, &["is", "are"])?;
    let (size, target) = match before(
        target,
        &[
            "above the floor",
            "above the ground",
            "above ground",
            "off the floor",
            "off the ground",
            "from the floor",
        ],
    ) {
        Some(target) => (Dimension::Elevation, target),
        None => (size, target),
    };
    (!target.is_empty()).then(|| (Form::Size(size), owned(target)))
}

/// "the height of the shelf", "what color is the rug"
pub(super) fn measure_of(words: &[&str]) -> Found {
    if after(words, &["what number of", "count the", "count all", "count"]).is_some()
        || after(words, &["the number of", "what is the number of", "number of"]).is_some()
    {
        return Some((Form::Count, owned(words)));
    }
    if let Some(rest) = after(words, &["what size"]) {
        let target = after(rest, &["is", "are", "does", "has"])?;
        let target = before(target, &["have"]).unwrap_or(target);
        return Some((Form::Size(Dimension::All), owned(target)));
    }
    let asked = after(
        words,
        &["what is the", "what are the", "give me the", "measure the", "show me the", "the"],
    )
    .unwrap_or(words);
    DIMENSIONS.iter().find_map(|(word, dimension)| {
        let target = after(asked, &[word]).and_then(|rest| after(rest, &["of"]))?;
        Some((Form::Size(*dimension), owned(target)))
    })
}

/// Returns whether a question asks whether something fits or passes.
pub(super) fn asks_for_space(question: &[String]) -> bool {
    let words: Vec<&str> = question.iter().map(String::as_str).collect();
    verb_of_fitting(&words).is_some()
}

/// Returns where "fit", "go through" and the like stand, and the words after them.
fn verb_of_fitting<'b>(words: &[&'b str]) -> Option<(usize, Vec<&'b str>)> {
    const VERBS: [&str; 14] = [
        "fit",
        "go",
        "pass",
        "get",
        "drive",
        "squeeze",
        "be moved",
        "be pushed",
        "be carried",
        "be stored",
        "be put",
        "slide",
        "be placed",
        "roll",
    ];
    (1..words.len()).find_map(|i| {
        let rest = after(&words[i..], &VERBS)?;
        let passes = is_one_of(rest.first(), &PASSES);
        (passes || words[i] == "fit").then(|| (i, rest.to_vec()))
    })
}
