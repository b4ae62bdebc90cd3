//! Scores how well instances fit what a phrase says about the target itself: noun x colors x
//! traits. Relations are scored by [`assess`](super::assess).

use super::SceneView;
use super::choose_level::keep_best_per_place;
use super::kinds::breadth;
use super::names::GivenName;
use super::readings::{Reading, Readings};
use super::solid::Solid;
use super::unfound_structure::fits_by_shape;
use std::collections::HashSet;
use uniground_geometry::color::{ColorName, srgb_to_lab};
use uniground_geometry::scene::{Instance, Level, Structure, Support};
use uniground_language::{Meaning, Phrase, Trait};
use uniground_models::attributes::{self, Noun, noun_fit};

/// Factor for a word that a name does not contain. A name seldom says everything.
const UNSAID: f32 = 0.8;
/// Weight of a color that the name gives against the measured one: a scan's light is seldom white.
const SEEN_COLOR: f32 = 0.67;
/// Factor where a name gives another color.
const NAMED_OTHERWISE: f32 = 0.25;
/// Factor for parts and wholes without a name. A room has some of any size, so where only measures
/// identify them, they are a last resort.
const GUESSED: f32 = 0.55;
/// Fit of "thing" and "one" to every instance.
const ANYTHING: f32 = 0.8;
/// Minimum meaningful fit by measures.
const LIKELY: f32 = 0.35;
/// Factor for the fits of other instances where some instance has the noun as its name.
const NOT_CALLED_SO: f32 = 0.85;
/// Fit from which an instance counts as named by the noun itself.
pub(super) const CALLED_SO: f32 = 0.95;
/// Smaller instances are seldom meant by "thing", meters.
const NOTABLE_M: f32 = 0.1;
/// Factor for a color that is not there at all. Not 0, because the scan's light may be odd.
const WRONG_COLOR: f32 = 0.02;
/// The same factor for an approximate color: people say "pinkish" of a brown chair.
const NEAR_COLOR: f32 = 0.3;
/// Words for wood, and the colors it mostly has.
const WOOD: [&str; 6] = ["wooden", "wood", "oak", "pine", "walnut", "timber"];
const WOODEN: [ColorName; 4] =
    [ColorName::Brown, ColorName::Orange, ColorName::Beige, ColorName::Yellow];
/// Factor for a wooden instance without any of these colors: it may be painted.
const PAINTED: f32 = 0.5;
/// An instance may be meant when its fit is at least this share of the best fit.
pub(super) const PLAUSIBLE: f32 = 0.3;
/// Factor for the fits of instances without a name of their own, where another instance has the noun
/// as its name. What only measures or looks alike does not beat it.
const ONLY_ALIKE: f32 = 0.5;
/// Share of an encoder's first guess from which it is the instance's name.
const HIGH_SHARE: f32 = 0.7;
/// Score of the first guess by measures from which a part or a whole has that name.
const NAMED_BY_MEASURES: f32 = 0.9;
/// Factor for a part or a whole that measures name so.
const NAMED_COMPOUND: f32 = 0.85;
/// Factor for an instance that a word describes which must not describe it.
const EXCLUDED: f32 = 0.05;
/// Factor for a wooden color where the question excludes wood.
const WOODEN_LOOK: f32 = 0.3;
/// An instance has the noun with at least this share of the best fit.
const HAS_NOUN: f32 = 0.7;
/// Largest color fit of an instance with another main color than the requested one, where another
/// instance has it.
const OTHER_MAIN_COLOR: f32 = 0.7;
/// Factor at the wrong end of a comparison: for the smallest instance when the phrase says "large".
const OPPOSITE_TRAIT: f32 = 0.3;

