//! How well instances fit a noun phrase: noun x colours x size words x what the thing carries.

use super::SceneView;
use super::query::{Meaning, Phrase, SizeWord, With};
use super::relations;
use crate::models::attributes::{self, Lexicon, noun_fit};
use crate::scene::Instance;

/// A broader word ("seat" for a sofa) fits a little less than the thing's own name.
const BROADER_WORD: f32 = 0.9;
/// A thing that was given a broader name than the one asked for may be meant.
const BROADER_NAME: f32 = 0.5;
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
    let nouns: Vec<f32> = noun_fits(scene.instances, &phrase.head, &phrase.meaning());
    let sizes = phrase.sizes.iter().map(|&size| size_fits(scene.instances, &nouns, size)).collect::<Vec<_>>();
    let withs: Vec<(Vec<(usize, f32)>, &With)> = phrase
        .with
        .iter()
        .map(|with| (most_plausible(&phrase_fits(scene, &with.phrase), MAX_CARRIED), with))
        .collect();
    scene
        .instances
        .iter()
        .enumerate()
        .map(|(i, instance)| {
            let colours = colours_fit(phrase, instance);
            let sizes: f32 = sizes.iter().map(|fits| fits[i]).product();
            let carried: f32 = withs.iter().map(|(things, with)| with_fit(scene, i, things, with)).product();
            nouns[i] * colours * sizes * carried
        })
        .collect()
}

/// An instance may be meant when it fits at least this well, against the best.
pub(super) const PLAUSIBLE: f32 = 0.3;
/// Things looked at for "with a book on it".
const MAX_CARRIED: usize = 64;

/// Indices that may be meant, with their fit: the best `limit` of those above [`PLAUSIBLE`], in order of index.
pub(super) fn most_plausible(fits: &[f32], limit: usize) -> Vec<(usize, f32)> {
    let best = fits.iter().copied().fold(0.0, f32::max);
    let mut plausible: Vec<(usize, f32)> =
        fits.iter().copied().enumerate().filter(|&(_, fit)| fit > 0.0 && fit >= PLAUSIBLE * best).collect();
    if plausible.len() > limit {
        plausible.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(&b.0)));
        plausible.truncate(limit);
        plausible.sort_by_key(|&(i, _)| i);
    }
    plausible
}

fn noun_fits(instances: &[Instance], head: &str, meaning: &Meaning) -> Vec<f32> {
    let fit = |instance: &Instance| match meaning {
        Meaning::Nouns(_) | Meaning::Unknown if instance.given_name.is_some() => {
            instance.given_name.as_deref().map_or(0.0, |given| given_name_fit(given, head, meaning))
        }
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

/// How well a name that somebody gave fits the noun asked for: the same thing in other words fits fully, a broader word a little less.
fn given_name_fit(given: &str, head: &str, meaning: &Meaning) -> f32 {
    let same_words = given.split_whitespace().next_back() == head.split_whitespace().next_back();
    match (meaning, Lexicon::get().find_all(given).first()) {
        (Meaning::Nouns(asked), Some(own)) => match asked.iter().position(|noun| noun.name == own.name) {
            Some(0) => 1.0,
            Some(_) => BROADER_WORD,
            // "table" was given and "side table" is asked for: it may be one.
            None if asked.first().is_some_and(|noun| noun.kinds.contains(&own.name)) => BROADER_NAME,
            None => 0.0,
        },
        _ => f32::from(u8::from(same_words && !head.is_empty())),
    }
}

fn colours_fit(phrase: &Phrase, instance: &Instance) -> f32 {
    // Two colours share the surface: each needs to be there, neither needs to rule.
    let n = phrase.colours.len().max(1) as f32;
    let wanted = phrase
        .colours
        .iter()
        .map(|&c| (attributes::colour_fit(c, instance) * n.sqrt()).clamp(WRONG_COLOUR, 1.0));
    let unwanted = phrase.other_than.iter().map(|&c| (1.0 - attributes::colour_fit(c, instance)).max(WRONG_COLOUR));
    wanted.chain(unwanted).product()
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
fn with_fit(scene: SceneView, carrier: usize, things: &[(usize, f32)], with: &With) -> f32 {
    if PARTS.contains(&with.phrase.head.as_str()) {
        let own = colours_fit(&with.phrase, &scene.instances[carrier]);
        return if with.absent { 1.0 - own } else { own };
    }
    let carried = things
        .iter()
        .filter(|&&(i, _)| i != carrier)
        .map(|&(i, fit)| {
            let (thing, on) = (&scene.instances[i].aabb, &scene.instances[carrier].aabb);
            fit * relations::on(thing, on).max(relations::inside(thing, on)).max(0.3 * relations::near(thing, on))
        })
        .fold(0.0, f32::max);
    let carried = 0.1 + 0.9 * carried;
    if with.absent { 1.1 - carried } else { carried }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_the_best_few_are_looked_at() {
        // The work on a question over thousands of instances is bounded by this.
        assert_eq!(most_plausible(&[0.5, 0.1, 0.9, 0.0, 0.8], usize::MAX), [(0, 0.5), (2, 0.9), (4, 0.8)]);
        assert_eq!(most_plausible(&[0.5, 0.1, 0.9, 0.0, 0.8], 2), [(2, 0.9), (4, 0.8)]);
        assert_eq!(most_plausible(&[0.7; 100], 3), [(0, 0.7), (1, 0.7), (2, 0.7)]);
        assert_eq!(most_plausible(&[0.0, 0.0], 3), []);
    }
}
