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
mod tests {
    use super::*;
    use crate::NameIndex;
    use proptest::prelude::*;
    use uniground_geometry::boxes::Aabb;
    use uniground_geometry::color::ColorHistogram;
    use uniground_geometry::scene::{InstanceId, NameGuess};
    use uniground_geometry::{Point3, Vector3};
    use uniground_models::attributes::Lexicon;
    use uniground_testing::thing;

    /// Returns an unnamed box on the floor.
    fn sized(id: u32, size: [f32; 3]) -> Instance {
        thing(id, [id as f32 * 3.0, 0.0], size, 0.0, Support::Floor, [90; 3])
    }

    fn named(id: u32, name: &str) -> Instance {
        Instance { given_name: Some(name.into()), ..sized(id, [0.5; 3]) }
    }

    /// Returns a box of the size of a chair.
    fn chair(id: u32) -> Instance {
        sized(id, [0.5, 0.5, 0.9])
    }

    /// Returns a box of the size of a stool.
    fn stool(id: u32) -> Instance {
        sized(id, [0.38, 0.38, 0.5])
    }

    fn guessed(instance: Instance, names: &[(&str, f32)]) -> Instance {
        let guess = |&(name, score): &(&str, f32)| NameGuess { name: name.to_owned(), score };
        Instance { names: names.iter().map(guess).collect(), ..instance }
    }

    fn colored(instance: Instance, shares: &[(ColorName, f32)]) -> Instance {
        let mut all = [0.0; 12];
        shares.iter().for_each(|&(name, share)| all[name as usize] = share);
        Instance { colors: ColorHistogram(all), ..instance }
    }

    fn with_scene<T>(instances: &[Instance], of: impl FnOnce(SceneView) -> T) -> T {
        let names = NameIndex::of(instances);
        let extent = Aabb { center: Point3::origin(), size: Vector3::repeat(9.0) };
        of(SceneView { instances, extent, names: &names, appearance: None })
    }

    fn noun_phrase(head: &str) -> Phrase {
        Phrase { head: head.into(), ..Phrase::default() }
    }

    fn reading_fits(instances: &[Instance], phrase: &Phrase) -> Vec<f32> {
        with_scene(instances, |scene| fits_of_reading(scene, phrase, &phrase.meaning()))
    }

    #[track_caller]
    fn assert_close(found: &[f32], by_hand: &[f32]) {
        let same = found.len() == by_hand.len()
            && found.iter().zip(by_hand).all(|(a, b)| (a - b).abs() < 1e-4);
        assert!(same, "{found:?}, expected {by_hand:?}");
    }

    #[test]
    fn anything_prefers_notable_instances_over_specks_and_structure() {
        let wall = Instance { structure: Some(Structure::Wall), ..sized(5, [3.0, 0.1, 2.5]) };
        let room = [
            sized(1, [0.05, 0.2, 0.3]),
            sized(2, [0.05, 0.3, 0.02]), // its second side: 0.05 / 0.1
            sized(3, [0.01, 0.01, 0.3]), // 0.1, and no less than 0.3
            sized(4, [0.3, 0.1, 0.1]),
            wall,
        ];
        assert_close(&reading_fits(&room, &noun_phrase("thing")), &[0.8, 0.4, 0.24, 0.8, 0.0]);
        // A name such as "not a thing" takes precedence.
        let room = [named(1, "not a thing"), named(2, "red chair"), named(3, "beige wall section")];
        assert_close(&reading_fits(&room, &noun_phrase("thing")), &[0.0, 0.8, 0.0]);
    }

    #[test]
    fn structure_is_recognized_by_measurement_or_name() {
        let wall = |id, structure| Instance { structure, ..sized(id, [3.0, 0.1, 2.5]) };
        let room = [
            wall(1, Some(Structure::Wall)),
            wall(2, Some(Structure::Floor)),
            wall(3, None),
            named(4, "beige wall section"),
            named(5, "chair"),
            Instance { given_name: Some("chair".into()), ..wall(6, Some(Structure::Wall)) },
        ];
        assert_close(&reading_fits(&room, &noun_phrase("wall")), &[1.0, 0.0, 0.0, 1.0, 0.0, 1.0]);
        assert_close(&reading_fits(&room, &noun_phrase("floor")), &[0.0, 1.0, 0.0, 0.0, 0.0, 0.0]);
    }

