//! Names, places and numbers in plain sentences.

use crate::answer::describe_instance;
use crate::assess::Assessor;
use crate::solid::Solid;
use uniground_geometry::scene::{Instance, Support};
use uniground_language::{Aspect, LengthUnit, Phrase};
use uniground_models::attributes::{Lexicon, Noun};

/// Objects at most this far away tell where another one is, meters.
const NEXT_TO_M: f32 = 0.6;
/// Colors with at least this share of an object are told.
const LEAST_COLOR: f32 = 0.15;
/// Maximum number of colors in a description.
const MOST_COLORS: usize = 3;
/// Maximum number of other names in a description.
const MOST_NAMES: usize = 3;
/// Maximum number of objects on another one that are named.
const MOST_CARRIED: usize = 8;

/// Names of instances in sentences.
#[derive(Clone, Copy)]
pub(super) struct Names<'a> {
    pub instances: &'a [Instance],
}

impl Names<'_> {
    /// "the red mug"
    pub fn the(&self, index: usize) -> String {
        format!("the {}", describe_instance(&self.instances[index]))
    }

    /// "a red mug"
    pub fn a(&self, index: usize) -> String {
        with_article(&describe_instance(&self.instances[index]))
    }

    /// Replaces the ids of a question by names: "next to the #12".
    pub fn in_place_of_ids(&self, text: &str) -> String {
        if !text.contains('#') {
            return text.to_owned();
        }
        let mut words: Vec<String> = Vec::new();
        for word in text.split(' ') {
            let bare = word.trim_end_matches(|c: char| !c.is_ascii_digit());
            let index = bare
                .strip_prefix('#')
                .and_then(|id| id.parse::<usize>().ok())
                .and_then(|id| id.checked_sub(1))
                .filter(|index| *index < self.instances.len());
            match index {
                Some(index) => {
                    words.pop_if(|before| before.eq_ignore_ascii_case("the"));
                    words.push(format!("{}{}", self.the(index), &word[bare.len()..]));
                }
                None => words.push(word.to_owned()),
            }
        }
        words.join(" ")
    }

    /// Returns where an instance is: "on the coffee table, next to the blue mug". `None` where
    /// nothing tells it.
    pub fn place(&self, assessor: &Assessor, index: usize) -> Option<String> {
        let instance = &self.instances[index];
        if instance.structure.is_some() {
            return None;
        }
        let at = |id: uniground_geometry::scene::InstanceId| id.0 as usize - 1;
        // A window does not stand on the plant below it.
        let is_of_wall =
            Lexicon::get().find(instance.label()).is_some_and(Noun::can_be_part_of_wall);
        let on = match instance.support {
            Support::Instance { .. } if is_of_wall => None,
            Support::Floor => Some("on the floor".to_owned()),
            Support::Instance { id } if at(id) < self.instances.len() => {
                let (holder, held) = (&assessor.solids[at(id)], &assessor.solids[index]);
                let is_in = crate::relations::inside(held, holder) > 0.5
                    && crate::relations::on(held, holder) < 0.5;
                Some(format!("{} {}", if is_in { "in" } else { "on" }, self.the(at(id))))
            }
            Support::Wall { id } if at(id) < self.instances.len() => {
                Some(format!("on {}", self.the(at(id))))
            }
            _ => None,
        };
        let holder = match instance.support {
            Support::Instance { id } | Support::Wall { id } => Some(at(id)),
            _ => None,
        };
        let neighbor = self.neighbor(assessor, index, holder);
        let beside = neighbor.map(|(other, gap)| {
            let touching = if gap < 0.1 { "right next to" } else { "next to" };
            format!("{touching} {}", self.the(other))
        });
        match (on, beside) {
            (None, None) => None,
            (Some(place), None) | (None, Some(place)) => Some(place),
            (Some(on), Some(beside)) => Some(format!("{on}, {beside}")),
        }
    }

    /// Returns the nearest object beside an instance that says where it is: not smaller than half of
    /// it, and neither on it nor under it.
    fn neighbor(
        &self,
        assessor: &Assessor,
        index: usize,
        holder: Option<usize>,
    ) -> Option<(usize, f32)> {
        let own = &assessor.solids[index];
        let is_landmark = |i: usize| {
            let other = &self.instances[i];
            let solid = &assessor.solids[i];
            i != index
                && Some(i) != holder
                && other.is_shown()
                && other.structure.is_none()
                && other.label() != "object"
                && solid.diagonal() >= 0.5 * own.diagonal()
                && solid.footprint_overlap(own) < 0.3
                && own.footprint_overlap(solid) < 0.3
        };
        (0..self.instances.len())
            .filter(|&i| is_landmark(i))
            .map(|i| (i, own.gap(&assessor.solids[i])))
            .filter(|(_, gap)| *gap <= NEXT_TO_M)
            .min_by(|a, b| a.1.total_cmp(&b.1).then(a.0.cmp(&b.0)))
    }
}

/// Returns a phrase as people say it: "sofa that is not brown".
pub(super) fn spoken(phrase: &Phrase) -> String {
    let plain = Phrase { other_than: Vec::new(), excluded: Vec::new(), ..phrase.clone() }.text();
    let colors = phrase.other_than.iter().map(|color| color.as_str());
    let without: Vec<&str> = colors.chain(phrase.excluded.iter().map(String::as_str)).collect();
    if without.is_empty() {
        return plain;
    }
    let be = be(&plain);
    format!("{plain} that {be} not {}", alternatives(&without))
}

