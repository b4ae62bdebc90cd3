//! How well instances fit a noun phrase: noun x colours x size words x what the thing carries.

use super::SceneView;
use super::query::{Meaning, Phrase, SizeWord, With};
use super::relations;
use crate::models::attributes::{self, noun_fit};
use crate::scene::Instance;

/// A broader word ("seat" for a sofa) fits a little less than the thing's own name.
const BROADER_WORD: f32 = 0.9;
/// What "thing" and "one" fit.
const ANYTHING: f32 = 0.8;
/// A colour that is not there at all leaves this: the scan's light may be odd.
const WRONG_COLOUR: f32 = 0.02;

/// Parts of things: "the stool with the orange seat" speaks of the stool's own colour.
const PARTS: [&str; 22] = [
    "seat", "seats", "back", "backrest", "leg", "legs", "arm", "arms", "armrests", "handle", "handles", "drawer", "drawers", "wheels",
    "top", "frame", "cushions", "shade", "screen", "lid", "base", "pattern",
];

/// Fit of every instance to a phrase, `0..=1`, by index.
#[must_use]
pub fn phrase_fits(scene: SceneView, phrase: &Phrase) -> Vec<f32> {
    let nouns: Vec<f32> = noun_fits(scene.instances, &phrase.meaning());
    let sizes = phrase.sizes.iter().map(|&size| size_fits(scene.instances, &nouns, size)).collect::<Vec<_>>();
    let withs: Vec<(Vec<f32>, &With)> = phrase.with.iter().map(|with| (phrase_fits(scene, &with.phrase), with)).collect();
    scene
        .instances
        .iter()
        .enumerate()
        .map(|(i, instance)| {
            let colours = colours_fit(phrase, instance);
            let sizes: f32 = sizes.iter().map(|fits| fits[i]).product();
            let carried: f32 = withs.iter().map(|(fits, with)| with_fit(scene, i, fits, with)).product();
            nouns[i] * colours * sizes * carried
        })
        .collect()
}

/// How many of the scene's instances fit a phrase at all.
pub(super) const PLAUSIBLE: f32 = 0.3;

fn noun_fits(instances: &[Instance], meaning: &Meaning) -> Vec<f32> {
    let fit = |instance: &Instance| match meaning {
        Meaning::Unknown => 0.0,
        Meaning::Anything => {
            if instance.structure.is_none() {
                ANYTHING
            } else {
                0.0
            }
        }
        Meaning::Structure(structure) => f32::from(u8::from(instance.structure == Some(*structure))),
        Meaning::Nouns(nouns) => {
            let broader = |i: usize| if i == 0 { 1.0 } else { BROADER_WORD };
            let fit = nouns.iter().enumerate().map(|(i, noun)| noun_fit(noun, instance) * broader(i)).fold(0.0, f32::max);
            // A table may have a sofa's size: what another name fits better is less likely this.
            let best_name = instance.names.iter().map(|guess| guess.score).fold(fit, f32::max);
            if fit > 0.0 { fit * fit / best_name } else { 0.0 }
        }
    };
    instances.iter().map(fit).collect()
}

fn colours_fit(phrase: &Phrase, instance: &Instance) -> f32 {
    // Two colours share the surface: each needs to be there, neither needs to rule.
    let n = phrase.colours.len().max(1) as f32;
    phrase
        .colours
        .iter()
        .map(|&c| (attributes::colour_fit(c, instance) * n.sqrt()).clamp(WRONG_COLOUR, 1.0))
        .product()
}

/// "large" and "small" are relative: to the other things the noun may mean.
fn size_fits(instances: &[Instance], nouns: &[f32], size: SizeWord) -> Vec<f32> {
    let measure = |instance: &Instance| match size {
        SizeWord::Large => instance.aabb.volume(),
        SizeWord::Small => -instance.aabb.volume(),
        SizeWord::Tall => instance.aabb.size.z,
        SizeWord::Low => -instance.aabb.size.z,
        SizeWord::Long => attributes::sides(instance).0,
    };
    let best = nouns.iter().copied().fold(0.0, f32::max);
    let rivals: Vec<f32> = instances
        .iter()
        .zip(nouns)
        .filter(|(_, fit)| **fit >= PLAUSIBLE * best && best > 0.0)
        .map(|(i, _)| measure(i))
        .collect();
    instances
        .iter()
        .map(|instance| {
            let smaller = rivals.iter().filter(|&&other| other < measure(instance)).count() as f32;
            let share = if rivals.len() > 1 { smaller / (rivals.len() - 1) as f32 } else { 1.0 };
            0.5 + 0.5 * share.min(1.0)
        })
        .collect()
}

/// "with the orange seat" is about the thing's own colour; "with a book on it" about another thing resting on it.
fn with_fit(scene: SceneView, carrier: usize, fits: &[f32], with: &With) -> f32 {
    if PARTS.contains(&with.phrase.head.as_str()) {
        let own = colours_fit(&with.phrase, &scene.instances[carrier]);
        return if with.absent { 1.0 - own } else { own };
    }
    let carried = (0..scene.instances.len())
        .filter(|&i| i != carrier && fits[i] > 0.0)
        .map(|i| {
            let (thing, on) = (&scene.instances[i].aabb, &scene.instances[carrier].aabb);
            fits[i] * relations::on(thing, on).max(relations::inside(thing, on)).max(0.3 * relations::near(thing, on))
        })
        .fold(0.0, f32::max);
    let carried = 0.1 + 0.9 * carried;
    if with.absent { 1.1 - carried } else { carried }
}
