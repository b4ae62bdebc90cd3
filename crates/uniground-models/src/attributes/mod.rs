//! The built-in encoder. It uses the typical measures of things instead of their appearance.
//!
//! Without a model, an instance is described by size, height, support and color names, and a noun
//! by the typical sizes in `lexicon.tsv`. That separates a sofa from a mug and a rug from a door,
//! but not a box from a crate. Scores measure the fit, and every answer names this encoder.

mod lexicon;
mod wordnet;

pub use lexicon::{Lexicon, Noun, Place, Range, Shape};
use rayon::prelude::*;
use uniground_geometry::color::ColorName;
use uniground_geometry::scene::{Instance, NameGuess, Structure, Support};
pub use wordnet::{Kinship, WordNet};

/// Name and version, recorded with parses and answers.
pub const NAME: &str = "attributes-2";

/// Maximum number of names of an instance.
const KEPT_NAMES: usize = 5;
/// Minimum score of a name that is reported.
const MIN_NAME_SCORE: f32 = 0.3;
/// Width of the fall-off outside a range, in natural logarithms of the size. It allows for inexact
/// segmentation.
const SIZE_TOLERANCE: f32 = 0.2;
/// Tolerance for the height of the underside, meters.
const BASE_TOLERANCE_M: f32 = 0.12;
/// Weight of the distance from a range's middle, relative to one tolerance outside the range. The
/// middle is more common than the ends.
const OFF_CENTER_WEIGHT: f32 = 0.1;
/// Factor for a surface that does not match the noun's shape.
const ODD_SHAPE: f32 = 0.5;
/// Minimum share of green points for foliage.
const LEAST_GREEN: f32 = 0.05;
/// Minimum thickness at which a surface gives information on shape, meters.
const THICK_M: f32 = 0.1;
/// Factor for a thing on another thing that it does not usually stand on.
const ODD_PLACE: f32 = 0.8;
/// Factor for a support that is unusual for the noun.
const ODD_SUPPORT: f32 = 0.6;

/// Returns how well a noun fits an instance, `0..=1`. 1 when every measure lies in the middle of
/// its usual range.
#[must_use]
pub fn noun_fit(noun: &Noun, instance: &Instance) -> f32 {
    if instance.structure.is_some_and(|s| s != Structure::Wall || !noun.can_be_part_of_wall()) {
        return 0.0;
    }
    let (long, short) = sides(instance);
    let height = if noun.is_on_legs() {
        instance.height_above_floor_m + instance.aabb.size.z
    } else {
        instance.aabb.size.z
    };
    let misfit = [noun.long, noun.short, noun.height]
        .iter()
        .zip([long, short, height])
        .map(|(range, value)| range.misfit_log(value) / SIZE_TOLERANCE)
        .chain([noun.base.misfit(instance.height_above_floor_m) / BASE_TOLERANCE_M])
        .map(|m| m * m)
        .sum::<f32>();
    let off_center: f32 = [(noun.long, long), (noun.short, short), (noun.height, height)]
        .iter()
        .map(|(range, v)| range.off_center(*v).powi(2))
        .sum();
    let misfit = misfit + OFF_CENTER_WEIGHT * off_center;
    let support = if noun.stands_on(resting_place(instance)) { 1.0 } else { ODD_SUPPORT };
    (-0.5 * misfit).exp() * support * shape_fit(noun.shape, instance)
}

/// Returns how well the surface matches a shape, judged by the share of points on one plane.
fn shape_fit(shape: Shape, instance: &Instance) -> f32 {
    let size = instance.oriented_box.size;
    // All points of a thing of a few centimeters are on one plane.
    if size.min() < THICK_M {
        return 1.0;
    }
    let odd_unless = |share: f32| ODD_SHAPE + (1.0 - ODD_SHAPE) * share;
    match shape {
        Shape::Flat => odd_unless(ramp(instance.planarity, 0.2, 0.6)),
        Shape::Bushy => {
            odd_unless(roughness(instance))
                * if instance.colors.share(ColorName::Green) < LEAST_GREEN {
                    ODD_SHAPE
                } else {
                    1.0
                }
        }
        Shape::Boxy | Shape::Open | Shape::Round | Shape::Soft => {
            odd_unless(1.0 - foliage_score(instance))
        }
    }
}

/// Returns how much a thing looks like leaves, `0..=1`: rough, and mostly green. A thing that is
/// green everywhere was dyed or painted.
fn foliage_score(instance: &Instance) -> f32 {
    let green = instance.colors.share(ColorName::Green);
    roughness(instance) * ramp(green, 0.2, 0.4) * ramp(green, 0.9, 0.75)
}

/// Returns how far a thing is from being one plane, `0..=1`.
fn roughness(instance: &Instance) -> f32 {
    ramp(instance.planarity, 0.6, 0.3)
}

/// Returns 0 at `from`, 1 at `to`, and interpolates linearly between.
fn ramp(value: f32, from: f32, to: f32) -> f32 {
    ((value - from) / (to - from)).clamp(0.0, 1.0)
}

/// Returns how well a color word describes an instance, `0..=1`.
#[must_use]
pub fn color_fit(color: ColorName, instance: &Instance) -> f32 {
    instance.colors.name_fit(color)
}

