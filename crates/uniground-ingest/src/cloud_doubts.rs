//! Names what is odd about the points and colors of a scan's own cloud.

use super::clouds::LoadedCloud;
use uniground_geometry::statistics::quantile;
use uniground_geometry::{Point3, Vector3};
use uniground_types::findings::{Finding, FindingSubject};

/// Share of points at exactly the origin from which they are invalid ones.
const MANY_AT_ORIGIN: f64 = 0.01;
/// Colors below this level are nearly black; and the shares of nearly black and of black points
/// from which they are named.
const NEARLY_BLACK: u8 = 20;
const MANY_NEARLY_BLACK: f64 = 0.95;
const MANY_BLACK: f64 = 0.2;
/// Number of points that the shape is measured with.
const SAMPLE: usize = 200_000;
/// Share of the points on each side of each axis that may be outliers.
const OUTLIERS: f32 = 0.005;
/// Points are far away beyond this many sizes of the rest around it.
const FAR: f32 = 1.0;
/// Number of slices along an axis, and the number of neighboring empty ones that part a cloud.
const SLICES: usize = 100;
const EMPTY: usize = 40;
/// Share of the points that a part has at least.
const PART: f32 = 0.05;

/// Returns what is odd about a cloud. Lengths are in the files' units.
pub(super) fn find(loaded: &LoadedCloud) -> Vec<Finding> {
    let LoadedCloud { cloud, has_color, offset, .. } = loaded;
    let mut doubts = Vec::new();
    let at_origin = cloud.positions.iter().filter(|p| p.coords == Vector3::zeros()).count();
    if *offset == [0.0; 3]
        && at_origin > 1
        && at_origin as f64 > MANY_AT_ORIGIN * cloud.len() as f64
    {
        let text =
            format!("{at_origin} points are at exactly 0 0 0, which often marks invalid ones");
        doubts.push(Finding::unusual(FindingSubject::Cloud, text).counting(at_origin));
    }
    let core = Core::of(&cloud.positions);
    doubts.extend(core.find_outliers(&cloud.positions));
    doubts.extend(core.find_parts(&cloud.positions));
    if *has_color && cloud.len() > 1 {
        doubts.extend(doubt_colors(&cloud.colors));
    }
    doubts
}

fn doubt_colors(colors: &[[u8; 3]]) -> Option<Finding> {
    let count =
        |holds: fn(u8) -> bool| colors.iter().filter(|c| c.iter().all(|v| holds(*v))).count();
    let (nearly, black) = (count(|v| v < NEARLY_BLACK), count(|v| v == 0));
    let share = |count: usize| count as f64 / colors.len() as f64;
    let text = if colors.iter().all(|color| *color == colors[0]) {
        "all points have the same color".to_owned()
    } else if share(nearly) > MANY_NEARLY_BLACK {
        "nearly all points are black: check the range of the colors".to_owned()
    } else if colors.iter().all(|[r, g, b]| r == g && g == b) {
        "all points are gray: questions about colors cannot be answered".to_owned()
    } else if share(black) > MANY_BLACK {
        format!(
            "{:.0}% of the points are exactly black, which often marks points without a color",
            share(black) * 100.0
        )
    } else {
        return None;
    };
    Some(Finding::unusual(FindingSubject::Color, text))
}

/// The box around all points but outliers.
pub(super) struct Core {
    low: [f32; 3],
    high: [f32; 3],
}

impl Core {
    /// Measures a sample of at least one point.
    pub fn of(points: &[Point3<f32>]) -> Self {
        let end = |axis: usize, share: f32| {
            quantile(&mut sample(points).map(|p| p[axis]).collect::<Vec<f32>>(), share)
                .unwrap_or(0.0)
        };
        Self {
            low: [0, 1, 2].map(|axis| end(axis, OUTLIERS)),
            high: [0, 1, 2].map(|axis| end(axis, 1.0 - OUTLIERS)),
        }
    }

    /// Returns the longest side.
    pub fn longest(&self) -> f32 {
        (0..3).map(|axis| self.high[axis] - self.low[axis]).fold(0.0, f32::max)
    }

