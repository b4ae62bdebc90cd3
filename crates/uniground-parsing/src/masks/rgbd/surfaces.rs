//! A frame as a grid of surface elements in camera axes.

use uniground_geometry::color::{Lab, srgb_to_lab};
use uniground_geometry::scene::{DepthImage, Frame};
use uniground_geometry::{Point3, Vector3};

/// Surface elements on a grid of every `stride`-th pixel; row-major vectors of `width * height`.
pub(super) struct SurfaceGrid {
    pub width: usize,
    pub height: usize,
    stride: u32,
    /// 0 = no measurement.
    pub depth_m: Vec<f32>,
    /// Camera axes, meters; undefined without depth.
    pub points: Vec<Point3<f32>>,
    /// Unit normals toward the camera; zero without depth.
    pub normals: Vec<Vector3<f32>>,
    pub labs: Vec<Lab>,
    /// Distance between neighboring elements at a depth of one meter, meters.
    pub spacing_per_m: f32,
}

impl SurfaceGrid {
    pub fn from_frame(frame: &Frame, stride: u32) -> Self {
        let stride = stride.max(1);
        let intrinsics = frame.depth_camera.intrinsics;
        let (width, height) = (
            (frame.depth.width / stride).max(1) as usize,
            (frame.depth.height / stride).max(1) as usize,
        );
        let colors = frame.color_on_depth_grid();
        let (mut depth_m, mut points, mut labs) = (Vec::new(), Vec::new(), Vec::new());
        for row in 0..height as u32 {
            for column in 0..width as u32 {
                let (u, v) = (column * stride, row * stride);
                let z = depth_or_bridge(&frame.depth, u, v);
                depth_m.push(z);
                points.push(intrinsics.unproject(u as f32, v as f32, z));
                labs.push(srgb_to_lab(block_mean(&colors, &frame.depth, u, v, stride)));
            }
        }
        let spacing_per_m = stride as f32 / intrinsics.fx;
        let mut surfaces = Self {
            width,
            height,
            stride,
            depth_m,
            points,
            normals: Vec::new(),
            labs,
            spacing_per_m,
        };
        surfaces.normals = surfaces.smooth_normals();
        surfaces
    }

    /// Returns the grid element of a full-resolution pixel.
    pub fn cell_of(&self, u: u32, v: u32) -> usize {
        let (column, row) = ((u / self.stride) as usize, (v / self.stride) as usize);
        row.min(self.height - 1) * self.width + column.min(self.width - 1)
    }

    /// Returns whether the surface continues from one element to another: their depths differ by no
    /// more than noise and slant explain.
    pub fn is_continuous(&self, a: usize, b: usize) -> bool {
        let (za, zb) = (self.depth_m[a], self.depth_m[b]);
        if za <= 0.0 || zb <= 0.0 {
            return false;
        }
        let z = za.min(zb);
        let step = self.points[b] - self.points[a];
        // Distance from either element's tangent plane: a slanted floor has large depth steps but
        // stays in its plane.
        let off_plane = step.dot(&self.normals[a]).abs().min(step.dot(&self.normals[b]).abs());
        off_plane <= 0.006 + 0.005 * z * z && step.norm() <= 0.03 + 12.0 * self.spacing_per_m * z
    }

