//! Collects points from a file into a cloud.

use super::CloudKind;
use super::color_range::{ChannelTally, ColorRange};
use crate::IngestError;
use camino::Utf8Path;
use uniground_geometry::scene::PointCloud;
use uniground_geometry::{MAX_COORDINATE_M, Point3};
use uniground_types::findings::Finding;

/// A cloud in the file's own axes and units, with its offset subtracted.
#[derive(Debug)]
pub struct LoadedCloud {
    pub kind: CloudKind,
    pub cloud: PointCloud,
    /// Offset that was subtracted from all coordinates, in the file's units.
    pub offset: [f64; 3],
    /// Number of points left out because their coordinates are not finite.
    pub dropped: usize,
    /// Number of points whose color is not a number and was replaced by gray.
    pub without_color: usize,
    pub has_color: bool,
    /// The cloud was thinned out: one of this many points was kept.
    pub thinned: usize,
    /// What was assumed about the file, and what in it is not used.
    pub findings: Vec<Finding>,
    /// Color channels so far, the narrowest range that the file's types allow, and the range that
    /// the colors were read with.
    channels: ChannelTally,
    declared_range: ColorRange,
    range: ColorRange,
}

impl LoadedCloud {
    /// Returns the range of the color channels, if the colors were read with another one.
    pub(super) fn other_color_range(&self) -> Option<ColorRange> {
        let (range, _) = self.channels.range(self.declared_range);
        (range != self.range).then_some(range)
    }
}

/// Limits on the number of points that a file announces and that are kept.
#[derive(Debug, Clone, Copy)]
pub struct CloudBounds {
    /// Files that announce more points are refused.
    pub announced: usize,
    /// Clouds with more points are thinned out by keeping every n-th point.
    pub kept: usize,
}

/// The origin of the coordinates.
#[derive(Debug, Clone, Copy)]
pub enum CoordinateOrigin {
    /// Near the first point, if that is far away (map coordinates) and written in double precision.
    /// Otherwise at zero.
    Free,
    /// At the origin of the poses, in the file's units.
    At([f64; 3]),
}

/// Color of points without color.
pub const GREY: [u8; 3] = [128; 3];

/// Receives points from the readers.
pub(super) struct CloudBuilder {
    loaded: LoadedCloud,
    bounds: CloudBounds,
    origin: Option<[f64; 3]>,
    /// The range of the color channels, if it is known.
    fixed_range: Option<ColorRange>,
    seen: usize,
}

impl CloudBuilder {
    pub fn new(kind: CloudKind, bounds: &CloudBounds, origin: CoordinateOrigin) -> Self {
        let loaded = LoadedCloud {
            kind,
            cloud: PointCloud::default(),
            offset: [0.0; 3],
            dropped: 0,
            without_color: 0,
            has_color: false,
            thinned: 1,
            findings: Vec::new(),
            channels: ChannelTally::default(),
            declared_range: ColorRange::Unit,
            range: ColorRange::Unit,
        };
        let origin = match origin {
            CoordinateOrigin::Free => None,
            CoordinateOrigin::At(at) => Some(at),
        };
        Self { loaded, bounds: *bounds, origin, fixed_range: None, seen: 0 }
    }

    /// Sets the expected number of points and allocates memory for those that are kept.
    pub fn expect(&mut self, file: &Utf8Path, points: usize) -> Result<(), IngestError> {
        self.bounds.check(file, points as u64)?;
        self.loaded.thinned = points.div_ceil(self.bounds.kept).max(1);
        let kept = points.div_ceil(self.loaded.thinned);
        self.loaded.cloud.positions.reserve_exact(kept);
        self.loaded.cloud.colors.reserve_exact(kept);
        Ok(())
    }

    /// Sets whether the file contains color.
    pub fn set_has_color(&mut self, has_color: bool) {
        self.loaded.has_color = has_color;
    }

    /// Declares single precision. Such coordinates get no offset: far from the origin they are
    /// coarse already.
    pub fn set_single_precision(&mut self) {
        self.origin.get_or_insert([0.0; 3]);
    }

    /// Adds one point, in the file's units.
    #[inline]
    pub fn push(&mut self, [x, y, z]: [f64; 3], color: [u8; 3]) {
        self.seen += 1;
        if self.loaded.thinned > 1 && !(self.seen - 1).is_multiple_of(self.loaded.thinned) {
            return;
        }
        let o = match self.origin {
            Some(o) => o,
            None if x.is_finite() && y.is_finite() && z.is_finite() => self.localize([x, y, z]),
            None => [0.0; 3],
        };
        let p = Point3::new((x - o[0]) as f32, (y - o[1]) as f32, (z - o[2]) as f32);
        if !(p.x.is_finite() && p.y.is_finite() && p.z.is_finite()) {
            self.loaded.dropped += 1;
            return;
        }
        self.loaded.cloud.positions.push(p);
        self.loaded.cloud.colors.push(color);
    }

    /// Sets the narrowest range that the color channels can have.
    pub fn set_color_range(&mut self, declared: ColorRange) {
        self.loaded.declared_range = declared;
        self.loaded.range = self.fixed_range.unwrap_or(declared);
    }

    /// Reads the color channels with this range, whatever their values. Channels beyond it saturate.
    pub fn fix_color_range(&mut self, range: ColorRange) {
        self.fixed_range = Some(range);
        self.loaded.range = range;
    }