    #[test]
    fn floors_and_ceilings_fit_only_words_for_them() {
        for structure in [Structure::Floor, Structure::Ceiling] {
            let room = [
                Instance { structure: Some(structure), ..sized(1, [2.0, 1.4, 0.02]) },
                named(2, "rug"),
            ];
            assert_close(&reading_fits(&room, &noun_phrase("rug")), &[0.0, 1.0]);
        }
    }

    #[test]
    fn what_only_measures_alike_does_not_beat_a_name() {
        let chairs =
            [chair(1), Instance { given_name: Some("chair".into()), ..sized(2, [0.1; 3]) }];
        let alone = with_scene(&chairs[..1], |scene| noun_fits(scene, &noun_phrase("chair")))[0];
        let fits = with_scene(&chairs, |scene| noun_fits(scene, &noun_phrase("chair")));
        assert!(alone > 0.7 && (fits[0] - ONLY_ALIKE * alone).abs() < 0.2 * alone, "{fits:?}");
        assert_close(&fits[1..], &[1.0]);
        // A broader name is none.
        let seats = [stool(1), Instance { given_name: Some("stool".into()), ..sized(2, [0.1; 3]) }];
        let fits = with_scene(&seats, |scene| noun_fits(scene, &noun_phrase("bar stool")));
        let alone = with_scene(&seats[..1], |scene| noun_fits(scene, &noun_phrase("bar stool")));
        assert_close(&fits[..1], &alone);
    }

    #[test]
    fn a_whole_answers_to_its_own_name() {
        let whole = |score| Instance {
            level: Level::Whole,
            things: vec![InstanceId(1)],
            ..guessed(chair(2), &[("chair", score), ("stool", 0.1)])
        };
        let part = guessed(sized(1, [0.45, 0.45, 0.1]), &[("cushion", 0.8), ("box", 0.5)]);
        let fits = |score| {
            let room = [part.clone(), whole(score)];
            with_scene(&room, |scene| noun_fits(scene, &noun_phrase("chair")))
        };
        let (sure, guess) = (fits(0.95), fits(0.6));
        assert!(sure[0] == 0.0 && sure[1] > 1.3 * guess[1], "{sure:?} {guess:?}");
    }

    #[test]
    fn instances_of_an_earlier_answer_are_the_only_ones() {
        let room = [named(1, "mug"), named(2, "mug"), named(3, "lamp")];
        let asked = Phrase { among: vec![InstanceId(2), InstanceId(3)], ..noun_phrase("mugs") };
        let fits = with_scene(&room, |scene| noun_fits(scene, &asked));
        assert_close(&fits, &[0.0, 1.0, 1.0]);
    }

    #[test]
    fn unknown_nouns_match_only_given_names() {
        let room = [named(1, "old zorblax"), named(2, "chair"), chair(3)];
        let asked = noun_phrase("zorblax");
        assert_eq!(asked.meaning(), Meaning::Unknown);
        let found = reading_fits(&room, &asked);
        assert!(found[0] > 0.8 && found[1..] == [0.0, 0.0], "{found:?}");
    }

    #[test]
    fn measured_fit_is_the_best_over_the_noun_meanings() {
        let asked = noun_phrase("chair");
        let Meaning::Nouns(nouns) = asked.meaning() else { panic!("a chair is a noun") };
        for instance in [chair(1), stool(1), sized(1, [0.65, 0.6, 1.0])] {
            let best = nouns
                .iter()
                .enumerate()
                .map(|(i, noun)| noun_fit(noun, &instance) * breadth(&asked, noun, i))
                .fold(0.0, f32::max);
            assert!(best > 0.05, "{:?}: {best}", instance.aabb.size);
            assert_close(&reading_fits(std::slice::from_ref(&instance), &asked), &[best]);
            // A part or a whole is a guess.
            let part = Instance { level: Level::Part, ..instance };
            assert_close(&reading_fits(&[part], &asked), &[0.55 * best]);
        }
    }

