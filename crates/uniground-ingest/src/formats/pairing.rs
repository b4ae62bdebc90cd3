//! Matches pictures and poses by name, number or time.

use camino::{Utf8Path, Utf8PathBuf};
use std::collections::BTreeMap;

/// Maximum time difference of pictures of the same moment, seconds.
pub(super) const SAME_MOMENT_S: f64 = 0.02;
/// Parts of names that state a file's role and not its moment.
const ROLES: [&str; 10] =
    ["color", "colour", "rgb", "depth", "pose", "image", "img", "conf", "confidence", "cam"];

/// Returns a sort key that puts `10` after `9`: the number first, then the name.
pub(super) fn natural_sort_key(file: &Utf8Path) -> (Option<u64>, String) {
    let stem = file.file_stem().unwrap_or_default();
    let digits: String = stem.chars().filter(char::is_ascii_digit).collect();
    (digits.parse().ok(), stem.to_owned())
}

/// Returns the last number of a name.
pub(super) fn last_number(file: &Utf8Path) -> Option<u64> {
    let stem = file.file_stem()?;
    let end = stem.rfind(|c: char| c.is_ascii_digit())? + 1;
    // Cut off from the end: the character before the number can be longer than a byte.
    let before = stem[..end].trim_end_matches(|c: char| c.is_ascii_digit());
    stem[before.len()..end].parse().ok()
}

/// Returns the time in a name, seconds: `1305031102.175304`, or nanoseconds, microseconds or
/// milliseconds since 1970.
pub(super) fn parse_seconds(file: &Utf8Path) -> Option<f64> {
    let stem = file.file_stem()?;
    let text = stem.trim_matches(|c: char| !c.is_ascii_digit());
    let text = text.rsplit(['_', '-']).next()?;
    text.parse().ok().map(to_seconds)
}

/// Converts a time since 1970 to seconds. Its size tells whether it is in nanoseconds, microseconds,
/// milliseconds or seconds.
pub(super) fn to_seconds(time: f64) -> f64 {
    match time {
        t if t > 1e17 => t * 1e-9,
        t if t > 1e14 => t * 1e-6,
        t if t > 1e11 => t * 1e-3,
        t => t,
    }
}

/// The times that count as seconds since 1970: from 2001 to 2100. Smaller ones count from the start
/// of the recording.
const SINCE_1970_S: std::ops::Range<f64> = 978_307_200.0..4_102_444_800.0;

/// Returns a time if it is in seconds since 1970; `None` if it counts from another start.
pub(super) fn since_1970(time_s: f64) -> Option<f64> {
    SINCE_1970_S.contains(&time_s).then_some(time_s)
}

/// Returns the name without the parts that state its role.
fn without_role(file: &Utf8Path) -> String {
    let mut stem = file.file_stem().unwrap_or_default().to_ascii_lowercase();
    for role in ROLES {
        stem = stem.replace(role, "");
    }
    stem.trim_matches(|c: char| !c.is_alphanumeric()).to_owned()
}

/// Finds for each file of `first` its match in `second`: by name, number or time, whichever gives
/// the most matches.
pub(super) fn match_files(first: &[Utf8PathBuf], second: &[Utf8PathBuf]) -> Vec<Option<usize>> {
    match_files_by(first, second).0
}

/// Returns the matches as [`match_files`] does, and what they were found by.
pub(super) fn match_files_by(
    first: &[Utf8PathBuf],
    second: &[Utf8PathBuf],
) -> (Vec<Option<usize>>, &'static str) {
    let by_name =
        match_by_key(first, second, |file| Some(without_role(file)).filter(|m| !m.is_empty()));
    let by_number = match_by_key(first, second, last_number);
    let times = |files: &[Utf8PathBuf]| -> Vec<Option<f64>> {
        files.iter().map(|f| parse_seconds(f)).collect()
    };
    let by_time = match_nearest_times(&times(first), &times(second), SAME_MOMENT_S);
    let found = |pairs: &Vec<Option<usize>>| pairs.iter().flatten().count();
    let mut best = (by_name, "name");
    for other in [(by_number, "number"), (by_time, "time")] {
        if found(&other.0) > found(&best.0) {
            best = other;
        }
    }
    best
}

