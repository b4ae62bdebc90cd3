use super::*;
use crate::NameIndex;
use crate::direction::DirectionConvention;
use uniground_geometry::boxes::Aabb;
use uniground_geometry::color::{ColorHistogram, ColorName};
use uniground_geometry::scene::Instance;
use uniground_language::{Measure, Superlative, Trait};
use uniground_testing::thing;

/// Returns a named instance; `base` is the height of its underside.
fn named(id: u32, name: &str, at: [f32; 2], size: [f32; 3], base: f32) -> Instance {
    let instance = thing(id, at, size, base, Support::Nothing, [90; 3]);
    Instance { given_name: Some(name.into()), ..instance }
}

/// Returns a lamp on the floor, 0.2 m wide.
fn lamp(id: u32, x: f32) -> Instance {
    named(id, "lamp", [x, 0.0], [0.2, 0.2, 0.4], 0.0)
}

/// Returns a desk of 0.6 m by 0.8 m (diagonal 1 m) that is 1 m high.
fn desk(id: u32, x: f32) -> Instance {
    named(id, "desk", [x, 0.0], [0.6, 0.8, 1.0], 0.0)
}

/// Returns a lamp whose underside is `hovers` meters above a desk's top.
fn lamp_over(id: u32, x: f32, hovers: f32) -> Instance {
    named(id, "lamp", [x, 0.0], [0.2, 0.2, 0.4], 1.0 + hovers)
}

fn wall(id: u32, x: f32) -> Instance {
    let wall = named(id, "wall", [x, 0.0], [0.1, 6.0, 2.6], 0.0);
    Instance { structure: Some(Structure::Wall), ..wall }
}

fn with_assessor<T>(instances: &[Instance], of: impl FnOnce(&mut Assessor) -> T) -> T {
    let names = NameIndex::of(instances);
    let extent = Aabb { center: Point3::new(0.0, 0.0, 1.3), size: Vector3::new(20.0, 9.0, 2.6) };
    let scene = SceneView { instances, extent, names: &names, appearance: None };
    of(&mut Assessor::new(scene, DirectionConvention::Viewer.into()))
}

fn noun_phrase(head: &str) -> Phrase {
    Phrase { head: head.into(), ..Phrase::default() }
}

fn relation(kind: RelationKind, anchors: &[&str]) -> Relation {
    let anchors = anchors.iter().map(|head| noun_phrase(head)).collect();
    Relation { kind, text: kind.as_str().into(), anchors, negated: false, rank: 1 }
}

fn lamp_that(relations: Vec<Relation>) -> Phrase {
    Phrase { relations, ..noun_phrase("lamp") }
}

fn totals(instances: &[Instance], phrase: &Phrase) -> Vec<f32> {
    with_assessor(instances, |assessor| assessor.assess(phrase).total)
}

fn scores(instances: &[Instance], relation: &Relation, fits: &[f32]) -> Vec<f32> {
    with_assessor(instances, |assessor| {
        assessor.match_relation(relation, fits).iter().map(|bond| bond.score).collect()
    })
}

fn anchors(instances: &[Instance], relation: &Relation, fits: &[f32]) -> Vec<Option<u32>> {
    with_assessor(instances, |assessor| {
        assessor
            .match_relation(relation, fits)
            .iter()
            .map(|bond| bond.anchor.map(|id| id.0))
            .collect()
    })
}

fn red(share: f32, instance: Instance) -> Instance {
    let mut shares = [0.0; 12];
    shares[ColorName::Red as usize] = share;
    shares[ColorName::Green as usize] = 1.0 - share;
    Instance { colors: ColorHistogram(shares), ..instance }
}

#[track_caller]
fn assert_close(found: &[f32], by_hand: &[f32]) {
    let same = found.len() == by_hand.len()
        && found.iter().zip(by_hand).all(|(a, b)| (a - b).abs() < 2e-4);
    assert!(same, "{found:?}, expected {by_hand:?}");
}

#[test]
fn near_prefers_the_nearer_one_and_far_the_farther_one() {
    let room = [desk(1, 0.0), lamp(2, 0.9), lamp(3, 1.0), lamp(4, 6.0), lamp(5, 6.5)];
    let fits = [0.0, 1.0, 1.0, 1.0, 1.0];
    let near = scores(&room, &relation(RelationKind::Near, &["desk"]), &fits);
    assert!(near[1] > 1.05 * near[2] && near[2] > near[3], "{near:?}");
    let far = scores(&room, &relation(RelationKind::Far, &["desk"]), &fits);
    assert!(far[4] > 1.05 * far[3] && far[3] > far[2], "{far:?}");
    // With a distance in the question, all within it count.
    let near = relation(RelationKind::Near, &["desk"]);
    let within = Relation { text: "within 2 m of".into(), ..near };
    let within = scores(&room, &within, &fits);
    assert_eq!(within[1], within[2]);
}