    #[test]
    fn competing_name_guesses_scale_the_fit_by_the_root_of_its_share() {
        let own = noun_fit(Lexicon::get().find("chair").unwrap(), &chair(1));
        assert!(own > 0.7, "{own}");
        let guesses = guessed(chair(1), &[("chair", 0.2), ("suitcase", 0.5), ("crate", 0.1)]);
        // Its own fit is more than the guess of 0.2.
        assert_close(
            &reading_fits(&[guesses], &noun_phrase("chair")),
            &[own * (own / (own + 0.6)).sqrt()],
        );
    }

    #[test]
    fn share_among_names_is_the_share_of_requested_names() {
        let names = HashSet::from(["chair", "armchair"]);
        let guesses = [("chair", 0.2), ("stool", 0.6), ("armchair", 0.1)];
        let instance = guessed(chair(1), &guesses);
        assert_close(&[share_among_names(0.1, &names, &instance)], &[0.3 / 0.9]);
        assert_close(&[share_among_names(0.3, &names, &instance)], &[0.3 / 0.9]);
        assert_close(&[share_among_names(0.6, &names, &instance)], &[0.6 / 1.2]);
        assert_eq!(share_among_names(0.0, &HashSet::new(), &instance), 0.0);
        assert_eq!(share_among_names(0.0, &names, &chair(1)), 0.0, "no guesses");
        assert_eq!(share_among_names(0.4, &names, &chair(1)), 1.0);
    }

    #[test]
    fn each_missing_word_in_a_name_keeps_eighty_percent() {
        let room = [named(1, "brown leather chair"), named(2, "chair"), named(3, "striped chair")];
        let asked = |words: &[&str]| Phrase {
            unchecked: words.iter().map(|word| (*word).to_owned()).collect(),
            ..noun_phrase("chair")
        };
        assert_close(&reading_fits(&room, &asked(&[])), &[1.0, 1.0, 1.0]);
        assert_close(&reading_fits(&room, &asked(&["leather"])), &[1.0, 0.8, 0.8]);
        assert_close(&reading_fits(&room, &asked(&["leather", "striped"])), &[0.8, 0.64, 0.8]);
    }

    #[test]
    fn later_nouns_of_a_phrase_weigh_less() {
        let asked = |head: &str, could_be: &[&str]| Phrase {
            could_be: could_be.iter().map(|noun| (*noun).to_owned()).collect(),
            ..noun_phrase(head)
        };
        let fits =
            |room: &[Instance], phrase: &Phrase| with_scene(room, |scene| noun_fits(scene, phrase));
        let piano = asked("piano", &["kettle", "sofa"]);
        // 0.95, and 0.95² after it.
        assert_close(&fits(&[named(1, "sofa")], &piano), &[0.902_5]);
        assert_close(&fits(&[named(1, "kettle")], &piano), &[0.95]);
        // The room has a piano: the others keep 0.85, applied only once.
        let room = [named(1, "piano"), named(2, "kettle"), named(3, "sofa")];
        assert_close(&fits(&room, &piano), &[1.0, 0.807_5, 0.767_125]);
        // A kettle without a piano keeps its own weight.
        assert_close(&fits(&room[1..2], &piano), &[0.95]);
        let room = [named(1, "kettle"), named(2, "sofa")];
        assert_close(&fits(&room, &piano), &[0.95, 0.767_125]);
        // "Couch" is a synonym of sofa, 0.95, and counts as its name.
        let room = [named(1, "sofa"), named(2, "kettle")];
        assert_close(&fits(&room, &asked("couch", &["kettle"])), &[0.95, 0.807_5]);
    }

