//! How well instances fit what a phrase says of the thing itself: noun x colours x traits.
//! Relations are [`assess`](super::assess)'s.

use super::SceneView;
use super::choose_level::one_per_place;
use super::kinds::breadth;
use super::names::GivenName;
use super::readings::{Reading, Readings};
use super::solid::Solid;
use std::collections::HashSet;
use uniground_geometry::colour::{ColourName, lab_of_srgb};
use uniground_geometry::scene::{Instance, Level, Support};
use uniground_language::{Meaning, Phrase, Trait};
use uniground_models::attributes::{self, Noun, noun_fit};

/// A name seldom says all that can be said.
const UNSAID: f32 = 0.8;
/// How much a colour that somebody has seen counts beside the one that was measured: a scan's light
/// is seldom white.
const SEEN_COLOUR: f32 = 0.67;
/// What is left where a name says another colour.
const NAMED_OTHERWISE: f32 = 0.25;
/// Something of any size is among the parts and wholes of a room: where only measures tell what
/// they are, they are a last resort.
const GUESSED: f32 = 0.55;
/// How well "thing" and "one" fit everything.
const ANYTHING: f32 = 0.8;
/// A fit by measures that says something.
const LIKELY: f32 = 0.35;
/// What the fit of the others counts where something is called by the noun.
const NOT_CALLED_SO: f32 = 0.85;
/// A fit of something that is called by the noun itself.
const CALLED_SO: f32 = 0.95;
/// Smaller things are seldom meant by "thing", metres.
const NOTABLE_M: f32 = 0.1;
/// A colour that is not there at all leaves this: the scan's light may be odd.
const WRONG_COLOUR: f32 = 0.02;
/// The same for a colour that is only likened: people say "pinkish" of a brown chair.
const NEAR_COLOUR: f32 = 0.3;
/// Words for wood, and the colours it mostly has.
const WOOD: [&str; 6] = ["wooden", "wood", "oak", "pine", "walnut", "timber"];
const WOODEN: [ColourName; 4] =
    [ColourName::Brown, ColourName::Orange, ColourName::Beige, ColourName::Yellow];
/// What is left of what is said to be of wood and has none of these: it may be painted.
const PAINTED: f32 = 0.5;
/// An instance may be meant when its fit is at least this share of the best fit.
pub(super) const PLAUSIBLE: f32 = 0.3;
/// What is left at the wrong end of a comparison: of the smallest thing when "large" is asked for.
const OPPOSITE_TRAIT: f32 = 0.3;

/// Fit of every instance to a phrase's noun, or to another it may be called by, `0..=1`, by index;
/// one instance for each place.
#[must_use]
pub fn noun_fits(scene: SceneView, phrase: &Phrase) -> Vec<f32> {
    let readings = Readings::of(phrase);
    let (mut fits, mut share) = (vec![0.0_f32; scene.instances.len()], 1.0);
    for Reading { weight, phrase, meaning } in readings.iter() {
        let read = fits_of_reading(scene, phrase, meaning);
        let is_there = read.iter().any(|fit| *fit >= CALLED_SO);
        fits.iter_mut().zip(read).for_each(|(best, fit)| *best = best.max(weight * share * fit));
        // The room has what was said: it is seldom another thing that is meant.
        share = if is_there { NOT_CALLED_SO } else { share };
    }
    one_per_place(scene.instances, &mut fits);
    let nouns: Vec<&Noun> = readings.iter().flat_map(Reading::nouns).copied().collect();
    if !nouns.is_empty() && scene.appearance.is_none() && phrase.uses.is_empty() {
        called_so_first(&nouns, scene.instances, &mut fits);
    }
    fits
}

fn fits_of_reading(scene: SceneView, phrase: &Phrase, meaning: &Meaning) -> Vec<f32> {
    let by_appearance = |word: &str, index: usize, measured| {
        scene.appearance.and_then(|appearance| appearance.fit(word, index, measured))
    };
    // The same for all instances: of a purpose there are dozens of nouns.
    let (breadths, names): (Vec<f32>, HashSet<&str>) = match meaning {
        Meaning::Nouns(nouns) => nouns
            .iter()
            .enumerate()
            .map(|(i, noun)| (breadth(phrase, noun, i), noun.name.as_str()))
            .unzip(),
        _ => Default::default(),
    };
    let unnamed = |(index, instance): (usize, &Instance)| match meaning {
        // A word without measures: only its looks tell.
        Meaning::Unknown if instance.structure.is_none() => {
            by_appearance(&phrase.head, index, None).unwrap_or(0.0)
        }
        Meaning::Unknown => 0.0,
        Meaning::Anything => {
            if instance.structure.is_none() {
                ANYTHING * notable(instance)
            } else {
                0.0
            }
        }
        Meaning::Structure(structure) => {
            f32::from(u8::from(instance.structure == Some(*structure)))
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
            // Looks have been weighed against all other names, measures have not.
            let guessed = if instance.level == Level::Thing { 1.0 } else { GUESSED };
            by_looks.unwrap_or_else(|| {
                guessed * by_measure * among_names(by_measure, &names, instance).sqrt()
            })
        }
    };
    let fit = |(index, instance): (usize, &Instance)| match (scene.names.get(index), meaning) {
        (Some(name), Meaning::Nouns(_) | Meaning::Unknown) => {
            name.fit(phrase, meaning) * said(name, phrase)
        }
        (Some(name), Meaning::Anything) if !name.is_thing() => 0.0,
        // Planes were measured; a name tells of stretches that were not.
        (Some(name), Meaning::Structure(_)) => {
            unnamed((index, instance)).max(name.fit(phrase, meaning))
        }
        _ => unnamed((index, instance)),
    };
    scene.instances.iter().enumerate().map(fit).collect()
}

