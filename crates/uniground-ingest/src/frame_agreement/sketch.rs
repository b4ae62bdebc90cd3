//! Small versions of frames, which are kept in memory while all frames are compared.

use image::RgbImage;
use uniground_geometry::Point3;
use uniground_geometry::scene::{Camera, DepthImage, FrameRef, Intrinsics};

/// Number of points of a frame that are projected into the others.
const FRAME_POINTS: usize = 400;
/// Size of the depth that is kept of a frame, pixels along the longer side.
const KEPT_PIXELS: u32 = 160;
/// Number of samples along each side of a kept pixel that its depth and color are taken from.
const SAMPLES: u32 = 3;

/// What is compared of a color, in levels of 8-bit color: exposure changes both, but hardly their
/// order.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Tone {
    pub brightness: f32,
    pub red_minus_blue: f32,
}

impl Tone {
    pub fn of([red, green, blue]: [f32; 3]) -> Self {
        Self { brightness: 0.299 * red + 0.587 * green + 0.114 * blue, red_minus_blue: red - blue }
    }
}

/// A point of a frame's surfaces, in the world of the frames, and the kept pixel that shows it.
#[derive(Debug, Clone, Copy)]
pub(super) struct SketchPoint {
    pub position: Point3<f32>,
    pub pixel: usize,
}

/// A frame's points and a small version of its pictures.
#[derive(Debug, Clone)]
pub(super) struct FrameSketch {
    /// Position in the scan's frames.
    pub at: usize,
    pub camera: Camera,
    pub points: Vec<SketchPoint>,
    /// Number of kept columns.
    pub width: u32,
    /// Depth of the kept pixels, meters, row-major; 0 where nothing was measured.
    pub depth_m: Vec<f32>,
    /// Colors of the kept pixels. Empty if the color picture was not decoded.
    pub tones: Vec<Tone>,
    /// Side of the square of depth pixels that a kept pixel stands for.
    step: u32,
}

/// Where a frame shows a point.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sighting {
    /// The kept pixel.
    pub pixel: usize,
    /// How much farther than the measured depth the point is, as a share of that depth. Below 0
    /// the frame sees through the point.
    pub farther: f32,
}

/// A change of all frames that would explain why they do not fit each other.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum SharedChange {
    /// The depth pictures hold distances along the ray, not along the optical axis.
    DepthAlongRay,
    DepthTimes(f32),
    FocalLengthTimes(f32),
}

impl FrameSketch {
    pub fn new(at: usize, frame: &FrameRef, depth: &DepthImage) -> Self {
        let step = depth.width.max(depth.height).div_ceil(KEPT_PIXELS).max(1);
        let (width, height) = (depth.width / step, depth.height / step);
        let depth_m: Vec<f32> = (0..height)
            .flat_map(|row| (0..width).map(move |column| (column, row)))
            .map(|(column, row)| median_depth(depth, (column * step, row * step), step))
            .collect();
        let camera = Camera::new(frame.depth_intrinsics, &frame.camera_to_world);
        let mut sketch =
            Self { at, camera, points: Vec::new(), width, depth_m, tones: Vec::new(), step };
        sketch.place_points();
        sketch
    }

    /// Takes points from pixels spread over the picture.
    fn place_points(&mut self) {
        let known: Vec<usize> =
            (0..self.depth_m.len()).filter(|&i| self.depth_m[i] > 0.0).collect();
        let count = known.len().min(FRAME_POINTS);
        // Not every n-th pixel: that could leave out columns.
        let chosen = (0..count).map(|i| known[i * known.len() / count]);
        let to_world = self.camera.world_to_camera().inverse();
        self.points = chosen
            .map(|pixel| {
                let (u, v) = self.position_of(pixel);
                let local = self.camera.intrinsics.unproject(u, v, self.depth_m[pixel]);
                SketchPoint { position: to_world * local, pixel }
            })
            .collect();
    }

    /// Treats a value of the depth as not measured.
    pub fn remove_depth(&mut self, value_m: f32) {
        self.depth_m.iter_mut().filter(|z| **z == value_m).for_each(|z| *z = 0.0);
        self.place_points();
    }

