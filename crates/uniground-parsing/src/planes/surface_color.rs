//! The color of a surface, and which places have another one.

use rayon::prelude::*;
use uniground_geometry::color::Lab;

/// CIELAB distance within which two places have one color, with lightness counted half.
const SAME_COLOR: f32 = 12.0;
/// About this many places are sampled for the surface's color: less than twice as many.
const MOST_TRIED: usize = 200;

/// Returns the most common color of these places, each with a weight. `None` without any.
pub(super) fn most_common_color(places: &[(Lab, u32)]) -> Option<Lab> {
    let alike = |lab: Lab| places.iter().filter(move |(other, _)| is_same_color(other, &lab));
    // A sample is enough to find it: a house has many superpoints.
    let tried: Vec<Lab> =
        places.iter().step_by((places.len() / MOST_TRIED).max(1)).map(|(lab, _)| *lab).collect();
    let weights: Vec<u64> = tried
        .par_iter()
        .map(|&lab| alike(lab).map(|(_, weight)| u64::from(*weight)).sum())
        .collect();
    let most = (0..tried.len()).max_by_key(|&i| (weights[i], std::cmp::Reverse(i)))?;
    let sum =
        alike(tried[most]).fold(Lab::zeros(), |sum, (lab, weight)| sum + lab * *weight as f32);
    Some(sum / weights[most] as f32)
}

/// Returns whether two colors are one, under somewhat different light.
pub(super) fn is_same_color(a: &Lab, b: &Lab) -> bool {
    let apart = a - b;
    Lab::new(apart.x / 2.0, apart.y, apart.z).norm() < SAME_COLOR
}

/// Returns the CIELAB distance of a color from the surface's color under as much light. Light
/// scales all components of a color alike: L* + 16, a* and b*.
pub(super) fn hue_distance(lab: &Lab, surface: &Lab) -> f32 {
    let light = (lab.x + 16.0) / (surface.x + 16.0);
    (lab.y - light * surface.y).hypot(lab.z - light * surface.z)
}