    /// Adds a point with its color channels as they are in the file. Channels that are not numbers
    /// become gray.
    #[inline]
    pub fn push_channels(&mut self, position: [f64; 3], channels: [f64; 3]) {
        let needed = self.loaded.channels.add(channels);
        if self.fixed_range.is_none() && needed > self.loaded.range {
            self.widen_range(needed);
        }
        let range = self.loaded.range;
        let level = |v: f64| if v.is_nan() { GREY[0] } else { range.to_level(v) };
        let before = self.loaded.cloud.len();
        self.push(position, channels.map(level));
        if channels.iter().any(|v| v.is_nan()) {
            self.loaded.without_color += self.loaded.cloud.len() - before;
        }
    }

    /// Converts the colors so far, whose channels all fit into the narrower range.
    #[cold]
    fn widen_range(&mut self, wider: ColorRange) {
        let narrower = std::mem::replace(&mut self.loaded.range, wider);
        for color in &mut self.loaded.cloud.colors {
            *color = color.map(|level| wider.widen(level, narrower));
        }
    }

    /// Sets the colors of the kept points from 16-bit channels, for formats where they are known
    /// only at the end.
    pub fn set_wide_colors(&mut self, colors: &[[u16; 3]]) {
        let declared = ColorRange::Bytes;
        self.set_color_range(declared);
        for color in colors {
            self.loaded.channels.add(color.map(f64::from));
        }
        let (range, _) = self.loaded.channels.range(declared);
        self.loaded.range = range;
        for (own, color) in self.loaded.cloud.colors.iter_mut().zip(colors) {
            *own = match range {
                // Writers multiply bytes by 256 or by 257: both come back.
                ColorRange::Words => color.map(|c| (c >> 8) as u8),
                _ => color.map(|c| range.to_level(f64::from(c))),
            };
        }
    }

    /// Records what was assumed about the file, or what in it is not used.
    pub fn add_finding(&mut self, finding: Finding) {
        self.loaded.findings.push(finding);
    }

    /// Returns whether the file contains color.
    pub fn has_color(&self) -> bool {
        self.loaded.has_color
    }

    /// Returns the number of points kept so far.
    pub fn len(&self) -> usize {
        self.loaded.cloud.len()
    }

    /// Returns the points in file order if all of them are kept: none thinned out, none dropped.
    pub fn as_complete(&self) -> Option<&PointCloud> {
        (self.loaded.cloud.len() == self.seen).then_some(&self.loaded.cloud)
    }

    /// Replaces the points by others with the same origin.
    pub fn replace(&mut self, cloud: PointCloud) {
        self.loaded.cloud = cloud;
    }

    /// Returns the number of points so far, including those that were thinned out.
    pub fn points_read(&self) -> usize {
        self.seen
    }

    /// Makes room for files that do not announce their number of points: when twice the limit is
    /// reached, every other point is dropped.
    pub fn thin_if_full(&mut self, file: &Utf8Path) -> Result<(), IngestError> {
        self.bounds.check(file, self.seen as u64)?;
        if self.loaded.cloud.len() < self.bounds.kept.saturating_mul(2) {
            return Ok(());
        }
        let every_other = |i: &mut usize| {
            *i += 1;
            *i % 2 == 1
        };
        let (mut i, mut j) = (0, 0);
        self.loaded.cloud.positions.retain(|_| every_other(&mut i));
        self.loaded.cloud.colors.retain(|_| every_other(&mut j));
        self.loaded.thinned *= 2;
        Ok(())
    }

    fn localize(&mut self, first: [f64; 3]) -> [f64; 3] {
        let far = first.iter().any(|c| c.abs() > f64::from(MAX_COORDINATE_M));
        // A round number, because people who compare coordinates will see it.
        let origin = if far { first.map(|c| (c / 100.0).round() * 100.0) } else { [0.0; 3] };
        self.origin = Some(origin);
        origin
    }

    /// Returns the cloud, or an error if it is not a valid one.
    pub fn finish(mut self, file: &Utf8Path) -> Result<LoadedCloud, IngestError> {
        self.loaded.offset = self.origin.unwrap_or_default();
        let cloud = &self.loaded.cloud;
        let far = |p: &&Point3<f32>| p.iter().any(|c| c.abs() > MAX_COORDINATE_M);
        if let Some(p) = cloud.positions.iter().find(far) {
            return Err(IngestError::malformed(
                file,
                format!(
                    "the point ({}, {}, {}) is more than 10 km from the origin: remove it if it is an error, or subtract an offset from the whole scan",
                    p.x, p.y, p.z
                ),
            ));
        }
        if cloud.is_empty() {
            return Err(IngestError::EmptyCloud { file: file.to_owned() });
        }
        if self.loaded.has_color {
            let LoadedCloud { channels, declared_range, .. } = &self.loaded;
            let of_colors = channels.findings(*declared_range);
            self.loaded.findings.extend(of_colors);
        }
        Ok(self.loaded)
    }
}

impl CloudBounds {
    /// No limits, for files that this service wrote itself.
    pub const OWN: Self = Self { announced: usize::MAX, kept: usize::MAX };

    /// Refuses a file that announces too many points.
    pub fn check(&self, file: &Utf8Path, points: u64) -> Result<(), IngestError> {
        match points > self.announced as u64 {
            true => Err(IngestError::malformed(
                file,
                format!(
                    "it declares {points} points; the limit is {}: downsample it first, one point per 5 mm is enough",
                    self.announced
                ),
            )),
            false => Ok(()),
        }
    }
}