#[test]
fn contradicted_relation_keeps_five_or_twenty_percent() {
    // On the desk, 6 cm above it (a half), and elsewhere: 0.05 + 0.95 · bond.
    let room =
        [desk(1, 0.0), desk(2, 3.0), lamp_over(3, 0.0, 0.0), lamp_over(4, 3.0, 0.06), lamp(5, 8.0)];
    let phrase = lamp_that(vec![relation(RelationKind::On, &["desk"])]);
    assert_close(&totals(&room, &phrase), &[0.0, 0.0, 1.0, 0.525, 0.05]);
    // Left depends on the viewer: a lamp on the right keeps 0.2.
    let room = [desk(1, 0.0), lamp(2, 3.0)];
    let phrase = lamp_that(vec![relation(RelationKind::LeftOf, &["desk"])]);
    assert_close(&totals(&room, &phrase), &[0.0, 0.2]);
    assert_eq!(contradiction_factor(RelationKind::Near), 0.2);
    assert_eq!(contradiction_factor(RelationKind::Between), 0.2);
}

#[test]
fn scores_of_several_relations_multiply() {
    let room = [desk(1, 0.0), lamp_over(2, 0.0, 0.06), lamp(3, 8.0)];
    let on = || relation(RelationKind::On, &["desk"]);
    assert_close(&totals(&room, &lamp_that(vec![on(), on()])), &[0.0, 0.525 * 0.525, 0.05 * 0.05]);
    let found = with_assessor(&room, |assessor| assessor.assess(&lamp_that(vec![on()])));
    assert_close(&found.nouns, &[0.0, 1.0, 1.0]);
    assert_close(&found.own, &[0.0, 1.0, 1.0]);
    assert_eq!(found.bonds.len(), 1);
    assert_eq!(found.bonds[0][1].anchor, Some(InstanceId(1)));
    assert!(found.place_seen_by.is_empty(), "{found:?}");
}

#[test]
fn comparisons_are_scored_after_other_relations() {
    // The closest to the door of those on the desk is the one on the desk.
    let door = named(4, "door", [6.0, 0.0], [0.1, 0.9, 2.0], 0.0);
    let room = [desk(1, 0.0), lamp_over(2, 0.0, 0.0), lamp(3, 5.0), door];
    let closest = || relation(RelationKind::Closest, &["door"]);
    let on = || relation(RelationKind::On, &["desk"]);
    let by_hand = [0.0, 1.0, 0.05 * 0.05, 0.0];
    assert_close(&totals(&room, &lamp_that(vec![closest(), on()])), &by_hand);
    assert_close(&totals(&room, &lamp_that(vec![on(), closest()])), &by_hand);
    // Of all lamps it is the second: 0.05 + 0.95 · 0.45.
    assert_close(&totals(&room, &lamp_that(vec![closest()])), &[0.0, 0.477_5, 1.0, 0.0]);
}

#[test]
fn comparisons_with_a_count_rank_only_the_best_matches() {
    // Two red lamps, and a half-red one that is the largest.
    let large = named(3, "lamp", [4.0, 0.0], [0.4, 0.4, 0.8], 0.0);
    let door = named(4, "door", [6.0, 0.0], [0.1, 0.9, 2.0], 0.0);
    let room = [red(1.0, lamp(1, 0.0)), red(1.0, lamp(2, 2.0)), red(0.3, large), door];
    let largest = Some(Superlative { measure: Measure::Largest, rank: 1 });
    let closest = [relation(RelationKind::Closest, &["door"])];
    let asked = |count, superlative, relations: &[Relation]| {
        let relations = relations.to_vec();
        let colors = vec![ColorName::Red];
        totals(&room, &Phrase { colors, count, superlative, ..lamp_that(relations) })
    };
    assert_close(&asked(None, None, &[]), &[1.0, 1.0, 0.5, 0.0]);
    assert_close(&asked(Some(2), None, &[]), &[1.0, 1.0, 0.5, 0.0]);
    for (superlative, relations) in [(largest, &[][..]), (None, &closest[..])] {
        let all = asked(None, superlative, relations);
        let one = asked(Some(1), superlative, relations);
        let two = asked(Some(2), superlative, relations);
        assert!(all[2] > 0.0 && one[2] == all[2], "{superlative:?} {all:?} {one:?}");
        assert_eq!(two[2], 0.0, "{superlative:?} {two:?}");
        assert!(two[0].max(two[1]) > 0.9, "{superlative:?} {two:?}");
    }
}

#[test]
fn keep_best_also_keeps_near_ties_with_the_last() {
    let left = |count, scores: &[f32]| {
        let mut scores = scores.to_vec();
        keep_best(count, &mut scores);
        scores
    };
    // 0.95 · 0.86 = 0.817.
    assert_close(&left(2, &[0.9, 0.5, 0.86, 0.1]), &[0.9, 0.0, 0.86, 0.0]);
    assert_close(&left(2, &[0.9, 0.82, 0.86, 0.81]), &[0.9, 0.82, 0.86, 0.0]);
    assert_eq!(left(2, &[1.0, 1.0, 0.95]), [1.0, 1.0, 0.95]);
    assert_close(&left(9, &[0.9, 0.1]), &[0.9, 0.1]);
}

