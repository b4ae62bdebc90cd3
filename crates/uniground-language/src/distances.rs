//! Distances in words: "within 1 m of the sofa", "about two meters from the door".

use super::tokens::BREAK;

/// A range of distances, meters.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Reach {
    /// Minimum distance; 0 for "within".
    pub least: f32,
    /// Maximum distance; infinite for "more than".
    pub most: f32,
}

/// "about 2 m" means 2 m plus or minus this share.
const ABOUT: f32 = 0.25;
/// Beyond a limit, a distance fits less and less, up to this share of the limit.
const TOLERANCE: f32 = 0.15;
/// The same for short limits, meters.
const LEAST_TOLERANCE_M: f32 = 0.05;

/// How a phrase limits a distance.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Limit {
    Most,
    Least,
    About,
}

const LIMITS: [(&[&str], Limit); 20] = [
    (&["no", "more", "than"], Limit::Most),
    (&["not", "more", "than"], Limit::Most),
    (&["no", "further", "than"], Limit::Most),
    (&["no", "farther", "than"], Limit::Most),
    (&["less", "than"], Limit::Most),
    (&["closer", "than"], Limit::Most),
    (&["nearer", "than"], Limit::Most),
    (&["at", "most"], Limit::Most),
    (&["up", "to"], Limit::Most),
    (&["in", "a", "radius", "of"], Limit::Most),
    (&["within", "a", "radius", "of"], Limit::Most),
    (&["within"], Limit::Most),
    (&["more", "than"], Limit::Least),
    (&["further", "than"], Limit::Least),
    (&["farther", "than"], Limit::Least),
    (&["at", "least"], Limit::Least),
    (&["about"], Limit::About),
    (&["around"], Limit::About),
    (&["roughly"], Limit::About),
    (&["approximately"], Limit::About),
];

/// Words between the distance and the object: "1 m away from the sofa".
const FROM: [&[&str]; 8] = [
    &["away", "from"],
    &["distance", "of"],
    &["distance", "from"],
    &["or", "less", "from"],
    &["of"],
    &["from"],
    &["to"],
    &["around"],
];

impl Reach {
    /// Reads the words of a relation: "within 1 m of". `None` where they give no distance.
    #[must_use]
    pub fn in_words(words: &str) -> Option<Self> {
        let (kind, rest) = words.split_once(' ')?;
        let meters: f32 = rest.split(' ').next()?.parse().ok()?;
        rest.split(' ').nth(1).filter(|unit| *unit == "m")?;
        Some(match kind {
            "within" => Self { least: 0.0, most: meters },
            "beyond" => Self { least: meters, most: f32::INFINITY },
            "about" => Self { least: meters * (1.0 - ABOUT), most: meters * (1.0 + ABOUT) },
            _ => return None,
        })
    }

    /// Returns the distance in meters beyond which nothing fits.
    #[must_use]
    pub fn limit_m(&self) -> f32 {
        self.most + (TOLERANCE * self.most).max(LEAST_TOLERANCE_M)
    }

    /// Returns how well a distance fits, `0..=1`: 1 within the range, 0 beyond the tolerance.
    #[must_use]
    pub fn fit(&self, distance_m: f32) -> f32 {
        let beyond = (self.least - distance_m).max(distance_m - self.most).max(0.0);
        let limit = if distance_m < self.least { self.least } else { self.most };
        (1.0 - beyond / (TOLERANCE * limit).max(LEAST_TOLERANCE_M)).clamp(0.0, 1.0)
    }
}

/// Joins the words of distances to one token each, such as `within_1_m_of`.
pub(super) fn join(tokens: Vec<String>) -> Vec<String> {
    let mut joined = Vec::with_capacity(tokens.len());
    let mut at = 0;
    while at < tokens.len() {
        if let Some((token, length)) = distance_at(&tokens[at..]) {
            joined.push(token);
            at += length;
        } else {
            joined.push(tokens[at].clone());
            at += 1;
        }
    }
    joined
}

/// Returns the words of a joined distance: "within 1 m of". `None` for other tokens.
pub(super) fn joined_words(token: &str) -> Option<String> {
    let words = token.contains('_').then(|| token.replace('_', " "))?;
    Reach::in_words(&words).map(|_| words)
}

