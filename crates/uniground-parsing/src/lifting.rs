//! Lifting: what each frame sees of each superpoint, and in which masks.
//!
//! Frames arrive one at a time and leave a sparse table behind: memory is (superpoints seen) x
//! (masks they touch) per frame, never points x frames.

use super::ParseError;
use super::checkpoints::StageLog;
use super::masks::{IdImage, IdRuns, MaskSource};
use super::sharpness::{Sharpness, SharpnessOfFrames};
use super::visibility::Visibility;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use uniground_geometry::progress::Progress;
use uniground_geometry::scene::{Frame, FrameIndex, FrameRef, stream_frames};

/// What one frame sees, by one of its id images. Rows are sorted by superpoint.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct FrameVisibility {
    /// The frame looked into.
    pub frame: FrameIndex,
    /// Which of the frame's id images, from 0.
    pub layer: u32,
    /// How many masks the image has.
    pub masks: u32,
    /// One per superpoint it sees; empty when it sees no point of the cloud.
    pub rows: Vec<VisibleSuperpoint>,
}

/// One superpoint in one frame.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct VisibleSuperpoint {
    /// Its number, from 0; that of a region after [`coarsen`].
    pub superpoint: u32,
    /// Points of the superpoint this frame sees.
    pub visible: u32,
    /// Visible points per mask, sorted by mask id; points under no mask are not listed.
    pub masks: Vec<(u16, u32)>,
}

/// A labelled cloud, and how a frame sees it.
pub struct LiftingInput<'a> {
    /// The points, by superpoint.
    pub visibility: &'a Visibility,
    /// One superpoint, numbered from 0, per point of the cloud.
    pub superpoint_of_point: &'a [u32],
    /// Who cuts a frame into masks.
    pub masks: &'a dyn MaskSource,
}

/// What a frame sees of each superpoint, and its masks themselves.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Lifted {
    /// The frame looked into.
    pub frame: FrameIndex,
    /// By superpoint, for each id image.
    pub tables: Vec<FrameVisibility>,
    /// By pixel, as many.
    pub masks: Vec<IdRuns>,
    /// Of its photograph: looked at here, where it is decoded anyway.
    pub sharpness: Sharpness,
}

/// The id images of each frame.
pub type MasksOfFrames = BTreeMap<FrameIndex, Vec<IdRuns>>;

impl Lifted {
    /// The tables of all frames, and the masks and the sharpness of each.
    #[must_use]
    pub fn apart(lifted: Vec<Self>) -> (Vec<FrameVisibility>, MasksOfFrames, SharpnessOfFrames) {
        let sharpness =
            lifted.iter().map(|lifted| (lifted.frame, lifted.sharpness.clone())).collect();
        let (tables, masks): (Vec<_>, MasksOfFrames) =
            lifted.into_iter().map(|lifted| (lifted.tables, (lifted.frame, lifted.masks))).unzip();
        (tables.concat(), masks, sharpness)
    }

    /// The same with new numbers of superpoints, by old one; `None`: gone. Those that stay keep
    /// their order.
    pub fn renumber(&mut self, number: &[Option<u32>]) {
        for table in &mut self.tables {
            table.rows.retain_mut(|row| {
                let now = number[row.superpoint as usize];
                row.superpoint = now.unwrap_or(0);
                now.is_some()
            });
        }
    }
}

impl LiftingInput<'_> {
    /// All frames, in order. Frames kept in `log` are not looked at again; the flag tells whether
    /// that was all.
    ///
    /// # Errors
    /// [`ParseError`]: an unreadable frame, or cancellation.
    pub fn all(
        &self,
        frames: &[FrameRef],
        mut log: StageLog<Lifted>,
        progress: &Progress,
    ) -> Result<(Vec<Lifted>, bool), ParseError> {
        let mut lifted = log.kept();
        let kept = lifted
            .iter()
            .zip(frames)
            .take_while(|(lifted, frame)| lifted.frame == frame.index)
            .count();
        lifted.truncate(kept);
        log.forget_after(kept);
        stream_frames(
            &frames[kept..],
            |frame| {
                progress.check()?;
                let frame = frame.decode()?;
                let images = self.masks.masks(&frame, progress)?;
                let tables = lift(self.visibility, self.superpoint_of_point, &frame, &images);
                let (masks, sharpness) =
                    (images.iter().map(IdRuns::of).collect(), Sharpness::of(&frame.colour));
                Ok::<_, ParseError>(Lifted { frame: frame.index, tables, masks, sharpness })
            },
            |i, frame| {
                log.append(&frame);
                lifted.push(frame);
                Ok(progress
                    .report("masks_and_lifting", (kept + i + 1) as f32 / frames.len() as f32)?)
            },
        )?;
        Ok((lifted, kept > 0 && kept == frames.len()))
    }
}