#[test]
fn own_fits_multiply_noun_colors_and_traits() {
    let small = named(3, "lamp", [4.0, 0.0], [0.1, 0.1, 0.2], 0.0);
    let room = [red(1.0, lamp(1, 0.0)), red(0.3, lamp(2, 2.0)), red(0.3, small), desk(4, 9.0)];
    let (colors, traits) = (vec![ColorName::Red], vec![Trait::Large]);
    let of = |phrase: &Phrase| with_assessor(&room, |assessor| assessor.own_fits(phrase));
    let (nouns, own) = of(&Phrase { colors: colors.clone(), ..noun_phrase("lamp") });
    assert_close(&nouns, &[1.0, 1.0, 1.0, 0.0]);
    assert_close(&own, &[1.0, 0.5, 0.5, 0.0]);
    // The small one is not large: 0.3.
    assert_close(&of(&Phrase { colors, traits, ..noun_phrase("lamp") }).1, &[1.0, 0.5, 0.15, 0.0]);
}

#[test]
fn excluded_nouns_lower_the_fit_where_names_distinguish() {
    // "The stool that is not the bar stool": the plain one is a bar stool by 0.7, so the other
    // is one by 0.3 more, 1 - 0.95 · 0.3.
    let stool = |id, name| named(id, name, [id as f32, 0.0], [0.4; 3], 0.0);
    let room = [stool(1, "bar stool"), stool(2, "stool"), stool(3, "kettle")];
    let phrase = Phrase { other_things: vec!["bar stool".into()], ..noun_phrase("stool") };
    let (nouns, own) = with_assessor(&room, |assessor| assessor.own_fits(&phrase));
    assert_close(&[own[0] / nouns[0], own[1] / nouns[1], own[2]], &[0.715, 1.0, 0.0]);
    // All plausible instances are bar stools: names do not distinguish them.
    let room = [stool(1, "bar stool"), stool(2, "bar stool")];
    let (nouns, own) = with_assessor(&room, |assessor| assessor.own_fits(&phrase));
    assert_eq!(own, nouns);
    // Another kind of object keeps almost nothing: 1 - 0.95.
    let room = [stool(1, "kettle"), stool(2, "lamp")];
    let other = Phrase { other_things: vec!["kettle".into()], ..noun_phrase("thing") };
    let (nouns, own) = with_assessor(&room, |assessor| assessor.own_fits(&other));
    assert_close(&[own[0] / nouns[0], own[1] / nouns[1]], &[0.05, 1.0]);
}

#[test]
fn likely_keeps_instances_with_at_least_half_of_the_best_fit() {
    let room = |shares: [f32; 3]| {
        let [a, b, c] = shares;
        [red(a, lamp(1, 0.0)), red(b, lamp(2, 2.0)), red(c, lamp(3, 4.0)), desk(4, 9.0)]
    };
    let asked = Phrase { colors: vec![ColorName::Red], ..noun_phrase("lamp") };
    let likely =
        |shares, most| with_assessor(&room(shares), |assessor| assessor.likely(&asked, most));
    // Fits of 0.5, 0.26667 and 0.23333: 0.53333 and 0.46667 of the best.
    let found = likely([0.14, 0.3, 0.16], 9);
    assert_eq!(found.iter().map(|f| f.0).collect::<Vec<_>>(), [1, 2], "{found:?}");
    assert_close(&[found[0].1, found[1].1], &[1.0, 0.533_333]);
    assert_eq!(likely([0.14, 0.3, 0.16], 1), [(1, 1.0)]);
    // Exactly half is enough.
    assert_eq!(likely([1.0, 0.3, 0.0], 9), [(0, 1.0), (1, 0.5)]);
    let room = room([1.0, 0.3, 0.0]);
    with_assessor(&room, |assessor| {
        assert_eq!(assessor.best(&asked), Some(0));
        assert_eq!(assessor.best(&noun_phrase("desk")), Some(3));
        assert_eq!(assessor.best(&noun_phrase("piano")), None);
        assert_eq!(assessor.likely(&noun_phrase("piano"), 9), []);
    });
}

#[test]
fn mean_position_averages_the_instance_centers() {
    let high = named(3, "lamp", [4.0, 3.0], [0.2, 0.2, 0.4], 3.0);
    let room = [lamp(1, 0.0), lamp(2, 2.0), high, desk(4, 90.0)];
    with_assessor(&room, |assessor| {
        // (0 + 2 + 4) / 3, (0 + 0 + 3) / 3, (0.2 + 0.2 + 3.2) / 3.
        let middle = assessor.mean_position(&noun_phrase("lamp")).unwrap();
        assert_close(middle.coords.as_slice(), &[2.0, 1.0, 1.2]);
        assert_eq!(assessor.mean_position(&noun_phrase("piano")), None);
    });
}

#[test]
fn dismissed_walls_are_not_part_of_the_room() {
    let gone = Instance { dismissed: true, ..wall(2, 4.0) };
    let floor = Instance {
        structure: Some(Structure::Floor),
        ..named(3, "floor", [0.0, 0.0], [8.0, 6.0, 0.1], 0.0)
    };
    let room = [wall(1, -4.0), gone, floor, lamp(4, 0.0)];
    with_assessor(&room, |assessor| {
        let room = assessor.room();
        let walls: Vec<f32> = room.walls.iter().map(|wall| wall.center.x).collect();
        assert_eq!(walls, [-4.0]);
        // From -4.05 to 4.05, and as high as the scan.
        let (long, short) = room.outline.sides();
        assert_close(&[long, short, room.outline.size[2]], &[8.1, 6.0, 2.6]);
    });
}

