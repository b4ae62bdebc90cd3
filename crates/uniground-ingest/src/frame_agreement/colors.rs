//! Checks that the color pictures show what the depth pictures show: two frames that see the same
//! surface see similar colors there.

use super::name_frames;
use super::outliers::{median_agreement, remove_outliers};
use super::sketch::{FrameSketch, Tone};
use crate::scan::Scan;
use rayon::prelude::*;
use uniground_types::findings::{Finding, FindingSubject};

/// Maximum relative difference of depth at which two frames see the same surface.
pub(super) const SAME_SURFACE: f32 = 0.03;
/// Minimum number of shared points of two frames, and of a frame with all others.
const MIN_SHARED: u32 = 15;
const MIN_POINTS: u32 = 300;
/// Minimum standard deviation of brightness, and of red minus blue, levels. Below it, noise and the
/// white balance decide.
const MIN_SPREAD: f64 = 5.0;
const MIN_COLOR_SPREAD: f64 = 12.0;
/// Below this correlation of brightness, pictures do not show the same. Frames of correct scans
/// reach 0.5 to 0.99 with a median of 0.77 to 0.97; pictures of another moment, mirrored or rotated
/// ones, -0.3 to 0.4 with a median of 0 to 0.2.
const UNLIKE: f32 = 0.4;
/// Below this, a single frame stands out if it is also this much below the median.
const FRAME_UNLIKE: f32 = 0.3;
const BELOW_MEDIAN: f32 = 0.25;
/// Another scale of the pictures is named if it raises the median by this much.
const ZOOM_BETTER: f32 = 0.05;
/// Scales of the pictures that are tried: cropped ones, or intrinsics of another picture size.
const ZOOMS: [f32; 4] = [0.8, 0.87, 1.15, 1.25];
/// Below this correlation of red minus blue, the channels have another order. Correct scans: 0.5 to
/// 0.99.
const SWAPPED: f32 = -0.25;
/// The brightness of a picture with swapped channels is at most this much below the median.
const SWAPPED_BELOW_MEDIAN: f32 = 0.2;

/// How well two lists of values go along with each other: sums of products of the deviations from
/// the mean.
#[derive(Debug, Clone, Copy, Default)]
struct Covariance {
    ab: f64,
    aa: f64,
    bb: f64,
}

impl Covariance {
    fn of(pairs: &[(Tone, Tone)], value: impl Fn(&Tone) -> f32) -> Self {
        let mean = |side: fn(&(Tone, Tone)) -> &Tone| {
            pairs.iter().map(|pair| f64::from(value(side(pair)))).sum::<f64>() / pairs.len() as f64
        };
        let (mean_a, mean_b) = (mean(|pair| &pair.0), mean(|pair| &pair.1));
        pairs.iter().fold(Self::default(), |sum, (a, b)| {
            let (a, b) = (f64::from(value(a)) - mean_a, f64::from(value(b)) - mean_b);
            Self { ab: sum.ab + a * b, aa: sum.aa + a * a, bb: sum.bb + b * b }
        })
    }

    fn add(&mut self, other: Self) {
        self.ab += other.ab;
        self.aa += other.aa;
        self.bb += other.bb;
    }

    /// Returns the correlation, -1 to 1. `None` where one side hardly varies.
    fn correlation(&self, count: u32, min_spread: f64) -> Option<f32> {
        let least = min_spread * min_spread * f64::from(count);
        (self.aa >= least && self.bb >= least)
            .then(|| (self.ab / (self.aa * self.bb).sqrt()) as f32)
    }
}

/// Colors that were seen twice of the same points.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct SharedColors {
    points: u32,
    brightness: Covariance,
    red_minus_blue: Covariance,
}

impl SharedColors {
    /// Compares colors of two pictures. Exposure differs, so each picture's own mean is taken off.
    pub fn of(pairs: &[(Tone, Tone)]) -> Self {
        if (pairs.len() as u32) < MIN_SHARED {
            return Self::default();
        }
        Self {
            points: pairs.len() as u32,
            brightness: Covariance::of(pairs, |tone| tone.brightness),
            red_minus_blue: Covariance::of(pairs, |tone| tone.red_minus_blue),
        }
    }

    pub fn add(&mut self, other: Self) {
        self.points += other.points;
        self.brightness.add(other.brightness);
        self.red_minus_blue.add(other.red_minus_blue);
    }

    /// Returns the same comparison with the two sides swapped.
    fn reversed(mut self) -> Self {
        std::mem::swap(&mut self.brightness.aa, &mut self.brightness.bb);
        std::mem::swap(&mut self.red_minus_blue.aa, &mut self.red_minus_blue.bb);
        self
    }

    /// Returns the correlation of brightness. `None` if too little was compared.
    pub fn brightness(&self) -> Option<f32> {
        self.brightness.correlation(self.points, MIN_SPREAD).filter(|_| self.points >= MIN_POINTS)
    }