/// Reads a distance with what it is measured from, and its length in tokens.
fn distance_at(tokens: &[String]) -> Option<(String, usize)> {
    let words: Vec<&str> = tokens.iter().take(12).map(String::as_str).collect();
    let limit = LIMITS.iter().find(|(limit, _)| words.starts_with(limit));
    let (limit, start) = limit.map_or((Limit::About, 0), |(words, limit)| (*limit, words.len()));
    // "within about a meter of"
    let is_vague = matches!(words.get(start), Some(&("about" | "around" | "roughly")));
    let start = if is_vague { start + 1 } else { start };
    let (meters, length) = length_at(&words[start..])?;
    let end = start + length;
    let end = if words[end..].starts_with(&["or", "so"]) { end + 2 } else { end };
    let from = FROM.iter().find(|from| words[end..].starts_with(from))?;
    let word = match limit {
        Limit::Most => "within",
        Limit::Least => "beyond",
        Limit::About => "about",
    };
    // Spaces would separate it again.
    let meters = (meters * 1e3).round() / 1e3;
    Some((format!("{word} {meters} m of").replace(' ', "_"), end + from.len()))
}

/// Reads a length such as "1.5 m", "half a meter" or "50cm": meters, and its length in tokens.
pub(super) fn length_at(words: &[&str]) -> Option<(f32, usize)> {
    let first = *words.first()?;
    // "50cm"
    if let Some(split) = first.find(|c: char| c.is_alphabetic())
        && let (Ok(number), Some(unit)) = (first[..split].parse::<f32>(), unit(&first[split..]))
    {
        return Some((number * unit, 1));
    }
    let (number, length) = match words {
        ["half", "a", ..] => (0.5, 2),
        ["one", "and", "a", "half", ..] => (1.5, 4),
        ["a", "couple", "of", ..] => (2.0, 3),
        ["a" | "one", unit_word, "and", "a", "half", ..] => {
            return Some((1.5 * unit(unit_word)?, 5));
        }
        ["a" | "an" | "one", ..] => (1.0, 1),
        ["two", ..] => (2.0, 1),
        ["three", ..] => (3.0, 1),
        ["four", ..] => (4.0, 1),
        ["five", ..] => (5.0, 1),
        ["ten", ..] => (10.0, 1),
        [number, ..] => (number.parse().ok().filter(|n: &f32| n.is_finite() && *n >= 0.0)?, 1),
        [] => return None,
    };
    let unit = unit(words.get(length)?)?;
    Some((number * unit, length + 1))
}

/// A unit of length.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LengthUnit {
    /// 1000 m.
    Kilometers,
    /// 1 m.
    Meters,
    /// 0.01 m.
    Centimeters,
    /// 0.001 m.
    Millimeters,
    /// 0.9144 m.
    Yards,
    /// 0.3048 m.
    Feet,
    /// 0.0254 m.
    Inches,
}

impl LengthUnit {
    /// All seven values, to find one by its [`as_str`](Self::as_str).
    pub const ALL: [Self; 7] = [
        Self::Kilometers,
        Self::Meters,
        Self::Centimeters,
        Self::Millimeters,
        Self::Yards,
        Self::Feet,
        Self::Inches,
    ];

    /// Returns the unit that a word names.
    fn in_word(word: &str) -> Option<Self> {
        Some(match word {
            "km" | "kilometer" | "kilometers" | "kilometre" | "kilometres" => Self::Kilometers,
            "m" | "meter" | "meters" | "metre" | "metres" => Self::Meters,
            "cm" | "cms" | "centimeter" | "centimeters" | "centimetre" | "centimetres" => {
                Self::Centimeters
            }
            "mm" | "millimeter" | "millimeters" | "millimetre" | "millimetres" => Self::Millimeters,
            "ft" | "foot" | "feet" => Self::Feet,
            "inch" | "inches" => Self::Inches,
            "yard" | "yards" => Self::Yards,
            _ => return None,
        })
    }

    /// Returns its length in meters.
    #[must_use]
    pub fn meters(self) -> f32 {
        match self {
            Self::Kilometers => 1000.0,
            Self::Meters => 1.0,
            Self::Centimeters => 0.01,
            Self::Millimeters => 0.001,
            Self::Yards => 0.9144,
            Self::Feet => 0.3048,
            Self::Inches => 0.0254,
        }
    }