/// Describes an instance.
pub(super) fn description(
    assessor: &Assessor,
    aspect: Aspect,
    index: usize,
    called: &str,
) -> String {
    let instances = assessor.scene.instances;
    let instance = &instances[index];
    let names = Names { instances };
    let colors: Vec<&str> = instance
        .colors
        .dominant()
        .iter()
        .filter(|(_, share)| *share >= LEAST_COLOR)
        .take(MOST_COLORS)
        .map(|(color, _)| color.as_str())
        .collect();
    let colors = if colors.is_empty() { "of no clear color".to_owned() } else { joined(&colors) };
    let called = capitalized(called);
    match aspect {
        Aspect::Color => format!("{called} {} {colors}.", be(&called)),
        Aspect::Material => {
            let be = be(&called);
            format!("A scan does not show what things are made of. {called} {be} {colors}.")
        }
        Aspect::All => {
            let mut text =
                format!("{}, {}", capitalized(&names.a(index)), size(&assessor.solids[index]));
            if let Some(place) = names.place(assessor, index) {
                text = format!("{text}, {place}");
            }
            text.push('.');
            if instance.structure.is_none() {
                text = format!("{text} It is {colors}.");
            }
            let on_it: Vec<String> = (0..instances.len())
                .filter(|&i| instances[i].is_shown())
                .filter(|&i| instances[i].support == Support::Instance { id: instance.id })
                .map(|i| names.a(i))
                .collect();
            if !on_it.is_empty() {
                let more = on_it.len().saturating_sub(MOST_CARRIED);
                let mut named: Vec<String> = on_it.into_iter().take(MOST_CARRIED).collect();
                named.extend((more > 0).then(|| format!("{more} more")));
                text = format!("{text} On or in it: {}.", joined(&named));
            }
            let others: Vec<String> = instance
                .names
                .iter()
                .map(|guess| guess.name.as_str())
                .filter(|name| *name != instance.label())
                .take(MOST_NAMES)
                .map(with_article)
                .collect();
            if instance.given_name.is_none() && !others.is_empty() {
                text = format!("{text} It may also be {}.", alternatives(&others));
            }
            text
        }
    }
}

/// "0.85 m wide, 0.40 m deep and 1.20 m high"
pub(super) fn size(solid: &Solid) -> String {
    let (long, short) = solid.sides();
    format!("{} wide, {} deep and {} high", meters(long), meters(short), meters(solid.size[2]))
}

/// Returns a length in a unit, or in meters or centimeters: "18.5 inches".
pub(super) fn in_unit(length: f32, unit: Option<LengthUnit>) -> String {
    let Some(unit) = unit else { return meters(length) };
    let number = length / unit.meters();
    let digits = match unit {
        LengthUnit::Millimeters | LengthUnit::Centimeters => 0,
        LengthUnit::Inches | LengthUnit::Feet => 1,
        LengthUnit::Meters | LengthUnit::Yards => 2,
        LengthUnit::Kilometers => 4,
    };
    format!("{number:.digits$} {}", unit.as_str())
}

/// "45 cm", "1.83 m"
pub(super) fn meters(length: f32) -> String {
    if length < 0.995 { format!("{:.0} cm", 100.0 * length) } else { format!("{length:.2} m") }
}

/// Returns whether a name is a plural: "red shoes".
fn is_plural(name: &str) -> bool {
    const ALWAYS: [&str; 9] = [
        "clothes",
        "scissors",
        "glasses",
        "headphones",
        "shoes",
        "sneakers",
        "slippers",
        "flowers",
        "curtains",
    ];
    let last = name.rsplit(' ').next().unwrap_or(name);
    ALWAYS.contains(&last) || Lexicon::get().is_plural(last)
}

/// "is" or "are", by the name before it.
pub(super) fn be(name: &str) -> &'static str {
    if is_plural(name) { "are" } else { "is" }
}

/// Returns the two parts of what is named by its purpose: "red " and "to sit on" of "red something
/// to sit on".
fn purpose(name: &str) -> Option<(&str, &str)> {
    let (described, purpose) = name.split_once("something ")?;
    purpose.starts_with("to ").then_some((described, purpose))
}

/// "no mug", "nothing red to sit on"
pub(super) fn none_of(name: &str) -> String {
    match purpose(name) {
        Some((described, purpose)) => format!("nothing {described}{purpose}"),
        None => format!("no {name}"),
    }
}

/// "a mug", "an orange mug", "red shoes", "something red to sit on"
pub(super) fn with_article(name: &str) -> String {
    if let Some((described, purpose)) = purpose(name) {
        return format!("something {described}{purpose}");
    }
    if is_plural(name) {
        return name.to_owned();
    }
    let is_vowel = name.starts_with(['a', 'e', 'i', 'o', 'u']);
    let is_you = ["uni", "use", "ute", "usb"].iter().any(|start| name.starts_with(start));
    let article = if is_vowel && !is_you { "an" } else { "a" };
    format!("{article} {name}")
}

/// "red, blue and green"
pub(super) fn joined(words: &[impl AsRef<str>]) -> String {
    join(words, "and")
}

/// "a mug, a cup or a vase"
pub(super) fn alternatives(words: &[impl AsRef<str>]) -> String {
    join(words, "or")
}

fn join(words: &[impl AsRef<str>], last: &str) -> String {
    match words {
        [] => String::new(),
        [only] => only.as_ref().to_owned(),
        [first @ .., end] => {
            let first: Vec<&str> = first.iter().map(AsRef::as_ref).collect();
            format!("{} {last} {}", first.join(", "), end.as_ref())
        }
    }
}

/// Returns text that begins with a capital letter.
pub(super) fn capitalized(text: &str) -> String {
    let mut characters = text.chars();
    characters
        .next()
        .map_or_else(String::new, |first| first.to_uppercase().chain(characters).collect())
}