#[test]
fn anchor_counts_by_the_root_of_its_fit_and_is_never_the_target() {
    let room = [desk(1, 0.0), lamp_over(2, 0.0, 0.06), desk(3, 5.0)];
    let on = relation(RelationKind::On, &["desk"]);
    with_assessor(&room, |assessor| {
        let bond = |anchors: &[(usize, f32)]| assessor.best_match(&on, 1, anchors);
        // √0.25 · 0.5.
        let found = bond(&[(2, 1.0), (0, 0.25)]);
        assert_close(&[found.score], &[0.25]);
        assert_eq!(found.anchor, Some(InstanceId(1)));
        assert_eq!(bond(&[(1, 1.0)]), NO_BOND);
        assert_eq!(bond(&[]), NO_BOND);
    });
    let (low, high) = (
        RelationMatch { score: 0.2, anchor: None },
        RelationMatch { score: 0.3, anchor: Some(InstanceId(7)) },
    );
    assert_eq!((better_match(low, high), better_match(high, low)), (high, high));
    let other = RelationMatch { score: 0.3, anchor: None };
    assert_eq!(better_match(high, other), high, "the first of equals");
}

#[test]
fn anchor_pairs_have_a_lower_limit_than_single_anchors() {
    // The lamp stands on the twentieth of twenty desks, and between it and the one before.
    let mut room: Vec<Instance> = (1..=20).map(|id| desk(id, id as f32 * 4.0)).collect();
    room.push(lamp_over(21, 80.0, 0.0));
    room.push(lamp(22, 78.0));
    let mut fits = vec![0.0; 20];
    fits.extend([1.0, 1.0]);
    let on = scores(&room, &relation(RelationKind::On, &["desk"]), &fits);
    assert_close(&on[20..], &[1.0, 0.0]);
    let between = scores(&room, &relation(RelationKind::Between, &["desk"]), &fits);
    // Only the first sixteen desks are tried; the last of them is at 64 m.
    assert!(between[21] < 0.2, "{between:?}");
}

#[test]
fn supported_instances_at_a_wall_keep_thirty_percent_of_on() {
    let supported = |id, support| Instance { support, ..lamp(id, 0.0) };
    let room = [
        wall(1, 0.1),
        supported(2, Support::Floor),
        supported(3, Support::Instance { id: InstanceId(6) }),
        supported(4, Support::Wall { id: InstanceId(1) }),
        supported(5, Support::Nothing),
        desk(6, 0.0),
    ];
    with_assessor(&room, |assessor| {
        let hangs =
            |kind, anchor: usize| [1, 2, 3, 4].map(|t| assessor.hanging_factor(kind, t, anchor));
        assert_eq!(hangs(RelationKind::On, 0), [0.3, 0.3, 1.0, 1.0]);
        assert_eq!(hangs(RelationKind::On, 5), [1.0; 4]);
        assert_eq!(hangs(RelationKind::Leaning, 0), [1.0; 4]);
        // 0.9 for an instance flat against the wall, and 0.3 of that for a supported one.
        let bond = |t| assessor.best_match(&relation(RelationKind::On, &["wall"]), t, &[(0, 1.0)]);
        assert_close(&[bond(1).score, bond(3).score], &[0.27, 0.9]);
    });
}

#[test]
fn on_the_left_side_of_an_anchor_may_mean_on_top_of_it() {
    // A quarter of the desk's width to the left of its middle: half of the way to its end, a
    // half of which counts in full. 2 · 0.075 / 0.3.
    let room = [desk(1, 0.0), lamp_over(2, -0.075, 0.0)];
    let side = |kind, text: &str| {
        let relation = Relation { text: text.into(), ..relation(kind, &["desk"]) };
        with_assessor(&room, |assessor| {
            let own = assessor.score_on_side(&relation, 1, 0);
            (own, assessor.best_match(&relation, 1, &[(0, 1.0)]).score)
        })
    };
    let (own, bond) = side(RelationKind::LeftOf, "on the left side of");
    assert_close(&[own, bond], &[0.5, 0.5]);
    let (own, bond) = side(RelationKind::RightOf, "on the right side of");
    assert_close(&[own, bond], &[0.0, 0.0]);
    assert_eq!(side(RelationKind::LeftOf, "left of").0, 0.0);
    assert_eq!(side(RelationKind::InFrontOf, "on the front side of").0, 0.0);
    let room = [desk(1, 0.0), lamp_over(2, 0.075, 0.06)];
    with_assessor(&room, |assessor| {
        let text = "on the right of".to_owned();
        let relation = Relation { text, ..relation(RelationKind::RightOf, &["desk"]) };
        // Half on it: 0.5 · 0.5.
        assert_close(&[assessor.score_on_side(&relation, 1, 0)], &[0.25]);
    });
}