/// Returns the fit of every instance to a phrase's noun, or to another noun it may have, `0..=1`,
/// by index. Keeps one instance for each place.
#[must_use]
pub fn noun_fits(scene: SceneView, phrase: &Phrase) -> Vec<f32> {
    if !phrase.among.is_empty() {
        // An earlier answer has decided on these.
        return scene
            .instances
            .iter()
            .map(|instance| f32::from(u8::from(phrase.among.contains(&instance.id))))
            .collect();
    }
    let readings = Readings::of(phrase);
    let (mut fits, mut share) = (vec![0.0_f32; scene.instances.len()], 1.0);
    for Reading { weight, phrase, meaning } in readings.iter() {
        let mut read = fits_of_reading(scene, phrase, meaning);
        prefer_named(scene, meaning, &mut read);
        let is_there = read.iter().any(|fit| *fit >= CALLED_SO);
        fits.iter_mut().zip(read).for_each(|(best, fit)| *best = best.max(weight * share * fit));
        // The room has the noun that was said, so another noun is seldom meant.
        share = if is_there { NOT_CALLED_SO } else { share };
    }
    keep_best_per_place(scene.instances, &mut fits);
    let nouns: Vec<&Noun> = readings.iter().flat_map(Reading::nouns).copied().collect();
    if !nouns.is_empty() && scene.appearance.is_none() && phrase.uses.is_empty() {
        prefer_called_so(&nouns, scene.instances, &mut fits);
    }
    fits
}

fn fits_of_reading(scene: SceneView, phrase: &Phrase, meaning: &Meaning) -> Vec<f32> {
    let by_appearance = |word: &str, index: usize, measured| {
        scene.appearance.and_then(|appearance| appearance.fit(word, index, measured))
    };
    // Computed once for all instances: a purpose has dozens of nouns.
    let (breadths, names): (Vec<f32>, HashSet<&str>) = match meaning {
        Meaning::Nouns(nouns) => nouns
            .iter()
            .enumerate()
            .map(|(i, noun)| (breadth(phrase, noun, i), noun.name.as_str()))
            .unzip(),
        _ => Default::default(),
    };
    let by_shape = match meaning {
        Meaning::Structure(structure)
            if !scene.instances.iter().any(|i| i.structure == Some(*structure)) =>
        {
            Some(fits_by_shape(*structure, scene.instances))
        }
        _ => None,
    };
    let unnamed = |(index, instance): (usize, &Instance)| match meaning {
        // A word without measures: only the appearance decides.
        Meaning::Unknown if instance.structure.is_none() => {
            by_appearance(&phrase.head, index, None).unwrap_or(0.0)
        }
        Meaning::Unknown => 0.0,
        Meaning::Anything => {
            if instance.structure.is_none() {
                ANYTHING * notability(instance)
            } else {
                0.0
            }
        }
        Meaning::Instance(id) => f32::from(u8::from(instance.id == *id)),
        Meaning::Structure(structure) => match &by_shape {
            Some(fits) => fits[index],
            None => f32::from(u8::from(instance.structure == Some(*structure))),
        },
        // A wall may contain the window that the question uses as an anchor. Floors and ceilings
        // contain nothing.
        Meaning::Nouns(_)
            if matches!(instance.structure, Some(Structure::Floor | Structure::Ceiling)) =>
        {
            0.0
        }
        Meaning::Nouns(nouns) => {
            let (mut by_measure, mut by_looks) = (0.0_f32, None::<f32>);
            for (noun, breadth) in nouns.iter().zip(&breadths) {
                let measured = noun_fit(noun, instance);
                by_measure = by_measure.max(measured * breadth);
                by_looks = by_appearance(&noun.name, index, Some(measured))
                    .map(|fit| by_looks.map_or(fit * breadth, |best| best.max(fit * breadth)))
                    .or(by_looks);
            }
            // Appearance has been weighed against all other names already, measures have not.
            let is_named = instance.names.first().is_some_and(|guess| {
                guess.score >= NAMED_BY_MEASURES && names.contains(guess.name.as_str())
            });
            let guessed = match instance.level {
                Level::Thing => 1.0,
                _ if is_named => NAMED_COMPOUND,
                _ => GUESSED,
            };
            by_looks.unwrap_or_else(|| {
                guessed * by_measure * share_among_names(by_measure, &names, instance).sqrt()
            })
        }
    };
    let fit = |(index, instance): (usize, &Instance)| match (scene.names.get(index), meaning) {
        (Some(name), Meaning::Nouns(_) | Meaning::Unknown) => {
            name.fit(phrase, meaning) * unsaid_words_factor(name, phrase)
        }
        (Some(name), Meaning::Anything) if !name.is_thing() => 0.0,
        // Planes were measured; a name also covers stretches that were not.
        (Some(name), Meaning::Structure(_)) if by_shape.is_some() => name.fit(phrase, meaning),
        (Some(name), Meaning::Structure(_)) => {
            unnamed((index, instance)).max(name.fit(phrase, meaning))
        }
        _ => unnamed((index, instance)),
    };
    scene.instances.iter().enumerate().map(fit).collect()
}