    /// Returns the pairs of each element with those right of and below it.
    pub fn adjacent_pairs(&self) -> impl Iterator<Item = (usize, usize)> + '_ {
        let (w, n) = (self.width, self.width * self.height);
        (0..n).flat_map(move |i| {
            let right = (i % w + 1 < w).then_some((i, i + 1));
            let below = (i + w < n).then_some((i, i + w));
            right.into_iter().chain(below)
        })
    }

    /// Computes normals by least squares over a window that widens with sensor noise (about depth
    /// squared) and does not cross depth steps.
    fn smooth_normals(&self) -> Vec<Vector3<f32>> {
        let (w, h) = (self.width as i32, self.height as i32);
        let tangent = |i: usize, du: i32, dv: i32, reach: i32| -> Option<Vector3<f32>> {
            let (u, v) = ((i as i32) % w, (i as i32) / w);
            let z = self.depth_m[i];
            let at = |k: i32| {
                let (u, v) = (u + du * k, v + dv * k);
                let j = (v * w + u) as usize;
                let inside = (0..w).contains(&u) && (0..h).contains(&v);
                (inside
                    && self.depth_m[j] > 0.0
                    && (self.depth_m[j] - z).abs()
                        < 0.02 * z + 3.0 * self.spacing_per_m * z * k.abs() as f32)
                    .then(|| self.points[j])
            };
            // Mean slope over the window: pairs (-k, +k), one-sided at borders.
            let mut sum = Vector3::zeros();
            for k in 1..=reach {
                let here = self.points[i];
                match (at(-k), at(k)) {
                    (Some(a), Some(b)) => sum += b - a,
                    (None, Some(b)) => sum += (b - here) * 2.0,
                    (Some(a), None) => sum += (here - a) * 2.0,
                    (None, None) => break,
                }
            }
            (sum.norm_squared() > 0.0).then_some(sum)
        };
        let raw: Vec<Vector3<f32>> = (0..self.depth_m.len())
            .map(|i| {
                let z = self.depth_m[i];
                if z <= 0.0 {
                    return Vector3::zeros();
                }
                let reach = (2.0 + z).round().clamp(2.0, 6.0) as i32;
                let normal = tangent(i, 1, 0, reach)
                    .zip(tangent(i, 0, 1, reach))
                    .and_then(|(u, v)| u.cross(&v).try_normalize(1e-12));
                // u x v points away from the camera (x right, y down, z forward): flip it where
                // needed.
                normal.map_or(Vector3::zeros(), |n| {
                    if n.dot(&self.points[i].coords) > 0.0 { -n } else { n }
                })
            })
            .collect();
        // One pass of averaging over neighbors on the same surface smooths the remaining errors.
        (0..raw.len())
            .map(|i| {
                let (u, v) = ((i as i32) % w, (i as i32) / w);
                let mut sum = raw[i];
                for (du, dv) in
                    [(-1, 0), (1, 0), (0, -1), (0, 1), (-1, -1), (1, 1), (-1, 1), (1, -1)]
                {
                    if (0..w).contains(&(u + du)) && (0..h).contains(&(v + dv)) {
                        let j = ((v + dv) * w + u + du) as usize;
                        if (self.depth_m[j] - self.depth_m[i]).abs() < 0.02 * self.depth_m[i]
                            && raw[i].dot(&raw[j]) > 0.9
                        {
                            sum += raw[j];
                        }
                    }
                }
                sum.try_normalize(1e-9).unwrap_or_else(Vector3::zeros)
            })
            .collect()
    }
}

/// Returns the depth of a pixel. Where it has none: the mean of the pixels around it, if enough of
/// them have depth and lie on one surface.
///
/// Depth that was warped into another camera is full of cracks one pixel wide, which are not
/// borders.
fn depth_or_bridge(depth: &DepthImage, u: u32, v: u32) -> f32 {
    const REACH: u32 = 2;
    /// Out of the 24 pixels around.
    const ENOUGH: usize = 8;
    const ONE_SURFACE: f32 = 1.04;
    let here = depth.at((u, v));
    if here > 0.0 {
        return here;
    }
    let span = |at: u32, len: u32| at.saturating_sub(REACH)..(at + REACH + 1).min(len);
    let (mut sum, mut count, mut low, mut high) = (0.0, 0, f32::INFINITY, 0.0_f32);
    for row in span(v, depth.height) {
        for column in span(u, depth.width) {
            let z = depth.at((column, row));
            if z > 0.0 {
                (sum, count, low, high) = (sum + z, count + 1, low.min(z), high.max(z));
            }
        }
    }
    if count >= ENOUGH && high <= ONE_SURFACE * low { sum / count as f32 } else { 0.0 }
}

/// Returns the mean color of a block of pixels. This halves noise and texture before edges are
/// detected.
fn block_mean(colors: &[[u8; 3]], depth: &DepthImage, u: u32, v: u32, stride: u32) -> [u8; 3] {
    let mut sum = [0_u32; 3];
    let mut count = 0;
    for row in v..(v + stride).min(depth.height) {
        for column in u..(u + stride).min(depth.width) {
            let color = colors[(row * depth.width + column) as usize];
            (0..3).for_each(|c| sum[c] += u32::from(color[c]));
            count += 1;
        }
    }
    sum.map(|s| (s / count.max(1)) as u8)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn image(depth_of: impl Fn(u32, u32) -> f32) -> DepthImage {
        DepthImage {
            width: 9,
            height: 9,
            depth_m: (0..81).map(|i| depth_of(i % 9, i / 9)).collect(),
        }
    }

    #[test]
    fn cracks_are_bridged_but_holes_and_depth_steps_are_not() {
        let crack = image(|u, _| if u == 4 { 0.0 } else { 2.0 });
        assert_eq!((depth_or_bridge(&crack, 4, 4), depth_or_bridge(&crack, 3, 4)), (2.0, 2.0));
        let hole = image(|u, v| if u.abs_diff(4).max(v.abs_diff(4)) <= 2 { 0.0 } else { 2.0 });
        assert_eq!(depth_or_bridge(&hole, 4, 4), 0.0);
        let step = image(|u, _| match u {
            0..4 => 2.0,
            4 => 0.0,
            _ => 3.0,
        });
        assert_eq!(depth_or_bridge(&step, 4, 4), 0.0);
    }
}