#[test]
fn targets_below_one_percent_fit_have_no_relation_match() {
    let room = [desk(1, 0.0), lamp_over(2, 0.0, 0.0), lamp_over(3, 0.0, 0.0)];
    let on = relation(RelationKind::On, &["desk"]);
    assert_close(&scores(&room, &on, &[0.0, 0.01, 0.009_9]), &[0.0, 1.0, 0.0]);
    assert_eq!(anchors(&room, &on, &[0.0, 0.01, 0.009_9]), [None, Some(1), None]);
}

#[test]
fn negated_relation_scores_one_minus_the_relation() {
    let room = [desk(1, 0.0), lamp_over(2, 0.0, 0.06), lamp(3, 5.0)];
    let on = Relation { negated: true, ..relation(RelationKind::On, &["desk"]) };
    assert_close(&scores(&room, &on, &[0.0, 1.0, 1.0]), &[1.0, 0.5, 1.0]);
}

#[test]
fn relation_must_hold_for_all_anchors() {
    let shelf = named(2, "shelf", [0.0, 0.0], [0.6, 0.8, 0.97], 0.0);
    let room = [desk(1, 0.0), shelf, lamp_over(3, 0.0, 0.0)];
    // On the desk, and 3 cm above the shelf: 1 · 1 / (1 + 1/4).
    let both = relation(RelationKind::On, &["desk", "shelf"]);
    assert_close(&scores(&room, &both, &[0.0, 0.0, 1.0]), &[0.0, 0.0, 0.8]);
    assert_eq!(anchors(&room, &both, &[0.0, 0.0, 1.0]), [None, None, Some(1)]);
}

#[test]
fn between_uses_two_distinct_anchors_other_than_the_target() {
    let room = [desk(1, 0.0), lamp(2, 2.0), named(3, "door", [4.0, 0.0], [0.6, 0.8, 1.0], 0.0)];
    let between = relation(RelationKind::Between, &["desk", "door"]);
    assert_close(&scores(&room, &between, &[0.0, 1.0, 0.0]), &[0.0, 1.0, 0.0]);
    assert_eq!(anchors(&room, &between, &[0.0, 1.0, 0.0]), [None, Some(1), None]);
    let pair = |room: &[Instance], t, a: &[(usize, f32)], b: &[(usize, f32)]| {
        with_assessor(room, |assessor| assessor.match_between(t, a, b))
    };
    // √(0.25 · 1) · 1.
    assert_close(&[pair(&room, 1, &[(0, 0.25)], &[(2, 1.0)]).score], &[0.5]);
    assert_close(&[pair(&room, 1, &[(0, 0.25)], &[(2, 0.16)]).score], &[0.2]);
    // Two of one kind: "between the desks".
    let two = [desk(1, 0.0), lamp(2, 2.0), desk(3, 4.0)];
    let of_one = relation(RelationKind::Between, &["desk"]);
    assert_close(&scores(&two, &of_one, &[0.0, 1.0, 0.0]), &[0.0, 1.0, 0.0]);
    // 0.35 · 4 m + 0.2 m aside.
    let aside = Instance {
        given_name: Some("lamp".into()),
        ..thing(2, [2.0, 1.6], [0.2, 0.2, 0.4], 0.0, Support::Floor, [90; 3])
    };
    assert_close(
        &scores(&[desk(1, 0.0), aside, desk(3, 4.0)], &of_one, &[0.0, 1.0, 0.0])[1..2],
        &[0.5],
    );
    // One of two anchors is the target: no pair is left.
    let near = [lamp(1, 0.0), lamp(2, 0.1), lamp(3, 4.0)];
    let both = [(0, 1.0), (1, 1.0)];
    assert_eq!(pair(&near, 1, &both, &both), NO_BOND);
    assert_eq!(pair(&near, 1, &both[..1], &both[1..]), NO_BOND);
    assert_eq!(pair(&near, 1, &both[1..], &both[..1]), NO_BOND);
}

#[test]
fn relations_to_the_room_have_no_anchor() {
    // Between walls 10 m apart; 0.5 m to the one at +X: 1 / (1 + (0.5 / 0.3)²).
    let room = [wall(1, -5.0), wall(2, 5.0), lamp(3, 5.0 - 0.05 - 0.5 - 0.1), lamp(4, 0.0)];
    let against = relation(RelationKind::AgainstWall, &[]);
    let found = scores(&room, &against, &[0.0, 0.0, 1.0, 0.0]);
    assert_close(&found, &[0.0, 0.0, 0.264_706, 0.0]);
    assert_eq!(anchors(&room, &against, &[0.0, 0.0, 1.0, 0.0]), [None; 4]);
    // "Near" without an anchor lowers no score.
    assert_close(
        &scores(&room, &relation(RelationKind::Near, &[]), &[0.0, 0.0, 1.0, 0.0]),
        &[1.0; 4],
    );
}

#[test]
fn unknown_anchors_keep_the_score_and_missing_ones_thirty_percent() {
    let room = [desk(1, 0.0), lamp(2, 3.0)];
    let of = |anchor: &str| scores(&room, &relation(RelationKind::On, &[anchor]), &[0.0, 1.0]);
    assert_close(&of("zorblax"), &[1.0, 1.0]);
    assert_close(&of("piano"), &[0.3, 0.3]);
    assert_close(&of("desk"), &[0.0, 0.0]);
    // Of several anchors, the least certain one counts.
    let both = relation(RelationKind::On, &["zorblax", "piano"]);
    assert_close(&scores(&room, &both, &[0.0, 1.0]), &[0.3, 0.3]);
}

