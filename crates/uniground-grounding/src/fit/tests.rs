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
    let chairs = [chair(1), Instance { given_name: Some("chair".into()), ..sized(2, [0.1; 3]) }];
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
    assert_close(&with_scene(&room, |scene| noun_fits(scene, &noun_phrase("chair"))), &[1.0, 0.0]);
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
    assert_close(&[color_of(&colored(chair(1), &[(Brown, 1.0)]), &wooden("wooden", &[]))], &[1.0]);
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
