//! Points on their way from a file into a cloud.

use super::CloudKind;
use crate::IngestError;
use camino::Utf8Path;
use uniground_geometry::scene::PointCloud;
use uniground_geometry::{MAX_COORDINATE_M, Point3};

/// A cloud in the file's own axes and units, less its offset.
#[derive(Debug)]
pub struct LoadedCloud {
    pub kind: CloudKind,
    pub cloud: PointCloud,
    /// What was taken off all coordinates, in the file's units.
    pub offset: [f64; 3],
    /// Points left out because their coordinates are not finite.
    pub dropped: usize,
    /// Points whose colour is not a number and was taken as grey.
    pub without_colour: usize,
    pub has_colour: bool,
    /// One of so many points was kept.
    pub thinned: usize,
}

/// Bounds on what a file may announce and what is kept of it.
#[derive(Debug, Clone, Copy)]
pub struct CloudBounds {
    /// A file that announces more points is refused.
    pub announced: usize,
    /// Of more points than this, every so manieth is kept.
    pub kept: usize,
}

/// Where coordinates are counted from.
#[derive(Debug, Clone, Copy)]
pub enum CoordinateOrigin {
    /// Where the first point is, where that is far away (map coordinates) and written in double
    /// precision.
    Free,
    /// Where the poses' origin was put, in the file's units.
    At([f64; 3]),
}

/// Points without colour.
pub const GREY: [u8; 3] = [128; 3];

/// What readers hand points to.
pub(super) struct CloudBuilder {
    loaded: LoadedCloud,
    bounds: CloudBounds,
    origin: Option<[f64; 3]>,
    seen: usize,
}

impl CloudBuilder {
    pub fn new(kind: CloudKind, bounds: &CloudBounds, origin: CoordinateOrigin) -> Self {
        let loaded = LoadedCloud {
            kind,
            cloud: PointCloud::default(),
            offset: [0.0; 3],
            dropped: 0,
            without_colour: 0,
            has_colour: false,
            thinned: 1,
        };
        let origin = match origin {
            CoordinateOrigin::Free => None,
            CoordinateOrigin::At(at) => Some(at),
        };
        Self { loaded, bounds: *bounds, origin, seen: 0 }
    }

    /// Says how many points will come, and makes room for those that are kept.
    pub fn expect(&mut self, file: &Utf8Path, points: usize) -> Result<(), IngestError> {
        self.bounds.check(file, points as u64)?;
        self.loaded.thinned = points.div_ceil(self.bounds.kept).max(1);
        let kept = points.div_ceil(self.loaded.thinned);
        self.loaded.cloud.positions.reserve_exact(kept);
        self.loaded.cloud.colours.reserve_exact(kept);
        Ok(())
    }

    /// Whether the file brings colour.
    pub fn coloured(&mut self, has_colour: bool) {
        self.loaded.has_colour = has_colour;
    }

    /// Coordinates in single precision have no offset to take off: far from the origin they are
    /// coarse already.
    pub fn single_precision(&mut self) {
        self.origin.get_or_insert([0.0; 3]);
    }

    /// One point, in the file's units.
    #[inline]
    pub fn push(&mut self, [x, y, z]: [f64; 3], colour: [u8; 3]) {
        self.seen += 1;
        if self.loaded.thinned > 1 && !(self.seen - 1).is_multiple_of(self.loaded.thinned) {
            return;
        }
        let o = match self.origin {
            Some(o) => o,
            None if x.is_finite() && y.is_finite() && z.is_finite() => self.settle([x, y, z]),
            None => [0.0; 3],
        };
        let p = Point3::new((x - o[0]) as f32, (y - o[1]) as f32, (z - o[2]) as f32);
        if !(p.x.is_finite() && p.y.is_finite() && p.z.is_finite()) {
            self.loaded.dropped += 1;
            return;
        }
        self.loaded.cloud.positions.push(p);
        self.loaded.cloud.colours.push(colour);
    }

    /// A point whose colour is not a number.
    pub fn push_discoloured(&mut self, position: [f64; 3], colour: [u8; 3]) {
        let before = self.loaded.cloud.len();
        self.push(position, colour);
        self.loaded.without_colour += self.loaded.cloud.len() - before;
    }

    /// Points kept so far.
    pub fn len(&self) -> usize {
        self.loaded.cloud.len()
    }

    /// The points as they came, where all of them are here: none thinned out, none dropped.
    pub fn complete(&self) -> Option<&PointCloud> {
        (self.loaded.cloud.len() == self.seen).then_some(&self.loaded.cloud)
    }

    /// Others in their place, counted from the same origin.
    pub fn replace(&mut self, cloud: PointCloud) {
        self.loaded.cloud = cloud;
    }

    /// Colours of the points kept, where they are known only at the end.
    pub fn recolour(&mut self, colours: impl Iterator<Item = [u8; 3]>) {
        for (own, colour) in self.loaded.cloud.colours.iter_mut().zip(colours) {
            *own = colour;
        }
    }

    /// Points so far, those that were thinned out included.
    pub fn seen(&self) -> usize {
        self.seen
    }

    /// Files that announce nothing are bounded while they are read: twice as many as are kept, and
    /// every other one goes.
    pub fn make_room(&mut self, file: &Utf8Path) -> Result<(), IngestError> {
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
        self.loaded.cloud.colours.retain(|_| every_other(&mut j));
        self.loaded.thinned *= 2;
        Ok(())
    }

    fn settle(&mut self, first: [f64; 3]) -> [f64; 3] {
        let far = first.iter().any(|c| c.abs() > f64::from(MAX_COORDINATE_M));
        // A round number: people who compare coordinates will meet it.
        let origin = if far { first.map(|c| (c / 100.0).round() * 100.0) } else { [0.0; 3] };
        self.origin = Some(origin);
        origin
    }

    /// The cloud, when it is one.
    pub fn finish(mut self, file: &Utf8Path) -> Result<LoadedCloud, IngestError> {
        self.loaded.offset = self.origin.unwrap_or_default();
        let cloud = &self.loaded.cloud;
        let far = |p: &&Point3<f32>| p.iter().any(|c| c.abs() > MAX_COORDINATE_M);
        if let Some(p) = cloud.positions.iter().find(far) {
            return Err(IngestError::malformed(
                file,
                format!(
                    "the point ({}, {}, {}) lies more than 10 km from the origin: take an offset off the whole scan first",
                    p.x, p.y, p.z
                ),
            ));
        }
        if cloud.is_empty() {
            return Err(IngestError::EmptyCloud { file: file.to_owned() });
        }
        Ok(self.loaded)
    }
}

impl CloudBounds {
    /// What this service wrote itself.
    pub const OWN: Self = Self { announced: usize::MAX, kept: usize::MAX };

    /// Refuses what announces too many points.
    pub fn check(&self, file: &Utf8Path, points: u64) -> Result<(), IngestError> {
        match points > self.announced as u64 {
            true => Err(IngestError::malformed(
                file,
                format!(
                    "it announces {points} points, {} are read at most: thin it out first, a point for every 5 mm is plenty",
                    self.announced
                ),
            )),
            false => Ok(()),
        }
    }
}