/// Looks up every point in one frame and its id images; `visibility` goes by superpoint.
#[must_use]
pub fn lift(
    visibility: &Visibility,
    superpoint_of_point: &[u32],
    frame: &Frame,
    images: &[IdImage],
) -> Vec<FrameVisibility> {
    let seen = visibility.in_frame(&frame.depth_camera, &frame.depth);
    (0..)
        .zip(images)
        .map(|(layer, masks)| {
            let rows = seen
                .chunk_by(|a, b| {
                    superpoint_of_point[a.point as usize] == superpoint_of_point[b.point as usize]
                })
                .map(|of_superpoint| {
                    let mut ids: Vec<u16> =
                        of_superpoint.iter().map(|seen| masks.at(seen.cell)).collect();
                    ids.sort_unstable();
                    VisibleSuperpoint {
                        superpoint: superpoint_of_point[of_superpoint[0].point as usize],
                        visible: of_superpoint.len() as u32,
                        masks: ids
                            .chunk_by(|a, b| a == b)
                            .filter(|same| same[0] != 0)
                            .map(|same| (same[0], same.len() as u32))
                            .collect(),
                    }
                })
                .collect();
            FrameVisibility { frame: frame.index, layer, masks: masks.count(), rows }
        })
        .collect()
}

/// The same table for coarser primitives: `region_of[superpoint]` replaces superpoints.
#[must_use]
pub fn coarsen(table: &FrameVisibility, region_of: &[u32]) -> FrameVisibility {
    let mut rows: Vec<VisibleSuperpoint> = table
        .rows
        .iter()
        .map(|row| VisibleSuperpoint {
            superpoint: region_of[row.superpoint as usize],
            ..row.clone()
        })
        .collect();
    rows.sort_by_key(|row| row.superpoint);
    let rows = rows
        .chunk_by(|a, b| a.superpoint == b.superpoint)
        .map(|parts| {
            let mut masks: Vec<(u16, u32)> =
                parts.iter().flat_map(|p| p.masks.iter().copied()).collect();
            masks.sort_unstable();
            VisibleSuperpoint {
                superpoint: parts[0].superpoint,
                visible: parts.iter().map(|p| p.visible).sum(),
                masks: masks
                    .chunk_by(|a, b| a.0 == b.0)
                    .map(|same| (same[0].0, same.iter().map(|m| m.1).sum()))
                    .collect(),
            }
        })
        .collect();
    FrameVisibility { rows, ..*table }
}

#[cfg(test)]
mod tests {
    use super::*;
    use uniground_geometry::scene::{Camera, DepthImage, Intrinsics, PointCloud};
    use uniground_geometry::{Isometry3, Point3};

    /// A 4x4 camera at the origin looking along +Z at a wall two metres away, with a hole in the
    /// last row.
    fn frame() -> Frame {
        let intrinsics = Intrinsics { width: 4, height: 4, fx: 4.0, fy: 4.0, cx: 1.5, cy: 1.5 };
        let camera = Camera::new(intrinsics, &Isometry3::identity());
        let depth_m = (0..16).map(|i| if i < 12 { 2.0 } else { 0.0 }).collect();
        Frame {
            index: FrameIndex(0),
            colour: image::RgbImage::new(4, 4),
            depth: DepthImage { width: 4, height: 4, depth_m },
            colour_camera: camera,
            depth_camera: camera,
        }
    }

    #[test]
    fn each_id_image_has_a_table_of_visible_points() {
        let frame = frame();
        let at = |u: f32, v: f32, z: f32| frame.depth_camera.intrinsics.unproject(u, v, z);
        let cloud = PointCloud {
            positions: vec![
                at(0.0, 0.0, 2.0),
                at(1.0, 0.0, 2.05),
                at(2.0, 0.0, 3.0),
                at(3.0, 3.0, 2.0),
                Point3::new(9.0, 0.0, 2.0),
                Point3::new(0.0, 0.0, -2.0),
            ],
            colours: vec![[0; 3]; 6],
        };
        let masks =
            IdImage { width: 4, height: 4, ids: (0..16).map(|i| u16::from(i != 1) * 7).collect() };
        let whole = IdImage { ids: vec![3; 16], ..masks.clone() };
        let tables =
            lift(&Visibility::new(&cloud, &[5; 6], 0.05), &[5; 6], &frame, &[masks, whole]);
        assert_eq!(
            tables[0].rows,
            [VisibleSuperpoint { superpoint: 5, visible: 2, masks: vec![(7, 1)] }]
        );
        assert_eq!(
            tables[1].rows,
            [VisibleSuperpoint { superpoint: 5, visible: 2, masks: vec![(3, 2)] }]
        );
    }

    #[test]
    fn coarsening_adds_up() {
        let row = |superpoint, visible, masks: &[(u16, u32)]| VisibleSuperpoint {
            superpoint,
            visible,
            masks: masks.to_vec(),
        };
        let table = FrameVisibility {
            frame: FrameIndex(0),
            layer: 0,
            masks: 2,
            rows: vec![row(0, 3, &[(1, 3)]), row(1, 4, &[(2, 4)]), row(2, 5, &[(1, 2), (2, 3)])],
        };
        let coarse = coarsen(&table, &[1, 0, 1]);
        assert_eq!(coarse.rows, [row(0, 4, &[(2, 4)]), row(1, 8, &[(1, 5), (2, 3)])]);
    }
}
