//! What the depth of frames says about points: of other frames, and of a cloud.

use super::cloud::CloudSample;
use super::sketch::FrameSketch;
use rayon::prelude::*;
use uniground_geometry::Point3;

/// Relative depth difference that counts as agreement, as in the check of conventions, and as
/// close agreement.
const TOLERANCE: f32 = 0.1;
const CLOSE: f32 = 0.02;
/// Minimum number of compared points of a frame.
const MIN_POINTS: u32 = 400;
/// Two frames with this many agreeing points may see the same surfaces.
const CONNECTED: u32 = 10;
/// They do see the same surfaces if so many of the compared points agree, and so many of these
/// closely.
const MOST: f32 = 0.7;
const MANY: f32 = 0.4;

/// How many points agree with a depth picture, and how many lie in space that it sees through.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Agreement {
    pub agree: u32,
    contradict: u32,
    /// Those of `agree` that agree closely.
    close: u32,
}

impl Agreement {
    fn of<'a>(sketch: &FrameSketch, points: impl Iterator<Item = &'a Point3<f32>>) -> Self {
        let mut found = Self::default();
        for farther in points.filter_map(|point| Some(sketch.look_at(point)?.farther)) {
            found.agree += u32::from(farther.abs() <= TOLERANCE);
            found.close += u32::from(farther.abs() <= CLOSE);
            found.contradict += u32::from(farther < -TOLERANCE);
        }
        found
    }

    fn add(&mut self, other: Self) {
        self.agree += other.agree;
        self.contradict += other.contradict;
        self.close += other.close;
    }

    /// Returns the share of compared points that agree. `None` if too few were compared.
    pub fn share(&self) -> Option<f32> {
        let compared = self.agree + self.contradict;
        (compared >= MIN_POINTS).then(|| self.agree as f32 / compared as f32)
    }

    /// Returns the share of agreeing points that agree closely.
    pub fn close_share(&self) -> f32 {
        self.close as f32 / self.agree.max(1) as f32
    }
}

/// Whether two frames see the same surfaces.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Overlap {
    /// They see nothing in common.
    None,
    /// They see something at the same place, but not closely enough to be the same.
    Doubtful,
    Same,
}

/// What every frame says about the points of every other, and about those of the cloud.
pub(super) struct Comparison {
    /// Row i, column j: what frame i says about the points of frame j.
    pairs: Vec<Vec<Agreement>>,
    with_cloud: Vec<Agreement>,
}

impl Comparison {
    pub fn new(sketches: &[FrameSketch], cloud: Option<&CloudSample>) -> Self {
        let cloud: &[Point3<f32>] = cloud.map_or(&[], |cloud| &cloud.positions);
        let row = |sketch: &FrameSketch| {
            let compare = |other: &FrameSketch| match sketch.at == other.at {
                true => Agreement::default(),
                false => Agreement::of(sketch, other.points.iter().map(|point| &point.position)),
            };
            sketches.iter().map(compare).collect()
        };
        Self {
            pairs: sketches.par_iter().map(row).collect(),
            with_cloud: sketches.par_iter().map(|s| Agreement::of(s, cloud.iter())).collect(),
        }
    }

    /// Returns the agreement of the whole cloud, and that of all frames with each other.
    pub fn totals(&self) -> (Agreement, Agreement) {
        let sum = |all: &mut dyn Iterator<Item = &Agreement>| {
            let mut total = Agreement::default();
            all.for_each(|one| total.add(*one));
            total
        };
        (sum(&mut self.with_cloud.iter()), sum(&mut self.pairs.iter().flatten()))
    }

    /// Returns whether two frames may see the same surfaces, and whether they clearly do.
    pub fn overlap(&self, i: usize, j: usize) -> Overlap {
        let mut both = self.pairs[i][j];
        both.add(self.pairs[j][i]);
        let compared = both.agree + both.contradict;
        if both.agree < CONNECTED {
            Overlap::None
        } else if both.agree as f32 >= MOST * compared as f32 && both.close_share() >= MANY {
            Overlap::Same
        } else {
            Overlap::Doubtful
        }
    }

    /// Returns the share of the points that a frame sees of others and of the cloud, and that
    /// others see of it, that agree. Only frames that are `used` are counted.
    pub fn share(&self, i: usize, used: &[bool]) -> Option<f32> {
        let mut total = self.with_cloud[i];
        for j in (0..self.pairs.len()).filter(|&j| j != i && used[j]) {
            total.add(self.pairs[i][j]);
            total.add(self.pairs[j][i]);
        }
        total.share()
    }
}