#[test]
fn unchecked_factor_is_one_for_unknown_words_and_lower_for_missing_instances() {
    let found = |fit: f32| Assessment {
        nouns: vec![0.0, fit],
        own: Vec::new(),
        bonds: Vec::new(),
        place_seen_by: Vec::new(),
        total: Vec::new(),
    };
    let share = |heads: &[&str], fits: &[f32]| {
        let phrases: Vec<Phrase> = heads.iter().map(|head| noun_phrase(head)).collect();
        let assessed: Vec<Assessment> = fits.iter().map(|fit| found(*fit)).collect();
        unchecked_factor(&phrases, &assessed, 0.3)
    };
    assert_eq!(share(&["desk"], &[0.05]), None);
    assert_eq!(share(&["desk"], &[0.049]), Some(0.3));
    assert_eq!(share(&["zorblax"], &[0.049]), Some(1.0));
    assert_eq!(share(&["zorblax"], &[0.05]), None);
    assert_eq!(share(&["desk", "zorblax"], &[1.0, 0.0]), Some(1.0));
    assert_eq!(share(&["desk", "zorblax"], &[0.0, 0.0]), Some(0.3));
    assert_eq!(share(&[], &[]), None);
}

#[test]
fn indefinite_anchor_may_be_an_instance_that_was_not_found() {
    let on = |hovers: f32, indefinite, negated| {
        let room = [desk(1, 0.0), lamp_over(2, 0.0, hovers), lamp(3, 6.0)];
        let anchors = vec![Phrase { indefinite, ..noun_phrase("desk") }];
        let on = Relation { anchors, negated, ..relation(RelationKind::On, &[]) };
        scores(&room, &on, &[0.0, 1.0, 1.0])
    };
    // 12 cm above scores 0.2: not a match. 6 cm above scores 0.5: a match.
    assert_close(&on(0.12, true, false), &[0.3; 3]);
    assert_close(&on(0.06, true, false), &[0.0, 0.5, 0.0]);
    assert_close(&on(0.12, false, false), &[0.0, 0.2, 0.0]);
    assert_close(&on(0.12, true, true), &[1.0, 0.8, 1.0]);
}

#[test]
fn side_of_a_missing_anchor_ranks_targets_along_that_side() {
    let room = [lamp(1, 2.0), lamp(2, -1.0), lamp(3, 0.0), desk(4, -9.0)];
    let fits = [1.0, 1.0, 1.0, 0.0];
    let of = |kind, anchor: &str, negated| {
        scores(&room, &Relation { negated, ..relation(kind, &[anchor]) }, &fits)
    };
    // Each rank away multiplies by 0.45.
    assert_close(&of(RelationKind::LeftOf, "zorblax", false), &[0.202_5, 1.0, 0.45, 0.0]);
    assert_close(&of(RelationKind::RightOf, "zorblax", false), &[1.0, 0.202_5, 0.45, 0.0]);
    assert_close(&of(RelationKind::RightOf, "piano", false), &[0.3, 0.060_75, 0.135, 0.0]);
    assert_close(&of(RelationKind::RightOf, "piano", true), &[0.0, 0.239_25, 0.165, 0.0]);
    assert_close(&of(RelationKind::Behind, "piano", false), &[0.3; 4]);
}

#[test]
fn zone_score_falls_with_distance_from_its_instances() {
    // Half at 1.5 m from the stove; surfaces touch at 0.3 m + 0.1 m.
    let stove = |id, x| named(id, "stove", [x, 0.0], [0.6, 0.6, 0.9], 0.0);
    let room = [stove(1, 0.0), lamp(2, 1.9), lamp(3, 3.4), lamp(4, 0.4)];
    let kitchen = |negated| Relation { negated, ..relation(RelationKind::Inside, &["kitchen"]) };
    let fits = [0.0, 1.0, 1.0, 0.009];
    assert_close(&scores(&room, &kitchen(false), &fits), &[0.0, 0.5, 0.2, 0.0]);
    assert_close(&scores(&room, &kitchen(true), &fits), &[1.0, 0.5, 0.8, 1.0]);
    assert_close(&scores(&room, &kitchen(false), &[0.0, 0.01, 0.0, 0.0]), &[0.0, 0.5, 0.0, 0.0]);
    // Of two stoves, the nearer one counts.
    let room = [stove(1, 0.0), lamp(2, 1.9), stove(3, 2.3)];
    assert_close(&scores(&room, &kitchen(false), &[0.0, 1.0, 0.0])[1..2], &[1.0]);
    // Without a stove the zone changes no score, negated or not.
    let room = [desk(1, 0.0), lamp(2, 1.9)];
    assert_close(&scores(&room, &kitchen(false), &[0.0, 1.0]), &[1.0, 1.0]);
    assert_close(&scores(&room, &kitchen(true), &[0.0, 1.0]), &[1.0, 1.0]);
}

