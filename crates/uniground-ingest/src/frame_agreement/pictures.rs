//! Checks what each color picture shows by itself: a single color, hardly any light, no color, or
//! depth.

use super::colors::SharedColors;
use super::name_frames;
use super::sketch::{FrameSketch, Tone};
use crate::scan::Scan;
use uniground_geometry::statistics::median;
use uniground_types::findings::{Finding, FindingSubject};

/// Pictures whose brightness deviates by less than this (levels) show a single color.
const SINGLE_COLOR: f32 = 1.5;
/// Mean difference of red and blue, in levels, below which pictures are gray; and mean brightness
/// below which they are black.
const GRAY: f32 = 1.0;
const BLACK: f32 = 16.0;
/// Half of the pictures of a scan in color have at least this difference of red and blue.
const COLORFUL: f32 = 8.0;
/// Pixels brighter than this are white.
const WHITE: f32 = 250.0;

/// Correlation of brightness and depth from which a picture shows depth. Photographs reach 0.7.
const SHOWS_DEPTH: f32 = 0.95;
/// Levels that a meter of depth is compared as.
const LEVELS_PER_METER: f32 = 60.0;

/// Adds findings about color pictures without content or color.
pub(super) fn check(scan: &Scan, sketches: &[&FrameSketch], findings: &mut Vec<Finding>) {
    let all = sketches.len();
    if all == 0 {
        return;
    }
    let (single, varied): (Vec<&FrameSketch>, Vec<&FrameSketch>) =
        sketches.iter().partition(|sketch| spread(sketch) < SINGLE_COLOR);
    let named = |found: &[&FrameSketch]| {
        let at: Vec<usize> = found.iter().map(|sketch| sketch.at).collect();
        name_frames(scan, &at)
    };
    let mut add = |count: usize, text: String| {
        findings.push(Finding::unusual(FindingSubject::Frames, text).counting(count));
    };
    if !single.is_empty() {
        let text = format!(
            "{} of {all} examined color pictures show a single color: {}",
            single.len(),
            named(&single)
        );
        add(single.len(), text);
    }
    let count = |holds: fn(&FrameSketch) -> bool| varied.iter().filter(|s| holds(s)).count();
    let (black, white) = (count(is_black), count(is_white));
    let gray: Vec<&FrameSketch> = varied.iter().copied().filter(|s| is_gray(s)).collect();
    if black * 2 > all {
        add(
            black,
            format!(
                "{black} of {all} examined color pictures are nearly black: check the range of their colors"
            ),
        );
    } else if white * 2 > all {
        add(
            white,
            format!(
                "{white} of {all} examined color pictures are overexposed: most of their pixels are white"
            ),
        );
    } else if !gray.is_empty() && gray.len() < varied.len() {
        // In a room that has hardly any color, some views have none.
        let mut others: Vec<f32> =
            varied.iter().filter(|s| !is_gray(s)).map(|s| colorfulness(s)).collect();
        if median(&mut others).is_none_or(|others| others < COLORFUL) {
            return;
        }
        let text = format!(
            "{} of {all} examined color pictures are gray, the others are not: {}",
            gray.len(),
            named(&gray)
        );
        add(gray.len(), text);
    } else if !gray.is_empty() && count(shows_depth) * 2 > all {
        add(
            all,
            "the color pictures show depth: are they the depth pictures, drawn in gray?".into(),
        );
    } else if !gray.is_empty() {
        add(
            all,
            "the color pictures are gray: questions about colors cannot be answered, and names are less certain".into(),
        );
    }
}

fn mean(sketch: &FrameSketch, value: impl Fn(&Tone) -> f32) -> f32 {
    sketch.tones.iter().map(value).sum::<f32>() / sketch.tones.len() as f32
}

/// Returns the standard deviation of the brightness.
fn spread(sketch: &FrameSketch) -> f32 {
    let middle = mean(sketch, |tone| tone.brightness);
    mean(sketch, |tone| (tone.brightness - middle).powi(2)).sqrt()
}

fn is_black(sketch: &FrameSketch) -> bool {
    mean(sketch, |tone| tone.brightness) < BLACK
}

fn is_white(sketch: &FrameSketch) -> bool {
    let white = sketch.tones.iter().filter(|tone| tone.brightness > WHITE).count();
    white * 2 > sketch.tones.len()
}

fn is_gray(sketch: &FrameSketch) -> bool {
    colorfulness(sketch) < GRAY
}

/// Returns the mean difference of red and blue, levels.
fn colorfulness(sketch: &FrameSketch) -> f32 {
    mean(sketch, |tone| tone.red_minus_blue.abs())
}

/// Returns whether the brightness of a picture is that of its depth.
fn shows_depth(sketch: &FrameSketch) -> bool {
    let in_levels = |z: f32| Tone { brightness: z * LEVELS_PER_METER, red_minus_blue: 0.0 };
    let pairs: Vec<(Tone, Tone)> = sketch
        .tones
        .iter()
        .zip(&sketch.depth_m)
        .filter(|(_, z)| **z > 0.0)
        .map(|(tone, z)| (*tone, in_levels(*z)))
        .collect();
    SharedColors::of(&pairs).brightness().is_some_and(|alike| alike.abs() >= SHOWS_DEPTH)
}
