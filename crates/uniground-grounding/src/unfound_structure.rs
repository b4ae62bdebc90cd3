//! What may be the floor, the ceiling or a wall of a scan in which stage 1 recognized none: small
//! scans show too little of them. A question about "the shoes on the floor" can still be answered.

use super::solid::Solid;
use uniground_geometry::scene::{Instance, Structure};

/// Fit of the likeliest instance: it is a guess.
const LIKELIEST: f32 = 0.5;
/// Distance from the lowest or highest point at which the fit is a third, meters.
const AWAY_M: f32 = 0.3;

/// Returns how well each instance fits a structure by its shape and place, `0..=0.5`, by index:
/// large, flat and low for a floor, high for a ceiling, upright for a wall.
pub(super) fn fits_by_shape(structure: Structure, instances: &[Instance]) -> Vec<f32> {
    let solids: Vec<Solid> = instances.iter().map(Solid::from).collect();
    let kept = || instances.iter().zip(&solids).filter(|(i, _)| !i.dismissed).map(|(_, s)| s);
    let lowest = kept().map(|solid| solid.bottom).fold(f32::INFINITY, f32::min);
    let highest = kept().map(|solid| solid.top).fold(f32::NEG_INFINITY, f32::max);
    let flat_area = |solid: &Solid| {
        let [along, across, height] = solid.size;
        let (a, b, thickness, away) = match structure {
            Structure::Floor => (along, across, height, solid.bottom - lowest),
            Structure::Ceiling => (along, across, height, highest - solid.top),
            Structure::Wall => (along.max(across), height, along.min(across), 0.0),
        };
        let flatness = (1.0 - thickness / a.min(b).max(1e-3)).max(0.0);
        a * b * flatness * (-away / AWAY_M).exp()
    };
    let areas: Vec<f32> = instances
        .iter()
        .zip(&solids)
        .map(|(instance, solid)| if instance.dismissed { 0.0 } else { flat_area(solid) })
        .collect();
    let largest = areas.iter().copied().fold(0.0, f32::max);
    let fit = |area: f32| if largest > 0.0 { LIKELIEST * area / largest } else { 0.0 };
    areas.into_iter().map(fit).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use uniground_geometry::boxes::Aabb;
    use uniground_geometry::scene::InstanceId;
    use uniground_geometry::{Point3, Vector3};

    fn instance(center: [f32; 3], size: [f32; 3]) -> Instance {
        Instance::from_box(
            InstanceId(1),
            Aabb { center: Point3::from(center), size: Vector3::from(size) },
        )
    }

    fn likeliest(structure: Structure, instances: &[Instance]) -> Option<usize> {
        let fits = fits_by_shape(structure, instances);
        (0..fits.len()).filter(|&i| fits[i] > 0.0).max_by(|&a, &b| fits[a].total_cmp(&fits[b]))
    }

    #[test]
    fn floors_are_low_ceilings_high_and_walls_upright() {
        let mut room = vec![
            instance([0.0, 0.0, 0.7], [1.6, 0.8, 0.04]), // a table top
            instance([0.0, 0.0, 0.02], [1.2, 0.8, 0.04]), // a piece of the floor
            instance([1.0, 0.0, 1.2], [0.1, 1.5, 2.0]),
            instance([0.0, 0.0, 2.5], [0.8, 0.8, 0.05]),
            instance([0.0, 0.5, 0.4], [0.8, 0.8, 0.8]), // a box
        ];
        assert_eq!(likeliest(Structure::Floor, &room), Some(1));
        assert_eq!(likeliest(Structure::Wall, &room), Some(2));
        assert_eq!(likeliest(Structure::Ceiling, &room), Some(3));
        room[2].dismissed = true;
        assert_ne!(likeliest(Structure::Wall, &room), Some(2));
        assert_eq!(likeliest(Structure::Floor, &[]), None);
    }

    proptest! {
        #[test]
        fn fits_are_bounded_whatever_the_boxes(
            boxes in prop::collection::vec((prop::array::uniform3(-9.0_f32..9.0), prop::array::uniform3(0.0_f32..6.0)), 0..8),
        ) {
            let room: Vec<Instance> = boxes.into_iter().map(|(center, size)| instance(center, size)).collect();
            for structure in [Structure::Floor, Structure::Wall, Structure::Ceiling] {
                let fits = fits_by_shape(structure, &room);
                prop_assert!(fits.iter().all(|fit| (0.0..=LIKELIEST).contains(fit)), "{fits:?}");
            }
        }
    }
}