/// Where some instance has the noun as its name, given or by an encoder with a high share, lowers
/// the fit of those that have no name and are only alike.
fn prefer_named(scene: SceneView, meaning: &Meaning, fits: &mut [f32]) {
    let Meaning::Nouns(nouns) = meaning else { return };
    let is_guessed_so = |instance: &Instance| {
        scene.appearance.is_some()
            && instance.names.first().is_some_and(|guess| {
                guess.score >= HIGH_SHARE && nouns.iter().any(|noun| noun.name == guess.name)
            })
    };
    let has_name = |i: usize| match scene.names.get(i) {
        Some(_) => fits[i] >= CALLED_SO,
        None => fits[i] >= LIKELY && is_guessed_so(&scene.instances[i]),
    };
    let named: Vec<bool> = (0..fits.len()).map(has_name).collect();
    if named.contains(&true) {
        let is_only_alike = |i: &usize| !named[*i] && scene.names.get(*i).is_none();
        (0..fits.len()).filter(is_only_alike).for_each(|i| fits[i] *= ONLY_ALIKE);
    }
}

/// Returns the factor for words such as "leather" or "kitchen" that a name does not contain.
fn unsaid_words_factor(name: &GivenName, phrase: &Phrase) -> f32 {
    phrase.unchecked.iter().map(|word| if name.has_word(word) { 1.0 } else { UNSAID }).product()
}

/// Returns how notable an instance is, by the second of its three sides. "What is on my right?"
/// asks for an object one would name, not for a speck or a sliver.
fn notability(instance: &Instance) -> f32 {
    let mut sides = instance.aabb.size;
    sides.as_mut_slice().sort_by(f32::total_cmp);
    (sides[1] / NOTABLE_M).clamp(0.3, 1.0)
}

/// Returns how likely an instance has one of `names` rather than one of its other guesses: a table
/// may have a sofa's size.
fn share_among_names(fit: f32, names: &HashSet<&str>, instance: &Instance) -> f32 {
    let (mut own, mut others) = (0.0, 0.0);
    for guess in &instance.names {
        if names.contains(guess.name.as_str()) { own += guess.score } else { others += guess.score }
    }
    let own = fit.max(own);
    if own > 0.0 { own / (own + others) } else { 0.0 }
}

/// Where some instance has the noun as its first guess, lowers the fit of all others.
fn prefer_called_so(nouns: &[&Noun], instances: &[Instance], fits: &mut [f32]) {
    let called = |i: &Instance| {
        i.structure.is_none()
            && i.names.first().is_some_and(|guess| nouns.iter().any(|noun| noun.name == guess.name))
    };
    if instances.iter().zip(&*fits).any(|(i, fit)| *fit >= LIKELY && called(i)) {
        instances
            .iter()
            .zip(fits)
            .filter(|(i, _)| !called(i))
            .for_each(|(_, fit)| *fit *= NOT_CALLED_SO);
    }
}

/// Returns the fit of the instance at an index to a phrase's colors, `0..=1`.
#[must_use]
pub fn colors_fit(scene: SceneView, phrase: &Phrase, index: usize) -> f32 {
    let instance = &scene.instances[index];
    let named = scene.names.get(index).map(GivenName::colors).filter(|named| !named.is_empty());
    let color_fit = |color: ColorName| {
        let measured = attributes::color_fit(color, instance);
        let Some(named) = named else { return measured };
        let seen = if named.contains(&color) { 1.0 } else { NAMED_OTHERWISE };
        measured + SEEN_COLOR * (seen - measured)
    };
    let least = if phrase.roughly { NEAR_COLOR } else { WRONG_COLOR };
    // Two colors share the surface: each has to be there, neither has to dominate.
    let n = phrase.colors.len().max(1) as f32;
    let wanted = phrase.colors.iter().map(|&c| (color_fit(c) * n.sqrt()).clamp(least, 1.0));
    let unwanted = phrase.other_than.iter().map(|&c| (1.0 - color_fit(c)).max(WRONG_COLOR));
    wanted.chain(unwanted).product::<f32>() * wooden_fit(scene, phrase, index)
}