#[test]
fn zones_do_not_extend_through_walls() {
    let stove = named(1, "stove", [0.0, 0.0], [0.6, 0.6, 0.9], 0.0);
    // Far away the gap is the one between circles: 7.914 - (0.8485 + 0.2828) / 2 = 7.3483 m,
    // 1 / (1 + (7.3483 / 1.5)²) = 0.04, less than the factor of a wall.
    let room = [stove, lamp(2, 1.9), lamp(3, 7.914), wall(4, 1.0)];
    let kitchen = relation(RelationKind::Inside, &["kitchen"]);
    let found = scores(&room, &kitchen, &[0.0, 1.0, 1.0, 0.0]);
    assert_close(&found, &[0.0, 0.05, 0.04, 0.0]);
}

#[test]
fn closest_and_farthest_rank_by_distance() {
    let room = [desk(1, 0.0), lamp(2, 3.0), lamp(3, -2.0), lamp(4, 5.0)];
    let of = |kind, rank| {
        let relation = Relation { rank, ..relation(kind, &["desk"]) };
        scores(&room, &relation, &[0.0, 1.0, 1.0, 1.0])
    };
    assert_close(&of(RelationKind::Closest, 1), &[0.0, 0.45, 1.0, 0.202_5]);
    assert_close(&of(RelationKind::Closest, 2), &[0.0, 1.0, 0.45, 0.45]);
    assert_close(&of(RelationKind::Closest, 3), &[0.0, 0.45, 0.202_5, 1.0]);
    assert_close(&of(RelationKind::Closest, 0), &[0.0, 0.45, 1.0, 0.202_5]);
    assert_close(&of(RelationKind::Farthest, 1), &[0.0, 0.45, 0.202_5, 1.0]);
    assert_close(&of(RelationKind::Farthest, 2), &[0.0, 1.0, 0.45, 0.45]);
}

#[test]
fn closest_excludes_the_anchor_and_counts_by_the_root_of_its_fit() {
    let room = [desk(1, 0.0), lamp(2, 3.0), lamp(3, 2.0)];
    let closest = relation(RelationKind::Closest, &["desk"]);
    with_assessor(&room, |assessor| {
        let found = assessor.match_by_distance(&closest, &[1.0; 3], &[vec![(0, 0.25)]]);
        // √0.25 · 1 and · 0.45.
        assert_close(&found.iter().map(|bond| bond.score).collect::<Vec<_>>(), &[0.0, 0.225, 0.5]);
        assert_eq!(found[2].anchor, Some(InstanceId(1)));
        assert_eq!(assessor.match_by_distance(&closest, &[1.0; 3], &[]), [NO_BOND; 3]);
        // Another desk may be meant: the better of both counts.
        let found =
            assessor.match_by_distance(&closest, &[0.0, 1.0, 1.0], &[vec![(0, 0.25), (1, 1.0)]]);
        assert_close(&[found[2].score], &[1.0]);
        assert_eq!(found[2].anchor, Some(InstanceId(2)));
    });
}

#[test]
fn closest_to_several_anchors_has_the_smallest_distance_sum() {
    // From desks at 0 and 4: 3 + 3 for the one, 2 + 5 for the other.
    let at = |id, x, y| named(id, "lamp", [x, y], [0.2, 0.2, 0.4], 0.0);
    let room = [
        desk(1, 0.0),
        desk(2, 4.0),
        at(3, 2.0, 2.236_068),
        at(4, -0.625, 1.899_836),
        desk(5, 40.0),
    ];
    let closest = relation(RelationKind::Closest, &["desk", "desk"]);
    let of = |others: &[(usize, f32)]| {
        let anchors = [vec![(0, 1.0)], others.to_vec()];
        with_assessor(&room, |assessor| {
            let found = assessor.match_by_distance(&closest, &[1.0, 1.0, 1.0, 1.0, 0.0], &anchors);
            found.iter().map(|bond| bond.score).collect::<Vec<_>>()
        })
    };
    assert_close(&of(&[(1, 1.0)]), &[0.0, 0.0, 1.0, 0.45, 0.0]);
    // The likeliest of the others counts, of equals the first.
    assert_close(&of(&[(1, 1.0), (4, 0.9)]), &[0.0, 0.0, 1.0, 0.45, 0.0]);
    assert_close(&of(&[(1, 1.0), (4, 1.0)]), &[0.0, 0.0, 1.0, 0.45, 0.0]);
}

#[test]
fn what_an_instance_carries_is_closest_to_it() {
    let room = [desk(1, 0.0), lamp_over(2, 0.0, 0.0), lamp(3, 2.0), lamp(4, 3.0)];
    let of = |kind| scores(&room, &relation(kind, &["desk"]), &[0.0, 1.0, 1.0, 1.0]);
    assert_close(&of(RelationKind::Closest), &[0.0, 1.0, 0.45, 0.202_5]);
    assert_close(&of(RelationKind::Farthest), &[0.0, 0.202_5, 0.45, 1.0]);
    // Two on it: the nearer to its middle first.
    let room = [desk(1, 0.0), lamp_over(2, 0.1, 0.0), lamp_over(3, 0.0, 0.0)];
    let closest = relation(RelationKind::Closest, &["desk"]);
    assert_close(&scores(&room, &closest, &[0.0, 1.0, 1.0]), &[0.0, 0.45, 1.0]);
    // A lamp 12 cm above the desk is not carried.
    let room = [desk(1, 0.0), lamp_over(2, 0.0, 0.12), lamp(3, 2.0)];
    assert_close(&scores(&room, &closest, &[0.0, 1.0, 1.0]), &[0.0, 1.0, 0.45]);
    // A picture on the wall touches it and is the closest to it.
    let picture = named(2, "lamp", [0.15, 2.5], [0.1, 0.4, 0.4], 1.0);
    let room = [wall(1, 0.0), picture, lamp(3, 1.0)];
    let closest = relation(RelationKind::Closest, &["wall"]);
    assert_close(&scores(&room, &closest, &[0.0, 1.0, 1.0]), &[0.0, 1.0, 0.45]);
}