/// Names all instances, in two rounds: the second uses the names of the things they stand on, such
/// as a keyboard on a desk.
pub fn name_all(instances: &mut [Instance]) {
    let alone: Vec<Vec<NameGuess>> = instances.par_iter().map(name_guesses).collect();
    let placed: Vec<Vec<NameGuess>> = instances
        .par_iter()
        .map(|instance| match instance.support {
            Support::Instance { id } => {
                guess_names(instance, alone.get(id.0 as usize - 1).map_or(&[], Vec::as_slice))
            }
            _ => alone[instance.id.0 as usize - 1].clone(),
        })
        .collect();
    instances.iter_mut().zip(placed).for_each(|(instance, names)| instance.names = names);
}

/// Returns the best names for an instance, independent of any question. Empty for structure and for
/// shapes that no noun fits.
///
/// Scores are fits weighted by how common the thing is. Among nouns with the same fit, the one with
/// the narrower ranges comes first, because it is more specific.
#[must_use]
pub fn name_guesses(instance: &Instance) -> Vec<NameGuess> {
    guess_names(instance, &[])
}

/// Returns the same for an instance that stands on a thing with these names. Without names, the
/// place is unknown.
fn guess_names(instance: &Instance, below: &[NameGuess]) -> Vec<NameGuess> {
    let place = |noun: &Noun| match below.is_empty()
        || noun.usually_on.iter().any(|on| below.iter().any(|guess| guess.name == *on))
    {
        true => 1.0,
        false => ODD_PLACE,
    };
    if instance.structure.is_some() {
        return Vec::new();
    }
    let mut scored: Vec<(f32, &Noun)> = Lexicon::get()
        .nouns()
        .iter()
        .map(|noun| (noun_fit(noun, instance) * noun.prior * place(noun), noun))
        .filter(|(fit, _)| *fit >= MIN_NAME_SCORE)
        .collect();
    scored.sort_by(|a, b| {
        (b.0 * b.1.specificity())
            .total_cmp(&(a.0 * a.1.specificity()))
            .then(a.1.name.cmp(&b.1.name))
    });
    scored
        .into_iter()
        .take(KEPT_NAMES)
        .map(|(score, noun)| NameGuess { name: noun.name.clone(), score })
        .collect()
}

/// Returns the long and short side of the footprint, meters.
#[must_use]
pub fn sides(instance: &Instance) -> (f32, f32) {
    let size = instance.oriented_box.size;
    (size.x.max(size.y), size.x.min(size.y))
}

fn resting_place(instance: &Instance) -> Place {
    match instance.support {
        Support::Floor => Place::Floor,
        Support::Instance { .. } => Place::Surface,
        Support::Wall { .. } => Place::Wall,
        Support::Nothing => Place::Unknown,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use uniground_geometry::color::ColorHistogram;
    use uniground_geometry::scene::InstanceId;
    use uniground_testing::thing;

    #[test]
    fn typical_sizes_give_the_expected_names() {
        let on_table = Support::Instance { id: InstanceId(9) };
        for (size, base, support, expected) in [
            ([2.1, 0.9, 0.8], 0.0, Support::Floor, "sofa"),
            ([0.11, 0.08, 0.1], 0.75, on_table, "mug"),
            ([2.4, 1.6, 0.01], 0.0, Support::Floor, "rug"),
            ([0.8, 0.3, 2.0], 0.0, Support::Floor, "bookcase"),
            ([0.85, 0.05, 2.03], 0.0, Support::Floor, "door"),
        ] {
            let guesses = name_guesses(&thing(1, [0.0, 0.0], size, base, support, [120; 3]));
            assert!(guesses.iter().take(3).any(|g| g.name == expected), "{size:?}: {guesses:?}");
        }
    }

    #[test]
    fn table_top_without_legs_fits_a_table() {
        let top = thing(1, [0.0, 0.0], [1.2, 0.7, 0.03], 0.42, Support::Nothing, [20; 3]);
        let fit = |word| noun_fit(Lexicon::get().find(word).unwrap(), &top);
        assert!(
            fit("coffee table") > 0.9 && fit("dining table") < 0.2,
            "{} {}",
            fit("coffee table"),
            fit("dining table")
        );
    }

    #[test]
    fn rough_and_partly_green_things_are_plants() {
        let names = |rgb: &[[u8; 3]], planarity| {
            let standing = thing(1, [0.0, 0.0], [0.7, 0.68, 1.4], 0.0, Support::Floor, [60; 3]);
            let guesses = name_guesses(&Instance {
                colors: ColorHistogram::from_colors(rgb.iter().copied()),
                planarity,
                ..standing
            });
            guesses.into_iter().map(|guess| guess.name).collect::<Vec<_>>()
        };
        let [leaf, shade, pot] = [[50, 120, 40], [20, 20, 18], [150, 80, 50]];
        assert_eq!(names(&[leaf, leaf, shade, pot], 0.25)[0], "plant");
        assert_eq!(names(&[leaf, leaf, shade, pot], 0.7)[0], "fridge", "mostly one plane");
        assert_eq!(names(&[leaf], 0.25)[0], "fridge", "entirely green");
        assert_eq!(names(&[shade, pot], 0.25)[0], "fridge", "not green");
    }

    #[test]
    fn noun_fit_separates_a_sofa_from_a_mug() {
        let sofa = thing(1, [0.0, 0.0], [2.1, 0.9, 0.8], 0.0, Support::Floor, [120; 3]);
        let fit = |word| noun_fit(Lexicon::get().find(word).unwrap(), &sofa);
        assert!(
            fit("sofa") > 0.95 && fit("couch") > 0.95 && fit("mug") < 0.01 && fit("chair") < 0.05
        );
    }
}