/// Returns how well a color fits the instance at an index, by its name and its surface, `0..=1`.
pub(super) fn color_fit(scene: SceneView, color: ColorName, index: usize) -> f32 {
    let phrase = Phrase { colors: vec![color], ..Phrase::default() };
    colors_fit(scene, &phrase, index)
}

/// Returns the fit of the instance at an index to the words that must not describe it: "not wooden".
#[must_use]
pub fn excluded_words_fit(scene: SceneView, phrase: &Phrase, index: usize) -> f32 {
    let word_fit = |word: &String| {
        let name = scene.names.get(index);
        if name.is_some_and(|name| same_words(word).iter().any(|word| name.has_word(word))) {
            return EXCLUDED;
        }
        if WOOD.contains(&word.as_str()) {
            1.0 - (1.0 - WOODEN_LOOK) * wooden_look(scene, index)
        } else {
            1.0
        }
    };
    phrase.excluded.iter().map(word_fit).product()
}

/// Returns whether an excluded word can be checked: by the names of instances, or as wood by color.
#[must_use]
pub fn can_check_word(scene: SceneView, word: &str) -> bool {
    let is_said = |index: usize| {
        scene
            .names
            .get(index)
            .is_some_and(|name| same_words(word).iter().any(|word| name.has_word(word)))
    };
    WOOD.contains(&word) || (0..scene.instances.len()).any(is_said)
}

/// Returns the words that say the same of an instance: "wooden" and "wood".
fn same_words(word: &str) -> Vec<&str> {
    const SAME: [&[&str]; 3] =
        [&["metal", "metallic"], &["fabric", "cloth", "upholstered"], &["plastic", "acrylic"]];
    if WOOD.contains(&word) {
        return WOOD.to_vec();
    }
    let same = SAME.iter().find(|same| same.contains(&word));
    same.map_or_else(|| vec![word], |same| same.to_vec())
}

/// Returns the share of an instance's surface that has a color of wood, `0..=1`.
fn wooden_look(scene: SceneView, index: usize) -> f32 {
    let seen: f32 =
        WOODEN.iter().map(|&color| attributes::color_fit(color, &scene.instances[index])).sum();
    seen.min(1.0)
}

/// Where the requested color is the main color of some instance that has the noun, limits the fit
/// of those with another main color: "the grey armchair" is not the white one beside a grey one.
pub fn prefer_main_color(scene: SceneView, phrase: &Phrase, nouns: &[f32], own: &mut [f32]) {
    let [color] = phrase.colors[..] else { return };
    if phrase.roughly {
        return;
    }
    let is_main = |i: usize| match scene.names.get(i).map(GivenName::colors) {
        Some(named) if !named.is_empty() => named.contains(&color),
        _ => scene.instances[i].colors.dominant().first().is_some_and(|(main, _)| *main == color),
    };
    let best = nouns.iter().copied().fold(0.0, f32::max);
    let likely = |i: usize| nouns[i] > 0.0 && nouns[i] >= HAS_NOUN * best;
    if (0..nouns.len()).any(|i| likely(i) && is_main(i)) {
        for (i, fit) in own.iter_mut().enumerate() {
            if !is_main(i) {
                *fit = fit.min(OTHER_MAIN_COLOR * nouns[i]);
            }
        }
    }
}

/// Returns how well the color of the instance at an index matches wood, where a phrase says wood
/// and no color; 1 where a name says wood too.
fn wooden_fit(scene: SceneView, phrase: &Phrase, index: usize) -> f32 {
    let is_said = phrase.unchecked.iter().any(|word| WOOD.contains(&word.as_str()));
    let is_named =
        || scene.names.get(index).is_some_and(|name| WOOD.iter().any(|word| name.has_word(word)));
    if !is_said || !phrase.colors.is_empty() || is_named() {
        return 1.0;
    }
    PAINTED + (1.0 - PAINTED) * wooden_look(scene, index)
}