    #[test]
    fn instances_named_by_the_noun_rank_before_possible_ones() {
        let nouns = [Lexicon::get().find("chair").unwrap()];
        let first = |mut room: [Instance; 2], fits: [f32; 2], structure| {
            room[0].structure = structure;
            let mut fits = fits;
            prefer_called_so(&nouns, &room, &mut fits);
            fits
        };
        let room = || {
            let other = guessed(stool(2), &[("stool", 0.8), ("chair", 0.7)]);
            [guessed(chair(1), &[("chair", 0.8), ("stool", 0.1)]), other]
        };
        assert_close(&first(room(), [0.9, 0.8], None), &[0.9, 0.68]);
        // A fit of 0.35 counts, a lower one does not.
        assert_close(&first(room(), [0.35, 0.8], None), &[0.35, 0.68]);
        assert_close(&first(room(), [0.349, 0.8], None), &[0.349, 0.8]);
        // Structure does not count as named.
        assert_close(&first(room(), [0.9, 0.8], Some(Structure::Wall)), &[0.9, 0.8]);
        let mut unnamed = room();
        unnamed[0].names.clear();
        assert_close(&first(unnamed, [0.9, 0.8], None), &[0.9, 0.8]);
    }

    #[test]
    fn purposes_do_not_prefer_named_instances() {
        let room = [guessed(chair(1), &[("chair", 0.9)]), stool(2)];
        let fits = |phrase: &Phrase| with_scene(&room, |scene| noun_fits(scene, phrase));
        let asked = noun_phrase("chair");
        let read_as = reading_fits(&room, &asked);
        assert_close(&fits(&asked), &[read_as[0], 0.85 * read_as[1]]);
        assert!(read_as[1] > 0.0, "{read_as:?}");
        let to_sit_on = Phrase { uses: vec!["sit on".into()], ..Phrase::default() };
        let read_as = reading_fits(&room, &to_sit_on);
        assert!(read_as.iter().all(|fit| *fit > 0.3), "{read_as:?}");
        assert_close(&fits(&to_sit_on), &read_as);
    }

    #[test]
    fn dismissed_instances_score_zero() {
        let room = [named(1, "chair"), Instance { dismissed: true, ..named(2, "chair") }];
        assert_close(
            &with_scene(&room, |scene| noun_fits(scene, &noun_phrase("chair"))),
            &[1.0, 0.0],
        );
    }

    fn color_of(instance: &Instance, phrase: &Phrase) -> f32 {
        with_scene(std::slice::from_ref(instance), |scene| colors_fit(scene, phrase, 0))
    }

    fn in_color(colors: &[ColorName], other_than: &[ColorName]) -> Phrase {
        let (colors, other_than) = (colors.to_vec(), other_than.to_vec());
        Phrase { colors, other_than, ..noun_phrase("chair") }
    }

    #[test]
    fn color_fit_follows_the_color_share() {
        use ColorName::{Blue, Green, Red};
        // A share of 60 % counts fully: 0.3 / 0.6.
        let half_red = colored(chair(1), &[(Red, 0.3), (Green, 0.7)]);
        let cases: [(&[ColorName], &[ColorName], f32); 9] = [
            (&[], &[], 1.0),
            (&[Green], &[], 1.0),
            (&[Red], &[], 0.5),
            (&[Blue], &[], 0.02),
            // Two share the surface: 0.5 · √2, and 1.
            (&[Red, Green], &[], std::f32::consts::FRAC_1_SQRT_2),
            (&[], &[Red], 0.5),
            (&[], &[Green], 0.02),
            (&[], &[Blue], 1.0),
            (&[Green], &[Red], 0.5),
        ];
        for (colors, other_than, by_hand) in cases {
            let found = color_of(&half_red, &in_color(colors, other_than));
            assert!(
                (found - by_hand).abs() < 1e-4,
                "{colors:?} not {other_than:?}: {found}, expected {by_hand}"
            );
        }
        // "Bluish" keeps more where the color is absent, and changes nothing where it is present.
        let roughly = |color| Phrase { roughly: true, ..in_color(&[color], &[]) };
        assert_close(&[color_of(&half_red, &roughly(Blue))], &[0.3]);
        assert_close(&[color_of(&half_red, &roughly(Red))], &[0.5]);
    }