    /// Returns the correlation of red minus blue. `None` if the pictures are nearly gray.
    fn red_minus_blue(&self) -> Option<f32> {
        self.red_minus_blue
            .correlation(self.points, MIN_COLOR_SPREAD)
            .filter(|_| self.points >= MIN_POINTS)
    }

    /// Returns whether brightness goes along, but red minus blue in the opposite direction.
    pub fn has_swapped_channels(&self) -> bool {
        self.brightness().is_some_and(|alike| alike >= UNLIKE)
            && self.red_minus_blue().is_some_and(|alike| alike < SWAPPED)
    }

    /// Returns whether the colors are of different things.
    pub fn is_unlike(&self) -> bool {
        self.brightness().is_some_and(|alike| alike < UNLIKE)
    }
}

/// How the color pictures are taken.
#[derive(Debug, Clone, Copy, PartialEq)]
enum PictureChange {
    None,
    Mirrored,
    UpsideDown,
    Next,
    Previous,
    /// Enlarged around the middle by this factor.
    Zoomed(f32),
}

impl PictureChange {
    /// Returns the color of a pixel of a frame.
    fn tone(self, sketches: &[&FrameSketch], frame: usize, pixel: usize) -> Option<Tone> {
        let here = sketches[frame];
        let (width, last) = (here.width as usize, here.tones.len().checked_sub(1)?);
        let of = |frame: usize| {
            sketches.get(frame).filter(|other| other.tones.len() == here.tones.len())
        };
        match self {
            Self::None => Some(here.tones[pixel]),
            Self::Mirrored => Some(here.tones[pixel / width * width + width - 1 - pixel % width]),
            Self::UpsideDown => Some(here.tones[last - pixel]),
            Self::Zoomed(factor) => {
                let (column, row) = (pixel % width, pixel / width);
                let from = |at: usize, length: usize| {
                    let middle = (length as f32 - 1.0) / 2.0;
                    let at = (at as f32 - middle) / factor + middle;
                    (-0.5..length as f32 - 0.5).contains(&at).then(|| at.round() as usize)
                };
                let height = here.tones.len() / width;
                Some(here.tones[from(row, height)? * width + from(column, width)?])
            }
            Self::Next => Some(of(frame + 1)?.tones[pixel]),
            Self::Previous => Some(of(frame.checked_sub(1)?)?.tones[pixel]),
        }
    }
}

/// The colors that every two frames see of the same points. Row i, column j: points of frame j in
/// frame i.
struct ColorComparison(Vec<Vec<SharedColors>>);

impl ColorComparison {
    fn new(sketches: &[&FrameSketch], change: PictureChange) -> Self {
        let compare = |i: usize, j: usize| {
            let pairs: Vec<(Tone, Tone)> = sketches[j]
                .points
                .iter()
                .filter_map(|point| {
                    let seen = sketches[i].look_at(&point.position)?;
                    let tones = (
                        change.tone(sketches, i, seen.pixel)?,
                        change.tone(sketches, j, point.pixel)?,
                    );
                    (seen.farther.abs() <= SAME_SURFACE).then_some(tones)
                })
                .collect();
            SharedColors::of(&pairs)
        };
        let row = |i: usize| {
            let one = |j| if i == j { SharedColors::default() } else { compare(i, j) };
            (0..sketches.len()).map(one).collect()
        };
        Self((0..sketches.len()).into_par_iter().map(row).collect())
    }

    fn of_frame(&self, i: usize, used: &[bool]) -> SharedColors {
        let mut total = SharedColors::default();
        for j in (0..self.0.len()).filter(|&j| j != i && used[j]) {
            total.add(self.0[i][j]);
            // The frame's own colors are on the first side, so that a black picture is not compared.
            total.add(self.0[j][i].reversed());
        }
        total
    }

    fn median_brightness(&self, used: &[bool]) -> Option<f32> {
        median_agreement(used, |i, used| self.of_frame(i, used).brightness())
    }
}