    fn find_outliers(&self, points: &[Point3<f32>]) -> Option<Finding> {
        let beyond = |p: &Point3<f32>| {
            (0..3).map(|i| (self.low[i] - p[i]).max(p[i] - self.high[i])).fold(0.0, f32::max)
        };
        let limit = FAR * self.longest();
        let far: Vec<f32> = points.iter().map(beyond).filter(|by| *by > limit).collect();
        let farthest = far.iter().copied().fold(0.0, f32::max);
        let text = format!(
            "{} points lie far from all others (up to {farthest:.1}, where the rest is {:.1} across): remove them if they are errors",
            far.len(),
            self.longest()
        );
        (!far.is_empty() && limit > 0.0)
            .then(|| Finding::unusual(FindingSubject::Cloud, text).counting(far.len()))
    }

    fn find_parts(&self, points: &[Point3<f32>]) -> Option<Finding> {
        (0..3).find_map(|axis| {
            let length = self.high[axis] - self.low[axis];
            let mut counts = [0_u32; SLICES];
            for point in sample(points) {
                let at = (point[axis] - self.low[axis]) / length * SLICES as f32;
                if (0.0..=SLICES as f32).contains(&at) {
                    counts[(at as usize).min(SLICES - 1)] += 1;
                }
            }
            let total: u32 = counts.iter().sum();
            // The longest row of empty slices.
            let empty = counts.chunk_by(|a, b| (*a == 0) == (*b == 0)).fold(
                (0, 0, 0),
                |(at, from, longest), slices| {
                    let is_longer = slices[0] == 0 && slices.len() > longest;
                    let best = if is_longer { (at, slices.len()) } else { (from, longest) };
                    (at + slices.len(), best.0, best.1)
                },
            );
            let (_, from, longest) = empty;
            let before: u32 = counts[..from].iter().sum();
            let least = PART * total as f32;
            let is_parted = total > 0
                && longest >= EMPTY
                && before as f32 >= least
                && (total - before) as f32 >= least;
            let text = format!(
                "the points are in two parts with {:.1} of empty space between them along {}: is this one scan, in one unit?",
                length * longest as f32 / SLICES as f32,
                ["x", "y", "z"][axis]
            );
            is_parted.then(|| Finding::unusual(FindingSubject::Cloud, text))
        })
    }
}

fn sample(points: &[Point3<f32>]) -> impl Iterator<Item = &Point3<f32>> {
    points.iter().step_by(points.len().div_ceil(SAMPLE).max(1))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Points of a flat, 5 long area.
    fn area() -> Vec<Point3<f32>> {
        (0..5000)
            .map(|i| Point3::new((i % 100) as f32 * 0.05, (i / 100) as f32 * 0.05, 0.0))
            .collect()
    }

    proptest! {
        #[test]
        fn far_points_are_counted(count in 1_usize..20, distance in 12.0_f32..1e4) {
            let mut points = area();
            prop_assert!(Core::of(&points).find_outliers(&points).is_none());
            points.extend((0..count).map(|i| Point3::new(0.0, distance, i as f32)));
            let found = Core::of(&points).find_outliers(&points).unwrap();
            prop_assert_eq!(found.count, Some(count as u64));
        }

        #[test]
        fn parts_are_told_by_the_space_between_them(gap in 6.0_f32..500.0, axis in 0_usize..3) {
            let points = area();
            prop_assert!(Core::of(&points).find_parts(&points).is_none());
            let both: Vec<Point3<f32>> = points
                .iter()
                .flat_map(|p| {
                    let mut other = *p;
                    other[axis] += 5.0 + gap;
                    [*p, other]
                })
                .collect();
            prop_assert!(Core::of(&both).find_parts(&both).is_some());
        }
    }

    #[test]
    fn degenerate_clouds_are_not_odd() {
        for points in [vec![Point3::origin()], vec![Point3::new(1.0, 2.0, 3.0); 50]] {
            let core = Core::of(&points);
            assert!(core.find_outliers(&points).is_none() && core.find_parts(&points).is_none());
        }
    }

    #[test]
    fn black_points_are_named_by_their_share() {
        let colors: Vec<[u8; 3]> =
            (0..100).map(|i| if i < 40 { [0; 3] } else { [90, 80, i] }).collect();
        assert!(doubt_colors(&colors).unwrap().text.starts_with("40% of the points"));
        assert!(doubt_colors(&colors[35..]).is_none());
    }
}