    #[test]
    fn color_in_a_given_name_weighs_two_thirds() {
        use ColorName::{Green, Red};
        let half_red = |name: &str| colored(named(1, name), &[(Red, 0.3), (Green, 0.7)]);
        let red = in_color(&[Red], &[]);
        // 0.5 + 0.67 · (1 - 0.5), and 0.5 + 0.67 · (0.25 - 0.5).
        assert_close(&[color_of(&half_red("red chair"), &red)], &[0.835]);
        assert_close(&[color_of(&half_red("blue chair"), &red)], &[0.332_5]);
        // A name without a color changes nothing.
        assert_close(&[color_of(&half_red("chair"), &red)], &[0.5]);
        assert_close(&[color_of(&half_red("red chair"), &in_color(&[], &[Red]))], &[0.165]);
    }

    #[test]
    fn wooden_instances_without_a_wood_color_keep_half() {
        use ColorName::{Brown, Green};
        let wooden = |word: &str, colors: &[ColorName]| Phrase {
            unchecked: vec![word.into()],
            ..in_color(colors, &[])
        };
        let green = colored(chair(1), &[(Green, 1.0)]);
        assert_close(&[color_of(&green, &wooden("wooden", &[]))], &[0.5]);
        assert_close(&[color_of(&green, &wooden("oak", &[]))], &[0.5]);
        assert_close(&[color_of(&green, &wooden("leather", &[]))], &[1.0]);
        // A stated color counts instead.
        assert_close(&[color_of(&green, &wooden("wooden", &[Green]))], &[1.0]);
        assert_close(
            &[color_of(&colored(chair(1), &[(Brown, 1.0)]), &wooden("wooden", &[]))],
            &[1.0],
        );
        // 0.15 brown: brown by 0.25, orange and beige by half of 0.15 each; 0.5 + 0.5 · 0.4.
        let hardly = colored(chair(1), &[(Brown, 0.15), (Green, 0.85)]);
        assert_close(&[color_of(&hardly, &wooden("wooden", &[]))], &[0.7]);
        // A name that says wood is enough.
        for (name, by_hand) in [("wooden chair", 1.0), ("oak chair", 1.0), ("chair", 0.5)] {
            let found = color_of(&colored(named(1, name), &[(Green, 1.0)]), &wooden("wooden", &[]));
            assert!((found - by_hand).abs() < 1e-4, "{name}: {found}, expected {by_hand}");
        }
    }

    fn trait_of(instances: &[Instance], nouns: &[f32], asked: Trait) -> Vec<f32> {
        let solids: Vec<Solid> = instances.iter().map(Solid::from).collect();
        trait_fits(instances, &solids, nouns, asked)
    }

    #[test]
    fn size_traits_score_by_rank_or_ratio_to_the_extreme() {
        // 1, 0.74 and 0.2 m³: the middle one has half of the places below it, and
        // (0.74 - 0.5) / 0.4 = 0.6 of the largest; 0.3 + 0.7 · 0.6.
        let room = [sized(1, [1.0; 3]), sized(2, [1.0, 1.0, 0.74]), sized(3, [1.0, 1.0, 0.2])];
        assert_close(&trait_of(&room, &[1.0; 3], Trait::Large), &[1.0, 0.72, 0.3]);
        // Small the other way round, by rank: 0.2 / 0.74 and 0.2 / 1 are below a half.
        assert_close(&trait_of(&room, &[1.0; 3], Trait::Small), &[0.3, 0.65, 1.0]);
        // Of two of nearly one size: 0.2 / 0.25 = 0.8, 0.3 / 0.4; 0.3 + 0.7 · 0.75.
        let room = [sized(1, [1.0, 1.0, 0.25]), sized(2, [1.0, 1.0, 0.2])];
        assert_close(&trait_of(&room, &[1.0; 2], Trait::Small), &[0.825, 1.0]);
        assert_close(&trait_of(&room, &[1.0; 2], Trait::Large), &[1.0, 0.825]);
        // From 90 % on, both are equally large.
        let room = [sized(1, [1.0; 3]), sized(2, [1.0, 1.0, 0.91])];
        assert_close(&trait_of(&room, &[1.0; 2], Trait::Large), &[1.0, 1.0]);
    }