fn match_by_key<K: Ord>(
    first: &[Utf8PathBuf],
    second: &[Utf8PathBuf],
    key: impl Fn(&Utf8Path) -> Option<K>,
) -> Vec<Option<usize>> {
    let mut at: BTreeMap<K, Option<usize>> = BTreeMap::new();
    for (i, file) in second.iter().enumerate() {
        if let Some(key) = key(file) {
            // A name that occurs twice matches neither.
            at.entry(key).and_modify(|only| *only = None).or_insert(Some(i));
        }
    }
    let mut taken = vec![false; second.len()];
    let mut partner = |file: &Utf8PathBuf| {
        let partner = at.get(&key(file)?).copied().flatten()?;
        (!std::mem::replace(&mut taken[partner], true)).then_some(partner)
    };
    first.iter().map(&mut partner).collect()
}

/// Finds for each of the first times the nearest of the second within reach. Uses none twice.
pub(super) fn match_nearest_times(
    first: &[Option<f64>],
    second: &[Option<f64>],
    within_s: f64,
) -> Vec<Option<usize>> {
    let mut order: Vec<(f64, usize)> = second
        .iter()
        .enumerate()
        .filter_map(|(i, t)| Some((t.filter(|t| t.is_finite())?, i)))
        .collect();
    order.sort_by(|a, b| a.0.total_cmp(&b.0));
    // The closest pairs are matched first, as in the association script of the TUM benchmark.
    let mut pairs: Vec<(f64, usize, usize)> = Vec::new();
    for (i, time) in first.iter().enumerate() {
        let Some(time) = time.filter(|t| t.is_finite()) else { continue };
        let after = order.partition_point(|(t, _)| *t < time);
        for (other, j) in &order[after.saturating_sub(2)..(after + 2).min(order.len())] {
            if (other - time).abs() <= within_s {
                pairs.push(((other - time).abs(), i, *j));
            }
        }
    }
    pairs.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)).then(a.2.cmp(&b.2)));
    let (mut found, mut taken) = (vec![None; first.len()], vec![false; second.len()]);
    for (_, i, j) in pairs {
        if found[i].is_none() && !taken[j] {
            found[i] = Some(j);
            taken[j] = true;
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn paths(names: &[&str]) -> Vec<Utf8PathBuf> {
        names.iter().map(Utf8PathBuf::from).collect()
    }

    #[test]
    fn files_are_matched_by_name_number_or_time() {
        for (first, second, expected) in [
            (["color/1.jpg", "color/10.jpg"], ["depth/10.png", "depth/1.png"], [Some(1), Some(0)]),
            (
                ["c/frame-000001.color.jpg", "c/frame-000002.color.jpg"],
                ["c/frame-000001.depth.pgm", "c/frame-000003.depth.pgm"],
                [Some(0), None],
            ),
            (
                ["rgb/img_7.png", "rgb/img_8.png"],
                ["depth/0007.png", "depth/0008.png"],
                [Some(0), Some(1)],
            ),
            (
                ["rgb/100.010.png", "rgb/100.045.png"],
                ["depth/100.020.png", "depth/100.100.png"],
                [Some(0), None],
            ),
            (
                ["rgb/1600000000010000000.png", "rgb/a.png"],
                ["depth/1600000000.012.png", "depth/b.png"],
                [Some(0), None],
            ),
        ] {
            assert_eq!(
                match_files(&paths(&first), &paths(&second)),
                expected,
                "{first:?} {second:?}"
            );
        }
    }

    #[test]
    fn numbers_behind_characters_of_any_alphabet_are_read() {
        for (name, number) in
            [("写真3.jpg", Some(3)), ("Menü12.jpg", Some(12)), ("7.png", Some(7)), ("ü.png", None)]
        {
            assert_eq!(last_number(name.into()), number, "{name}");
        }
    }

    proptest! {
        #[test]
        fn names_of_any_characters_never_panic(name in "\\PC{0,12}") {
            let file = Utf8Path::new(&name);
            let _ = (last_number(file), parse_seconds(file), natural_sort_key(file));
            let _ = match_files(&[file.to_owned()], &[file.to_owned()]);
        }

        #[test]
        fn no_time_is_matched_twice(a in prop::collection::vec(0.0_f64..3.0, 0..30), b in prop::collection::vec(0.0_f64..3.0, 0..30)) {
            let some = |times: &[f64]| times.iter().copied().map(Some).collect::<Vec<_>>();
            let found = match_nearest_times(&some(&a), &some(&b), 0.1);
            let mut partners: Vec<usize> = found.iter().flatten().copied().collect();
            partners.sort_unstable();
            let all = partners.len();
            partners.dedup();
            prop_assert_eq!(partners.len(), all);
            for (i, partner) in found.iter().enumerate() {
                prop_assert!(partner.is_none_or(|j| (a[i] - b[j]).abs() <= 0.1));
            }
        }
    }
}