/// Returns the fit of every instance to a trait, `0..=1`. "Large" and "dark" compare it with the
/// other instances the noun may mean; "round" depends on its box alone.
#[must_use]
pub fn trait_fits(
    instances: &[Instance],
    solids: &[Solid],
    nouns: &[f32],
    asked: Trait,
) -> Vec<f32> {
    let squareness = |solid: &Solid| solid.sides().1 / solid.sides().0.max(1e-3);
    let lightness = |i: usize| srgb_to_lab(instances[i].mean_rgb).x;
    // For pictures and shelves on a wall "the high one" means the one that hangs high; for
    // instances on the floor it means the tall one.
    let hanging = |i: usize| matches!(instances[i].support, Support::Wall { .. });
    let off_the_floor = (0..nouns.len()).filter(|&i| nouns[i] >= PLAUSIBLE).all(hanging);
    let height = |i: usize| if off_the_floor { solids[i].top } else { solids[i].size[2] };
    let measure = |i: usize| match asked {
        Trait::Large => solids[i].volume(),
        Trait::Small => -solids[i].volume(),
        Trait::Tall => height(i),
        Trait::Low => -height(i),
        Trait::Long => solids[i].sides().0,
        Trait::Light => lightness(i),
        Trait::Dark => -lightness(i),
        Trait::Round | Trait::Square | Trait::Rectangular => 0.0,
    };
    match asked {
        Trait::Round | Trait::Square => {
            return solids
                .iter()
                .map(|s| OPPOSITE_TRAIT.max(((squareness(s) - 0.5) / 0.35).min(1.0)))
                .collect();
        }
        Trait::Rectangular => {
            return solids
                .iter()
                .map(|s| OPPOSITE_TRAIT.max(((1.0 - squareness(s)) / 0.25).min(1.0)))
                .collect();
        }
        _ => {}
    }
    // Of two sofas of nearly one size both are large: 0 at half as large, 1 at nine tenths. Does
    // not apply to lightness.
    let nearly = |measured: f32, utmost: f32| match asked {
        Trait::Light | Trait::Dark => 0.0,
        _ => {
            let ratio =
                if utmost > 0.0 { measured / utmost } else { utmost / measured.min(-f32::EPSILON) };
            ((ratio - 0.5) / 0.4).clamp(0.0, 1.0)
        }
    };
    let best = nouns.iter().copied().fold(0.0, f32::max);
    let mut rivals: Vec<f32> = (0..nouns.len())
        .filter(|&i| best > 0.0 && nouns[i] >= PLAUSIBLE * best)
        .map(measure)
        .collect();
    rivals.sort_by(f32::total_cmp);
    let place = |i: usize| {
        if rivals.len() < 2 {
            return 1.0;
        }
        let smaller = rivals.partition_point(|r| *r < measure(i)).min(rivals.len() - 1);
        let by_rank = smaller as f32 / (rivals.len() - 1) as f32;
        OPPOSITE_TRAIT
            + (1.0 - OPPOSITE_TRAIT) * by_rank.max(nearly(measure(i), rivals[rivals.len() - 1]))
    };
    (0..nouns.len()).map(place).collect()
}

/// Returns indices that may be meant, with their fit: the best `limit` of those above
/// [`PLAUSIBLE`], in order of index.
pub(super) fn most_plausible(fits: &[f32], limit: usize) -> Vec<(usize, f32)> {
    let best = fits.iter().copied().fold(0.0, f32::max);
    let mut plausible: Vec<(usize, f32)> = fits
        .iter()
        .copied()
        .enumerate()
        .filter(|&(_, fit)| fit > 0.0 && fit >= PLAUSIBLE * best)
        .collect();
    if plausible.len() > limit {
        plausible.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(&b.0)));
        plausible.truncate(limit);
        plausible.sort_by_key(|&(i, _)| i);
    }
    plausible
}

#[cfg(test)]
mod tests;