    #[test]
    fn traits_compare_only_plausible_instances_of_the_noun() {
        let room = [sized(1, [1.0; 3]), sized(2, [0.5; 3]), sized(3, [2.0; 3])];
        // An instance without rivals scores 1, and so do all where no instance is plausible.
        assert_close(&trait_of(&room, &[0.0, 1.0, 0.0], Trait::Large), &[1.0, 1.0, 1.0]);
        assert_close(&trait_of(&room, &[0.0; 3], Trait::Large), &[1.0, 1.0, 1.0]);
        // 0.3 of the best fit is enough: 1 m³ and 0.125 m³ are compared, 8 m³ is not.
        assert_close(&trait_of(&room, &[1.0, 0.3, 0.29], Trait::Large), &[1.0, 0.3, 1.0]);
        assert_close(&trait_of(&room, &[1.0, 0.29, 0.29], Trait::Large), &[1.0, 1.0, 1.0]);
        assert_close(&trait_of(&room, &[0.6, 0.2, 0.1], Trait::Large), &[1.0, 0.3, 1.0]);
        // The third is compared too: ranks of 0.5, 0 and 1.
        assert_close(&trait_of(&room, &[0.6, 0.2, 0.2], Trait::Large), &[0.65, 0.3, 1.0]);
    }

    #[test]
    fn tall_and_long_use_height_and_footprint_length() {
        let room = [sized(1, [0.4, 2.0, 0.5]), sized(2, [1.0, 1.0, 2.0])];
        assert_close(&trait_of(&room, &[1.0; 2], Trait::Tall), &[0.3, 1.0]);
        assert_close(&trait_of(&room, &[1.0; 2], Trait::Low), &[1.0, 0.3]);
        assert_close(&trait_of(&room, &[1.0; 2], Trait::Long), &[1.0, 0.3]);
        // 1.6 m of 2 m: (0.8 - 0.5) / 0.4 = 0.75.
        let room = [sized(1, [0.4, 2.0, 0.5]), sized(2, [1.6, 1.0, 2.0])];
        assert_close(&trait_of(&room, &[1.0; 2], Trait::Long), &[1.0, 0.825]);
    }

    #[test]
    fn tall_means_high_for_instances_on_walls() {
        let hung = |id, base: f32, height: f32, support| {
            thing(id, [id as f32, 0.0], [0.5, 0.1, height], base, support, [90; 3])
        };
        let wall = Support::Wall { id: InstanceId(9) };
        // Tops at 1 m and 2 m, heights of 0.5 m and 0.3 m.
        let room = |support| [hung(1, 0.5, 0.5, wall), hung(2, 1.7, 0.3, support)];
        assert_close(&trait_of(&room(wall), &[1.0; 2], Trait::Tall), &[0.3, 1.0]);
        assert_close(&trait_of(&room(wall), &[1.0; 2], Trait::Low), &[1.0, 0.3]);
        // One of them is on the floor: heights count. 0.3 / 0.5: (0.6 - 0.5) / 0.4 = 0.25.
        assert_close(&trait_of(&room(Support::Floor), &[1.0; 2], Trait::Tall), &[1.0, 0.475]);
        assert_close(&trait_of(&room(Support::Floor), &[1.0, 0.3], Trait::Tall), &[1.0, 0.475]);
        // The one on the floor is not plausible: only the other is compared.
        assert_close(&trait_of(&room(Support::Floor), &[0.9, 0.28], Trait::Tall), &[0.3, 1.0]);
    }

    #[test]
    fn light_and_dark_score_by_rank_only() {
        let room = [200_u8, 190, 20].map(|grey| Instance { mean_rgb: [grey; 3], ..chair(1) });
        assert_close(&trait_of(&room, &[1.0; 3], Trait::Light), &[1.0, 0.65, 0.3]);
        assert_close(&trait_of(&room, &[1.0; 3], Trait::Dark), &[0.3, 0.65, 1.0]);
    }