#[test]
fn me_refers_to_the_observer_and_is_ignored_without_one() {
    let room = [lamp(1, 1.0), lamp(2, 3.0), lamp(3, -2.0), desk(4, 0.0)];
    let fits = [1.0, 1.0, 1.0, 0.0];
    let of = |kind, negated, observer: bool| {
        with_assessor(&room, |assessor| {
            // At the origin, looking along +X: left is +Y, ahead is +X.
            assessor.observer = observer.then(|| {
                Aabb { center: Point3::new(0.0, 0.0, 0.2), size: Vector3::zeros() }.into()
            });
            assessor.directions = Directions::looking_along(Vector3::x()).unwrap();
            let relation = Relation { negated, ..relation(kind, &[ME]) };
            assessor.match_relation(&relation, &fits)
        })
    };
    let scores = |kind, negated| {
        let found = of(kind, negated, true);
        assert!(found.iter().all(|bond| bond.anchor.is_none()), "{found:?}");
        found.iter().map(|bond| bond.score).collect::<Vec<_>>()
    };
    assert_eq!(
        of(RelationKind::Closest, false, false),
        [RelationMatch { score: 1.0, anchor: None }; 4]
    );
    assert_close(&scores(RelationKind::Closest, false), &[1.0, 0.202_5, 0.45, 0.0]);
    assert_close(&scores(RelationKind::Closest, true), &[0.0, 0.797_5, 0.55, 1.0]);
    assert_close(&scores(RelationKind::Farthest, false), &[0.202_5, 1.0, 0.45, 0.0]);
    // The first is 0.9 m ahead; near halves at 0.3 m + 0.25 · 0.2828 m / 2 = 0.335355 m:
    // 1 / (1 + 7.2022) = 0.121918; 0.4 + 0.6 · 0.121918.
    let ahead = scores(RelationKind::InFrontOf, false);
    assert_close(&[ahead[0], ahead[2], ahead[3]], &[0.473_151, 0.0, 0.0]);
    let back = scores(RelationKind::Behind, false);
    assert_close(&back[..2], &[0.0, 0.0]);
    assert!(back[2] > 0.4 && back[3] == 0.0, "{back:?}");
}

#[test]
fn targets_below_one_percent_fit_have_no_relation_to_the_observer() {
    let room = [lamp(1, 1.0), lamp(2, 1.0)];
    with_assessor(&room, |assessor| {
        assessor.directions = Directions::looking_along(Vector3::x()).unwrap();
        let me = Aabb { center: Point3::new(0.0, 0.0, 0.2), size: Vector3::zeros() }.into();
        let ahead = relation(RelationKind::InFrontOf, &[ME]);
        let found = assessor.match_to_observer(&ahead, &me, &[0.01, 0.009_9]);
        assert_close(&[found[0].score, found[1].score], &[0.473_151, 0.0]);
    });
}

#[test]
fn side_score_reports_whose_view_decided() {
    // By the viewer's convention, from the open middle of the room: straight to the right.
    let room = [desk(1, 0.0), lamp(2, 2.0)];
    with_assessor(&room, |assessor| {
        assessor.directions = Directions::looking_along(Vector3::y()).unwrap();
        let (right, by) = assessor.at_side(RelationKind::RightOf, 1, 0);
        assert!(right > 0.4 && by == SeenBy::Directions, "{right} {by:?}");
        assert_eq!(assessor.at_side(RelationKind::RightOf, 0, 1).0, 0.0);
        assert_eq!(assessor.geometry(RelationKind::RightOf, 1, &[0]), right);
        assert_eq!(assessor.id(1), InstanceId(2));
    });
}

#[test]
fn superlative_multiplies_the_total() {
    let large = named(2, "lamp", [4.0, 0.0], [0.4, 0.4, 0.8], 0.0);
    let room = [red(0.3, lamp(1, 0.0)), red(0.3, large), desk(3, 9.0)];
    let superlative = Some(Superlative { measure: Measure::Largest, rank: 1 });
    let phrase = Phrase { colors: vec![ColorName::Red], superlative, ..noun_phrase("lamp") };
    with_assessor(&room, |assessor| {
        let found = assessor.assess(&phrase);
        assert_close(&found.own, &[0.5, 0.5, 0.0]);
        assert_close(&found.total, &[0.225, 0.5, 0.0]);
        assert_eq!(found.place_seen_by, [SeenBy::Directions; 3]);
    });
}
