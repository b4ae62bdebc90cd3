//! Checks known points against new frames: a frame either measured a surface at the point or saw
//! through it.

use super::{DepthImage, FrameError, FrameRef, stream_frames};
use crate::Point3;
use rayon::prelude::*;

/// A measurement farther than this from a point counts as in front of it or behind it: meters, and
/// a share of the depth; the larger one applies. Poses drift by centimeters, and noise grows with
/// the distance.
const MARGIN_M: f32 = 0.05;
const MARGIN: f32 = 0.025;
/// Radius in pixels in which no measurement may be near the point, for pictures of this width;
/// larger in larger pictures. Silhouettes are blurred, and poses are off by a pixel or two.
const AROUND_PX: u32 = 2;
const AT_WIDTH_PX: u32 = 640;
/// Minimum share of the surrounding pixels with a measurement. Shiny or black surfaces leave holes
/// and must not count as gone.
const MEASURED: f32 = 0.75;

/// How many frames measured a surface at a point, and how many saw through it.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct FreeSpaceVotes {
    /// Number of frames that measured a surface there.
    pub hits: u32,
    /// Number of frames that measured only surfaces well behind it.
    pub through: u32,
}

impl FreeSpaceVotes {
    /// Returns whether the point no longer exists: at least `enough` frames saw through it, and
    /// more than twice as many as measured a surface.
    #[must_use]
    pub fn is_gone(&self, enough: u32) -> bool {
        self.through >= enough && self.through > 2 * self.hits
    }

    /// Returns whether any frame has evidence.
    #[must_use]
    pub fn is_known(&self) -> bool {
        self.hits + self.through > 0
    }
}

/// Counts the evidence of frames for points (meters, world frame, Z up). Returns one result per
/// point. Points behind a measured surface are hidden and get no evidence.
///
/// # Errors
/// Returns a [`FrameError`] for a depth picture that cannot be read, and the errors of `check`,
/// which is called once per frame.
pub fn count_free_space<E: From<FrameError> + Send>(
    positions: &[Point3<f32>],
    frames: &[FrameRef],
    mut check: impl FnMut(usize) -> Result<(), E> + Send,
) -> Result<Vec<FreeSpaceVotes>, E> {
    let mut looks = vec![FreeSpaceVotes::default(); positions.len()];
    stream_frames(
        frames,
        |frame| Ok::<_, E>(frame.decode_depth()?),
        |i, depth| {
            let camera = frames[i].depth_camera();
            looks.par_iter_mut().zip(positions).for_each(|(looks, position)| {
                let Some(pixel) = camera.project(position) else { return };
                match classify_pixel(&depth, pixel.cell(), pixel.z_m) {
                    Some(true) => looks.hits += 1,
                    Some(false) => looks.through += 1,
                    None => {}
                }
            });
            check(i)
        },
    )?;
    Ok(looks)
}

/// Returns `true` if a surface was measured there, `false` if the frame saw through, and `None` if
/// the point is hidden or not measured.
fn classify_pixel(depth: &DepthImage, (column, row): (u32, u32), z_m: f32) -> Option<bool> {
    let measured_m = depth.at((column, row));
    if measured_m <= 0.0 {
        return None;
    }
    let margin_m = (MARGIN * measured_m).max(MARGIN_M);
    if (measured_m - z_m).abs() <= margin_m {
        return Some(true);
    }
    if measured_m < z_m {
        return None;
    }
    let around = AROUND_PX * depth.width.div_ceil(AT_WIDTH_PX).max(1);
    let columns = column.saturating_sub(around)..(column + around + 1).min(depth.width);
    let rows = row.saturating_sub(around)..(row + around + 1).min(depth.height);
    let (mut measured, mut all) = (0_u32, 0_u32);
    for at in rows.flat_map(|row| columns.clone().map(move |column| (column, row))) {
        let around_m = depth.at(at);
        all += 1;
        if around_m > 0.0 {
            measured += 1;
            if around_m <= z_m + margin_m {
                return None;
            }
        }
    }
    (measured as f32 >= MEASURED * all as f32).then_some(false)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn wall(at_m: impl Fn(u32, u32) -> f32) -> DepthImage {
        let (width, height) = (32, 24);
        let depth_m = (0..width * height).map(|i| at_m(i % width, i / width)).collect();
        DepthImage { width, height, depth_m }
    }

    #[test]
    fn points_well_in_front_of_a_surface_count_as_seen_through() {
        let depth = wall(|_, _| 3.0);
        assert_eq!(classify_pixel(&depth, (16, 12), 3.05), Some(true));
        assert_eq!(
            classify_pixel(&depth, (16, 12), 2.93),
            Some(true),
            "within the noise at three meters"
        );
        assert_eq!(classify_pixel(&depth, (16, 12), 2.0), Some(false));
        assert_eq!(classify_pixel(&depth, (16, 12), 3.5), None, "hidden behind the wall");
        assert_eq!(
            classify_pixel(&depth, (0, 0), 2.0),
            Some(false),
            "at the border of the picture"
        );
    }

    #[test]
    fn silhouettes_and_holes_give_no_evidence() {
        let edge = wall(|u, _| if u < 15 { 2.0 } else { 3.0 });
        assert_eq!(
            classify_pixel(&edge, (16, 12), 2.0),
            None,
            "a surface two pixels away can be the point"
        );
        assert_eq!(classify_pixel(&edge, (18, 12), 2.0), Some(false));
        let holes = wall(|u, _| if u % 2 == 0 { 3.0 } else { 0.0 });
        assert_eq!(classify_pixel(&holes, (16, 12), 2.0), None);
        assert_eq!(classify_pixel(&holes, (17, 12), 2.0), None);
    }

    #[test]
    fn a_point_is_gone_only_if_enough_frames_see_through_it() {
        let looks = |hits, through| FreeSpaceVotes { hits, through };
        assert!(looks(0, 2).is_gone(2) && looks(1, 3).is_gone(2));
        assert!(!looks(0, 1).is_gone(2) && !looks(1, 2).is_gone(2) && !looks(0, 0).is_gone(1));
    }
}