    #[test]
    fn round_and_rectangular_score_by_footprint_proportions() {
        let sides = [1.0, 0.875, 0.85, 0.75, 0.675, 0.5, 0.4];
        let room = sides.map(|short| sized(1, [short, 1.0, 0.3]));
        // (share - 0.5) / 0.35, from 0.3 to 1.
        let round = [1.0, 1.0, 1.0, 0.714_286, 0.5, 0.3, 0.3];
        assert_close(&trait_of(&room, &[1.0; 7], Trait::Round), &round);
        assert_close(&trait_of(&room, &[1.0; 7], Trait::Square), &round);
        // (1 - share) / 0.25.
        let long = [0.3, 0.5, 0.6, 1.0, 1.0, 1.0, 1.0];
        assert_close(&trait_of(&room, &[1.0; 7], Trait::Rectangular), &long);
    }

    #[test]
    fn plausible_instances_have_at_least_thirty_percent_of_the_best_fit() {
        assert_eq!(most_plausible(&[1.0, 0.3, 0.299], usize::MAX), [(0, 1.0), (1, 0.3)]);
        assert_eq!(most_plausible(&[0.5, 0.16, 0.14], usize::MAX), [(0, 0.5), (1, 0.16)]);
        // Within the limit all are kept, in order of index.
        assert_eq!(most_plausible(&[0.4, 0.5], 2), [(0, 0.4), (1, 0.5)]);
        assert_eq!(most_plausible(&[], 2), []);
    }

    proptest! {
        /// The larger of two never scores lower, and every fit is in its range.
        #[test]
        fn size_traits_are_monotonic(heights in prop::collection::vec(0.05_f32..2.0, 1..8)) {
            let room: Vec<Instance> =
                (1..).zip(&heights).map(|(id, h)| sized(id, [0.5, 0.5, *h])).collect();
            let nouns = vec![1.0; room.len()];
            for (asked, sign) in
                [(Trait::Large, 1.0), (Trait::Small, -1.0), (Trait::Tall, 1.0), (Trait::Low, -1.0)]
            {
                let fits = trait_of(&room, &nouns, asked);
                prop_assert!(fits.iter().all(|fit| (0.3..=1.0001).contains(fit)), "{fits:?}");
                for (a, b) in heights.iter().zip(&fits) {
                    for (c, d) in heights.iter().zip(&fits) {
                        let ordered = sign * (a - c) < 1e-3 || *b >= *d - 1e-3;
                        prop_assert!(ordered, "{asked:?} {heights:?} {fits:?}");
                    }
                }
            }
        }

        /// A color fit is in its range for any number of colors.
        #[test]
        fn color_fits_are_between_zero_and_one(
            shares in prop::array::uniform12(0.0_f32..1.0),
            wanted in prop::collection::vec(0_usize..12, 0..4),
            unwanted in prop::collection::vec(0_usize..12, 0..3),
        ) {
            let sum: f32 = shares.iter().sum::<f32>().max(1e-3);
            let colors = ColorHistogram(shares.map(|share| share / sum));
            let of = |which: &[usize]| {
                which.iter().map(|&i| ColorName::ALL[i]).collect::<Vec<_>>()
            };
            let phrase = in_color(&of(&wanted), &of(&unwanted));
            let fit = color_of(&Instance { colors, ..chair(1) }, &phrase);
            prop_assert!(fit > 0.0 && fit <= 1.0, "{fit} {phrase:?}");
        }
    }

    #[test]
    fn number_of_plausible_instances_is_limited() {
        // The work on a question over thousands of instances is bounded by this.
        assert_eq!(
            most_plausible(&[0.5, 0.1, 0.9, 0.0, 0.8], usize::MAX),
            [(0, 0.5), (2, 0.9), (4, 0.8)]
        );
        assert_eq!(most_plausible(&[0.5, 0.1, 0.9, 0.0, 0.8], 2), [(2, 0.9), (4, 0.8)]);
        assert_eq!(most_plausible(&[0.7; 100], 3), [(0, 0.7), (1, 0.7), (2, 0.7)]);
        assert_eq!(most_plausible(&[0.0, 0.0], 3), []);
    }
}