    /// Returns its name in data and in texts.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Kilometers => "km",
            Self::Meters => "m",
            Self::Centimeters => "cm",
            Self::Millimeters => "mm",
            Self::Yards => "yards",
            Self::Feet => "feet",
            Self::Inches => "inches",
        }
    }
}

/// Returns a unit of length in meters.
fn unit(word: &str) -> Option<f32> {
    LengthUnit::in_word(word).map(LengthUnit::meters)
}

/// Returns whether a word is a unit of length.
pub(super) fn is_unit(word: &str) -> bool {
    word != BREAK && unit(word).is_some()
}

/// Removes the unit that the answer has to use, and returns it: "how wide is the door in inches",
/// "how many inches wide is the door".
pub(super) fn take_unit(words: &mut Vec<&str>) -> Option<LengthUnit> {
    if let ["how", "many", unit, ..] = words[..] {
        return LengthUnit::in_word(unit);
    }
    let ends = |rest: &[&str]| {
        rest.first().is_none_or(|word| matches!(*word, BREAK | "is" | "are" | "of" | "from" | "to"))
    };
    (2..words.len()).find_map(|i| {
        let length = match words[i..] {
            ["square" | "cubic", ..] => 2,
            _ => 1,
        };
        let unit = LengthUnit::in_word(words.get(i + length - 1)?)?;
        if words[i - 1] != "in" || !ends(&words[i + length..]) {
            return None;
        }
        words.drain(i - 1..i + length);
        Some(unit)
    })
}

/// Returns the range that a joined token names, as its limits in meters.
pub(super) fn joined_reach(token: &str) -> Option<Reach> {
    joined_words(token).and_then(|words| Reach::in_words(&words))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::parse;
    use crate::tokens::tokenize;

    fn joined(words: &str) -> Vec<String> {
        join(tokenize(words))
    }

    #[test]
    fn distances_are_one_token_in_meters() {
        for (words, token) in [
            ("things within 1 m of the sofa", "within 1 m of"),
            ("things within one metre of the sofa", "within 1 m of"),
            ("things within 1,000 mm of the sofa", "within 1 m of"),
            ("things within 1,5 m of the sofa", "within 1.5 m of"),
            ("things less than 50cm from the sofa", "within 0.5 m of"),
            ("things no more than 1.5 meters away from the sofa", "within 1.5 m of"),
            ("the chair about 2 m from the door", "about 2 m of"),
            ("the chair two meters from the door", "about 2 m of"),
            ("chairs more than half a meter from the door", "beyond 0.5 m of"),
        ] {
            let has_it = joined(words).iter().any(|t| joined_words(t).as_deref() == Some(token));
            assert!(has_it, "{words}: {:?}", joined(words));
        }
        for words in ["the two chairs", "a chair by the door", "the 3 m table"] {
            assert!(joined(words).iter().all(|t| joined_words(t).is_none()), "{words}");
        }
    }

    #[test]
    fn reach_fits_within_its_range_and_fades_beyond() {
        let within = Reach::in_words("within 1 m of").unwrap();
        assert_eq!(within.fit(0.0), 1.0);
        assert_eq!(within.fit(1.0), 1.0);
        assert!((within.fit(1.075) - 0.5).abs() < 1e-3);
        assert_eq!(within.fit(1.2), 0.0);
        let beyond = Reach::in_words("beyond 2 m of").unwrap();
        assert_eq!((beyond.fit(3.0), beyond.fit(1.0)), (1.0, 0.0));
        assert_eq!(Reach::in_words("about 2 m of").unwrap().fit(2.4), 1.0);
        assert_eq!(Reach::in_words("next to"), None);
    }

    #[test]
    fn distances_are_relations_of_the_target() {
        let parsed = parse("all chairs within 1.5 m of the round table");
        let relation = &parsed.target.relations[0];
        assert_eq!(parsed.target.head, "chairs");
        assert_eq!(relation.anchors[0].head, "round table");
        assert_eq!(Reach::in_words(&relation.text).unwrap().most, 1.5);
        assert!(parsed.not_understood.is_empty(), "{parsed:?}");
    }
}
