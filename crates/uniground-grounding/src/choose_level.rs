//! Keeps one candidate per place. A thing, its parts and the wholes it belongs to overlap, and a
//! question means one of them.

use uniground_geometry::scene::{Instance, InstanceId, Level};

/// A question means a part or a whole only if it fits clearly better than the things it overlaps.
const NOT_A_THING: f32 = 0.9;
/// Two parts of a thing are beside each other when their boxes share no more than this (IoU).
const BESIDE: f32 = 0.1;

/// Keeps only the best fit of all instances in one place and sets the others to 0. Dismissed
/// instances get 0 too. `fits` are by index.
pub(super) fn keep_best_per_place(instances: &[Instance], fits: &mut [f32]) {
    // Parts and wholes that consist only of dismissed things are dismissed too.
    let is_junk = |i: &Instance| {
        i.dismissed
            || !i.things.is_empty()
                && i.things.iter().all(|thing| instances[index(*thing)].dismissed)
    };
    for (fit, _) in fits.iter_mut().zip(instances).filter(|(_, instance)| is_junk(instance)) {
        *fit = 0.0;
    }
    let compounds: Vec<usize> =
        (0..instances.len()).filter(|&i| instances[i].level != Level::Thing).collect();
    compounds.iter().for_each(|&i| fits[i] *= NOT_A_THING);
    let thing_ids = |i: usize| {
        if instances[i].level == Level::Thing {
            vec![instances[i].id]
        } else {
            instances[i].things.clone()
        }
    };
    let mut rivals: Vec<usize> = compounds
        .into_iter()
        .filter(|&i| fits[i] > 0.0)
        .flat_map(|i| std::iter::once(i).chain(thing_ids(i).into_iter().map(index)))
        .collect();
    rivals.sort_by(|&a, &b| fits[b].total_cmp(&fits[a]).then(a.cmp(&b)));
    rivals.dedup();
    // The instances that stay, by thing.
    let mut taken: Vec<Vec<usize>> = vec![Vec::new(); instances.len()];
    for i in rivals {
        let own = thing_ids(i);
        let beside = |&other: &usize| {
            let parts = [i, other].iter().all(|&i| instances[i].level == Level::Part);
            other == i || parts && instances[i].aabb.iou(&instances[other].aabb) <= BESIDE
        };
        if own.iter().all(|&thing| taken[index(thing)].iter().all(beside)) {
            own.into_iter().for_each(|thing| taken[index(thing)].push(i));
        } else {
            fits[i] = 0.0;
        }
    }
}

fn index(id: InstanceId) -> usize {
    id.0 as usize - 1
}

#[cfg(test)]
mod tests {
    use super::*;
    use uniground_geometry::scene::Support;
    use uniground_testing::thing;

    fn at(id: u32, x: f32, level: Level, things: &[u32]) -> Instance {
        let things = things.iter().map(|&id| InstanceId(id)).collect();
        Instance {
            level,
            things,
            ..thing(id, [x, 0.0], [0.5, 0.5, 0.5], 0.0, Support::Floor, [90; 3])
        }
    }

    #[test]
    fn only_the_best_fit_per_place_is_kept() {
        let room = [
            at(1, 0.0, Level::Thing, &[]),
            at(2, 1.0, Level::Thing, &[]),
            at(3, 5.0, Level::Thing, &[]),
            at(4, 0.5, Level::Whole, &[1, 2]),
            at(5, 4.9, Level::Part, &[3]),
            at(6, 5.4, Level::Part, &[3]),
        ];
        let stays = |mut fits: [f32; 6]| {
            keep_best_per_place(&room, &mut fits);
            (1..=6).zip(fits).filter(|(_, fit)| *fit > 0.0).map(|(id, _)| id).collect::<Vec<u32>>()
        };
        assert_eq!(stays([0.8; 6]), [1, 2, 3], "equal fits: things are kept");
        assert_eq!(stays([0.3, 0.2, 0.0, 0.9, 0.0, 0.0]), [4], "a bed of blanket and headboard");
        assert_eq!(stays([0.95, 0.2, 0.0, 0.9, 0.0, 0.0]), [1, 2], "a thing on something else");
        assert_eq!(
            stays([0.1, 0.1, 0.2, 0.0, 0.9, 0.8]),
            [1, 2, 5, 6],
            "two drawers of one dresser"
        );
        assert_eq!(stays([0.0, 0.0, 0.9, 0.0, 0.0, 0.9]), [3]);
    }
}