/// Compares the color pictures of frames whose poses and depth fit each other, and adds findings
/// about pictures that do not fit. `is_complete`: the frames are all frames of the scan.
pub(super) fn check(
    scan: &Scan,
    sketches: &[&FrameSketch],
    is_complete: bool,
    findings: &mut Vec<Finding>,
) {
    let comparison = ColorComparison::new(sketches, PictureChange::None);
    let mut used = vec![true; sketches.len()];
    let Some(middle) = comparison.median_brightness(&used) else { return };
    if middle < UNLIKE {
        findings.push(all_unlike(sketches, middle, is_complete));
        return;
    }
    let zoomed = ZOOMS.into_iter().filter_map(|factor| {
        let changed = ColorComparison::new(sketches, PictureChange::Zoomed(factor));
        Some((changed.median_brightness(&used)?, factor))
    });
    if let Some((alike, factor)) = zoomed.max_by(|a, b| a.0.total_cmp(&b.0))
        && alike >= middle + ZOOM_BETTER
    {
        let text = format!(
            "the color pictures have another scale than the depth pictures: where two frames see the same surface, the correlation of their brightness is {middle:.2}; it would be {alike:.2} if the pictures were enlarged {factor} times. Were they cropped or resized? Check the intrinsics of the color camera"
        );
        findings.push(Finding::unusual(FindingSubject::Camera, text));
        return;
    }
    let mut wrong = remove_outliers(
        &mut used,
        |i, used| comparison.of_frame(i, used).brightness(),
        |lowest, middle| lowest < FRAME_UNLIKE.min(middle - BELOW_MEDIAN),
    );
    let opposite = remove_outliers(
        &mut used,
        |i, used| comparison.of_frame(i, used).red_minus_blue(),
        |lowest, _| lowest < SWAPPED,
    );
    // Swapped channels change the brightness little.
    let (swapped, other): (Vec<usize>, Vec<usize>) = opposite.into_iter().partition(|&i| {
        let brightness = comparison.of_frame(i, &used).brightness();
        brightness.is_none_or(|alike| alike >= middle - SWAPPED_BELOW_MEDIAN)
    });
    wrong.extend(other);
    wrong.sort_unstable();
    let named = |found: &[usize]| {
        let at: Vec<usize> = found.iter().map(|&i| sketches[i].at).collect();
        name_frames(scan, &at)
    };
    if !wrong.is_empty() {
        let text = format!(
            "the color pictures of {} of {} compared frames do not show what other frames show of the same surfaces: they are of another moment or scan, mirrored or rotated: {}",
            wrong.len(),
            sketches.len(),
            named(&wrong)
        );
        findings.push(Finding::unusual(FindingSubject::Frames, text).counting(wrong.len()));
    }
    if !swapped.is_empty() {
        let all = sketches.len();
        // Of two halves, nothing tells which is right.
        let which = match swapped.len() * 4 > all {
            true => "which ones, the pictures do not show".to_owned(),
            false => named(&swapped),
        };
        let text = format!(
            "red, green and blue seem to be in another order in {} of {all} compared color pictures than in the others (blue first, for example): {which}",
            swapped.len()
        );
        findings.push(Finding::unusual(FindingSubject::Frames, text).counting(swapped.len()));
    }
}

/// Describes color pictures that fit the depth nowhere, with the change that would make them fit.
fn all_unlike(sketches: &[&FrameSketch], middle: f32, is_complete: bool) -> Finding {
    let changes = [
        (PictureChange::Mirrored, "every color picture were mirrored left to right"),
        (PictureChange::UpsideDown, "every color picture were rotated by 180 degrees"),
        (PictureChange::Next, "every frame took the color picture of the next one"),
        (PictureChange::Previous, "every frame took the color picture of the previous one"),
    ];
    let everyone = vec![true; sketches.len()];
    let best = changes
        .into_iter()
        .filter(|(change, _)| {
            is_complete || !matches!(change, PictureChange::Next | PictureChange::Previous)
        })
        .filter_map(|(change, what)| {
            let changed = ColorComparison::new(sketches, change);
            Some((changed.median_brightness(&everyone)?, what))
        })
        .max_by(|a, b| a.0.total_cmp(&b.0))
        .filter(|(alike, _)| *alike >= UNLIKE.max(middle + BELOW_MEDIAN));
    let cause = match best {
        Some((alike, what)) => format!("it would be {alike:.2} if {what}"),
        None => {
            "they are of other moments or of another scan, rotated, or their intrinsics are wrong"
                .to_owned()
        }
    };
    let text = format!(
        "the color pictures do not fit the depth pictures: where two frames see the same surface, the correlation of their brightness is {middle:.2} (correct scans: 0.7 or more); {cause}"
    );
    Finding::unusual(FindingSubject::Frames, text)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn tone(brightness: f32) -> Tone {
        Tone { brightness, red_minus_blue: 255.0 - 2.0 * brightness }
    }

    proptest! {
        /// Another exposure changes nothing; another order does.
        #[test]
        fn exposure_does_not_matter(
            values in prop::collection::vec(0.0_f32..255.0, 400),
            gain in 0.3_f32..1.5,
            offset in -40.0_f32..40.0,
        ) {
            let pairs: Vec<_> = values.iter().map(|&v| (tone(v), tone(v * gain + offset))).collect();
            let same = SharedColors::of(&pairs);
            prop_assert!(same.brightness().unwrap() > 0.99 && !same.has_swapped_channels());
            let swapped: Vec<_> = pairs
                .iter()
                .map(|(a, b)| (*a, Tone { red_minus_blue: -b.red_minus_blue, ..*b }))
                .collect();
            prop_assert!(SharedColors::of(&swapped).has_swapped_channels());
            let inverted: Vec<_> = values.iter().map(|&v| (tone(v), tone(255.0 - v))).collect();
            prop_assert!(SharedColors::of(&inverted).is_unlike());
        }
    }

    #[test]
    fn evenly_colored_surfaces_say_nothing() {
        let pairs = vec![(tone(100.0), tone(90.0)); 500];
        assert_eq!(SharedColors::of(&pairs).brightness(), None);
        assert!(!SharedColors::of(&pairs).is_unlike());
    }
}