/// What is left where a name does not say what is said of the thing: "leather", "kitchen".
fn said(name: &GivenName, phrase: &Phrase) -> f32 {
    phrase.unchecked.iter().map(|word| if name.says(word) { 1.0 } else { UNSAID }).product()
}

/// "What is on my right?" asks for something one would name, not for a speck or a sliver: by the
/// second of its three sides.
fn notable(instance: &Instance) -> f32 {
    let mut sides = instance.aabb.size;
    sides.as_mut_slice().sort_by(f32::total_cmp);
    (sides[1] / NOTABLE_M).clamp(0.3, 1.0)
}

/// How likely an instance is called one of `names` rather than what its other guesses say: a table
/// may have a sofa's size.
fn among_names(fit: f32, names: &HashSet<&str>, instance: &Instance) -> f32 {
    let (mut own, mut others) = (0.0, 0.0);
    for guess in &instance.names {
        if names.contains(guess.name.as_str()) { own += guess.score } else { others += guess.score }
    }
    let own = fit.max(own);
    if own > 0.0 { own / (own + others) } else { 0.0 }
}

/// Where something is called by the noun before anything else, what may be one too comes after it.
fn called_so_first(nouns: &[&Noun], instances: &[Instance], fits: &mut [f32]) {
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

/// Fit of the instance at an index to a phrase's colours, `0..=1`.
#[must_use]
pub fn colours_fit(scene: SceneView, phrase: &Phrase, index: usize) -> f32 {
    let instance = &scene.instances[index];
    let named = scene.names.get(index).map(GivenName::colours).filter(|named| !named.is_empty());
    let colour_fit = |colour: ColourName| {
        let measured = attributes::colour_fit(colour, instance);
        let Some(named) = named else { return measured };
        let seen = if named.contains(&colour) { 1.0 } else { NAMED_OTHERWISE };
        measured + SEEN_COLOUR * (seen - measured)
    };
    let least = if phrase.roughly { NEAR_COLOUR } else { WRONG_COLOUR };
    // Two colours share the surface: each needs to be there, neither needs to rule.
    let n = phrase.colours.len().max(1) as f32;
    let wanted = phrase.colours.iter().map(|&c| (colour_fit(c) * n.sqrt()).clamp(least, 1.0));
    let unwanted = phrase.other_than.iter().map(|&c| (1.0 - colour_fit(c)).max(WRONG_COLOUR));
    wanted.chain(unwanted).product::<f32>() * wooden_fit(scene, phrase, index)
}

/// How well the colour of the instance at an index goes with wood, where a phrase says so and no
/// colour; 1 where a name says the same.
fn wooden_fit(scene: SceneView, phrase: &Phrase, index: usize) -> f32 {
    let is_said = phrase.unchecked.iter().any(|word| WOOD.contains(&word.as_str()));
    let is_named =
        || scene.names.get(index).is_some_and(|name| WOOD.iter().any(|word| name.says(word)));
    if !is_said || !phrase.colours.is_empty() || is_named() {
        return 1.0;
    }
    let seen: f32 =
        WOODEN.iter().map(|&colour| attributes::colour_fit(colour, &scene.instances[index])).sum();
    PAINTED + (1.0 - PAINTED) * seen.min(1.0)
}

/// Fit of every instance to a trait, `0..=1`. "Large" and "dark" compare it with the other things
/// the noun may mean; "round" looks at its box alone.
#[must_use]
pub fn trait_fits(
    instances: &[Instance],
    solids: &[Solid],
    nouns: &[f32],
    asked: Trait,
) -> Vec<f32> {
    let squareness = |solid: &Solid| solid.sides().1 / solid.sides().0.max(1e-3);
    let lightness = |i: usize| lab_of_srgb(instances[i].mean_rgb).x;
    // Of pictures and shelves on a wall "the high one" hangs high; of what stands on the floor it
    // is tall.
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
    // Of two sofas of nearly one size both are large: 0 at half as large, 1 at nine tenths.
    // Lightness is no size.
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

/// Indices that may be meant, with their fit: the best `limit` of those above [`PLAUSIBLE`], in
/// order of index.
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

    #[test]
    fn only_the_best_few_are_looked_at() {
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