    /// Returns the position of a kept pixel in the depth picture.
    fn position_of(&self, pixel: usize) -> (f32, f32) {
        let (column, row) = (pixel as u32 % self.width, pixel as u32 / self.width);
        let center = (self.step as f32 - 1.0) / 2.0;
        ((column * self.step) as f32 + center, (row * self.step) as f32 + center)
    }

    /// Adds the colors of the kept pixels from the color picture, which has the same pose.
    pub fn add_colors(&mut self, picture: &RgbImage, color: &Intrinsics) {
        let depth = self.camera.intrinsics;
        let along = |at: f32, (from, f): (f32, f32), (to, g): (f32, f32), len: u32| {
            ((at - from) / f * g + to + 0.5).clamp(0.0, len as f32 - 1.0) as u32
        };
        // Positions of the samples along a side of a kept pixel, in the depth picture.
        let step = self.step;
        let samples = |index: u32| {
            let size = step as f32 / SAMPLES as f32;
            (0..SAMPLES).map(move |i| (index * step) as f32 - 0.5 + size * (i as f32 + 0.5))
        };
        let columns: Vec<u32> = (0..self.width)
            .flat_map(samples)
            .map(|u| along(u, (depth.cx, depth.fx), (color.cx, color.fx), picture.width()))
            .collect();
        let height = self.depth_m.len() as u32 / self.width.max(1);
        let rows: Vec<u32> = (0..height)
            .flat_map(samples)
            .map(|v| along(v, (depth.cy, depth.fy), (color.cy, color.fy), picture.height()))
            .collect();
        let side = SAMPLES as usize;
        self.tones = rows
            .chunks(side)
            .flat_map(|rows| columns.chunks(side).map(move |columns| (columns, rows)))
            .map(|(columns, rows)| {
                let mut sum = [0.0; 3];
                for (&column, &row) in
                    rows.iter().flat_map(|row| columns.iter().map(move |c| (c, row)))
                {
                    let color = picture.get_pixel(column, row).0;
                    (0..3).for_each(|i| sum[i] += f32::from(color[i]));
                }
                Tone::of(sum.map(|total| total / (side * side) as f32))
            })
            .collect();
    }

    /// Returns where this frame shows a point, in the world of the frames. `None` outside of the
    /// picture and where no depth was measured.
    pub fn look_at(&self, point: &Point3<f32>) -> Option<Sighting> {
        let seen = self.camera.project(point)?;
        let (column, row) = seen.cell();
        let (column, row) = (column / self.step, row / self.step);
        let pixel = (row * self.width + column) as usize;
        let measured_m = self.depth_m.get(pixel).filter(|z| **z > 0.0 && column < self.width)?;
        Some(Sighting { pixel, farther: (seen.z_m - measured_m) / measured_m })
    }

    /// Returns the frame as it would be after a change.
    pub fn changed(&self, change: SharedChange) -> Self {
        let mut changed = self.clone();
        let camera = self.camera.intrinsics;
        match change {
            SharedChange::DepthTimes(factor) => {
                changed.depth_m.iter_mut().for_each(|z| *z *= factor);
            }
            SharedChange::FocalLengthTimes(factor) => {
                changed.camera.intrinsics.fx *= factor;
                changed.camera.intrinsics.fy *= factor;
            }
            SharedChange::DepthAlongRay => {
                for (pixel, z) in changed.depth_m.iter_mut().enumerate() {
                    let (u, v) = self.position_of(pixel);
                    *z /= camera.unproject(u, v, 1.0).coords.norm();
                }
            }
        }
        changed.place_points();
        changed
    }
}

/// Returns the median of samples of a square of a depth picture, which has less noise than a single
/// pixel. 0 if most of them have no measurement.
fn median_depth(depth: &DepthImage, (left, top): (u32, u32), side: u32) -> f32 {
    let offset = |i: u32| (2 * i + 1) * side / (2 * SAMPLES);
    let mut samples = [0.0; (SAMPLES * SAMPLES) as usize];
    for (i, sample) in (0..).zip(&mut samples) {
        *sample = depth.at((left + offset(i % SAMPLES), top + offset(i / SAMPLES)));
    }
    samples.sort_unstable_by(f32::total_cmp);
    samples[samples.len() / 2]
}
