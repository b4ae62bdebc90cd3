//! Lifting: which superpoints each frame sees, and in which masks.
//!
//! Frames are processed one at a time, each into a sparse table. Memory is (superpoints seen) x
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
    /// The frame.
    pub frame: FrameIndex,
    /// Index of the frame's id image, from 0.
    pub layer: u32,
    /// Number of masks in the image.
    pub masks: u32,
    /// One row per superpoint it sees; empty when it sees no point of the cloud.
    pub rows: Vec<VisibleSuperpoint>,
}

/// One superpoint as seen in one frame.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct VisibleSuperpoint {
    /// The superpoint's number, from 0; after [`coarsen`], that of a region.
    pub superpoint: u32,
    /// Number of its points that this frame sees.
    pub visible: u32,
    /// Visible points per mask, sorted by mask id; points under no mask are not listed.
    pub masks: Vec<(u16, u32)>,
}

/// A labeled cloud, prepared for lifting.
pub struct LiftingInput<'a> {
    /// Looks points up in frames, grouped by superpoint.
    pub visibility: &'a Visibility,
    /// The superpoint of each point of the cloud, numbered from 0.
    pub superpoint_of_point: &'a [u32],
    /// Segments a frame into masks.
    pub masks: &'a dyn MaskSource,
}

/// What a frame sees of each superpoint, with the masks themselves.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Lifted {
    /// The frame.
    pub frame: FrameIndex,
    /// One table per id image, by superpoint.
    pub tables: Vec<FrameVisibility>,
    /// The id images by pixel, one per table.
    pub masks: Vec<IdRuns>,
    /// Sharpness of its photograph, measured here because it is decoded anyway.
    pub sharpness: Sharpness,
}

/// The id images of each frame.
pub type MasksOfFrames = BTreeMap<FrameIndex, Vec<IdRuns>>;

impl Lifted {
    /// Splits into the tables of all frames, and the masks and sharpness of each frame.
    #[must_use]
    pub fn split(lifted: Vec<Self>) -> (Vec<FrameVisibility>, MasksOfFrames, SharpnessOfFrames) {
        let sharpness =
            lifted.iter().map(|lifted| (lifted.frame, lifted.sharpness.clone())).collect();
        let (tables, masks): (Vec<_>, MasksOfFrames) =
            lifted.into_iter().map(|lifted| (lifted.tables, (lifted.frame, lifted.masks))).unzip();
        (tables.concat(), masks, sharpness)
    }

    /// Renumbers superpoints by their old number; `None`: removed. The remaining ones must keep
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
    /// Lifts all frames, in order. Frames stored in `log` are not processed again; the flag is
    /// `true` when all of them were.
    ///
    /// # Errors
    /// [`ParseError`]: an unreadable frame, or cancellation.
    pub fn lift_all(
        &self,
        frames: &[FrameRef],
        mut log: StageLog<Lifted>,
        progress: &Progress,
    ) -> Result<(Vec<Lifted>, bool), ParseError> {
        let mut lifted = log.take_records();
        let kept = lifted
            .iter()
            .zip(frames)
            .take_while(|(lifted, frame)| lifted.frame == frame.index)
            .count();
        lifted.truncate(kept);
        log.truncate_after(kept);
        stream_frames(
            &frames[kept..],
            |frame| {
                progress.check()?;
                let frame = frame.decode()?;
                let images = self.masks.masks(&frame, progress)?;
                let tables = lift(self.visibility, self.superpoint_of_point, &frame, &images);
                let (masks, sharpness) = (
                    images.iter().map(IdRuns::from_image).collect(),
                    Sharpness::measure(&frame.color),
                );
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

/// Looks up every point in one frame and its id images; `visibility` is grouped by superpoint.
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

/// Converts a table to coarser primitives: `region_of[superpoint]` replaces superpoints.
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
    use crate::checkpoints::Checkpoints;
    use camino::Utf8Path;
    use proptest::prelude::*;
    use std::sync::atomic::{AtomicU32, Ordering};
    use std::sync::{Arc, Mutex};
    use uniground_geometry::scene::{Camera, DepthImage, Intrinsics, Optics, PointCloud};
    use uniground_geometry::{Isometry3, Point3};

    /// Returns a frame of a 4x4 camera at the origin that looks along +Z at a wall two meters away,
    /// with a hole in the last row.
    fn frame() -> Frame {
        let intrinsics = Intrinsics { width: 4, height: 4, fx: 4.0, fy: 4.0, cx: 1.5, cy: 1.5 };
        let camera = Camera::new(intrinsics, &Isometry3::identity());
        let depth_m = (0..16).map(|i| if i < 12 { 2.0 } else { 0.0 }).collect();
        Frame {
            index: FrameIndex(0),
            color: image::RgbImage::new(4, 4),
            depth: DepthImage { width: 4, height: 4, depth_m },
            color_camera: camera,
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
            colors: vec![[0; 3]; 6],
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
    fn coarsening_sums_visible_points_and_masks() {
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

    fn row(superpoint: u32, visible: u32, masks: &[(u16, u32)]) -> VisibleSuperpoint {
        VisibleSuperpoint { superpoint, visible, masks: masks.to_vec() }
    }

    fn table(frame: u32, layer: u32, masks: u32, rows: Vec<VisibleSuperpoint>) -> FrameVisibility {
        FrameVisibility { frame: FrameIndex(frame), layer, masks, rows }
    }

    /// Returns a cloud with one point on the wall per pixel.
    fn on_wall(frame: &Frame, pixels: &[(f32, f32)]) -> PointCloud {
        let intrinsics = frame.depth_camera.intrinsics;
        let positions: Vec<Point3<f32>> =
            pixels.iter().map(|&(u, v)| intrinsics.unproject(u, v, 2.0)).collect();
        PointCloud { colors: vec![[0; 3]; positions.len()], positions }
    }

    #[test]
    fn points_are_counted_by_superpoint_and_by_mask() {
        let frame = frame();
        // By row: masks 9 9 5 5, then 0 5 5 0, then 9 0 0 0; the last row is a hole in the depth.
        let ids = vec![9, 9, 5, 5, 0, 5, 5, 0, 9, 0, 0, 0, 9, 9, 9, 9];
        let masks = IdImage { width: 4, height: 4, ids };
        let pixels = [
            (0.0, 0.0), // 9
            (2.0, 0.0), // 5
            (3.0, 0.0), // 5
            (0.0, 1.0), // under no mask
            (1.0, 1.0), // 5
            (0.0, 2.0), // 9
            (3.0, 2.0), // under no mask
            (0.0, 3.0), // in the hole
            (1.0, 0.0), // 9
        ];
        let cloud = on_wall(&frame, &pixels);
        let superpoint_of_point = [2, 2, 2, 2, 0, 0, 3, 1, 2];
        let visibility = Visibility::new(&cloud, &superpoint_of_point, 0.05);
        let tables = lift(&visibility, &superpoint_of_point, &frame, &[masks]);
        // 0: two points, one in each mask. 1: in the hole. 2: five points, two in each mask and one
        // in none. 3: one point, in none.
        let rows = vec![row(0, 2, &[(5, 1), (9, 1)]), row(2, 5, &[(5, 2), (9, 2)]), row(3, 1, &[])];
        assert_eq!(tables, [table(0, 0, 2, rows)]);
    }

    #[test]
    fn frame_without_visible_points_has_an_empty_table_per_id_image() {
        let frame = frame();
        let cloud = on_wall(&frame, &[(0.0, 3.0)]);
        let masks = IdImage { width: 4, height: 4, ids: (0..16).map(|i| i % 4).collect() };
        let none = IdImage { width: 4, height: 4, ids: vec![0; 16] };
        let visibility = Visibility::new(&cloud, &[0], 0.05);
        assert_eq!(
            lift(&visibility, &[0], &frame, &[masks, none]),
            [table(0, 0, 3, vec![]), table(0, 1, 0, vec![])]
        );
        assert!(lift(&visibility, &[0], &frame, &[]).is_empty());
    }

    #[test]
    fn coarsening_keeps_frame_layer_and_mask_count() {
        let fine = table(7, 2, 4, vec![row(1, 3, &[(4, 2), (6, 1)]), row(2, 5, &[(3, 1), (6, 2)])]);
        // Both become region 0: masks 3, 4 and 6 with 1, 2 and 1 + 2 points; 3 + 5 are visible.
        assert_eq!(
            coarsen(&fine, &[5, 0, 0]),
            table(7, 2, 4, vec![row(0, 8, &[(3, 1), (4, 2), (6, 3)])])
        );
        // No two are merged: the same rows, ordered by their new numbers.
        assert_eq!(
            coarsen(&fine, &[0, 9, 4]),
            table(7, 2, 4, vec![row(4, 5, &[(3, 1), (6, 2)]), row(9, 3, &[(4, 2), (6, 1)])])
        );
        assert_eq!(coarsen(&table(1, 0, 0, vec![]), &[]), table(1, 0, 0, vec![]));
    }

    fn lifted(frame: u32, tables: Vec<FrameVisibility>, ids: Vec<u16>, green: u8) -> Lifted {
        let mut photograph = image::RgbImage::new(32, 32);
        photograph.put_pixel(9, 9, image::Rgb([0, green, 0]));
        let image = IdImage { width: ids.len() as u32, height: 1, ids };
        Lifted {
            frame: FrameIndex(frame),
            tables,
            masks: vec![IdRuns::from_image(&image)],
            sharpness: Sharpness::measure(&photograph),
        }
    }

    #[test]
    fn lifted_frames_split_into_tables_masks_and_sharpness() {
        let one = lifted(
            3,
            vec![table(3, 0, 1, vec![row(0, 2, &[(1, 2)])]), table(3, 1, 1, vec![])],
            vec![1, 1, 0],
            10,
        );
        let other = lifted(8, vec![table(8, 0, 2, vec![row(4, 1, &[])])], vec![2, 0, 5], 200);
        let (tables, masks, sharpness) = Lifted::split(vec![one.clone(), other.clone()]);
        assert_eq!(tables, [&one.tables[..], &other.tables[..]].concat());
        assert_eq!(
            masks,
            BTreeMap::from([(FrameIndex(3), one.masks), (FrameIndex(8), other.masks)])
        );
        assert_ne!(one.sharpness, other.sharpness);
        assert_eq!(
            sharpness,
            BTreeMap::from([(FrameIndex(3), one.sharpness), (FrameIndex(8), other.sharpness)])
        );
    }

    #[test]
    fn renumbering_removes_deleted_superpoints_from_every_id_image() {
        let before = |layer| {
            table(6, layer, 2, vec![row(0, 1, &[(1, 1)]), row(1, 2, &[]), row(3, 4, &[(2, 3)])])
        };
        let mut found = lifted(6, vec![before(0), before(1)], vec![1], 0);
        let masks = found.masks.clone();
        found.renumber(&[Some(0), None, None, Some(1)]);
        let after = |layer| table(6, layer, 2, vec![row(0, 1, &[(1, 1)]), row(1, 4, &[(2, 3)])]);
        assert_eq!((found.tables, found.masks), (vec![after(0), after(1)], masks));
        let mut none = lifted(6, vec![before(0)], vec![1], 0);
        none.renumber(&[None; 4]);
        assert_eq!(none.tables, [table(6, 0, 2, vec![])]);
    }

    /// Cuts every frame into a left and a right half, and counts its calls.
    #[derive(Default)]
    struct Halves(AtomicU32);

    impl MaskSource for Halves {
        fn name(&self) -> &'static str {
            "halves"
        }

        fn masks(&self, _: &Frame, _: &Progress) -> Result<Vec<IdImage>, ParseError> {
            self.0.fetch_add(1, Ordering::Relaxed);
            let ids = (0..16).map(|i| if i % 4 < 2 { 1 } else { 2 }).collect();
            Ok(vec![IdImage { width: 4, height: 4, ids }])
        }
    }

    /// Writes the picture files of [`frame`] and returns a reference to them for each of these
    /// numbers.
    fn frames_on_disk(folder: &Utf8Path, numbers: &[u32]) -> Vec<FrameRef> {
        let (color, depth) = (folder.join("color.png"), folder.join("depth.png"));
        image::RgbImage::new(4, 4).save(&color).unwrap();
        let depth_mm = (0..16).map(|i| if i < 12 { 2000 } else { 0 }).collect();
        image::ImageBuffer::<image::Luma<u16>, Vec<u16>>::from_raw(4, 4, depth_mm)
            .unwrap()
            .save(&depth)
            .unwrap();
        let intrinsics = frame().depth_camera.intrinsics;
        let of_number = |&number: &u32| FrameRef {
            index: FrameIndex(number),
            time_s: None,
            color: color.clone(),
            depth: depth.clone(),
            color_intrinsics: intrinsics,
            depth_intrinsics: intrinsics,
            depth_scale_m: 0.001,
            camera_to_world: Isometry3::identity(),
            optics: Optics::default(),
        };
        numbers.iter().map(of_number).collect()
    }

    #[test]
    fn frames_with_checkpoints_are_not_processed_again() {
        let folder = tempfile::tempdir().unwrap();
        let folder = Utf8Path::from_path(folder.path()).unwrap();
        let frames = frames_on_disk(folder, &[0, 2, 4, 6]);
        let cloud = on_wall(&frame(), &[(0.0, 0.0), (3.0, 0.0), (3.0, 1.0)]);
        let superpoint_of_point = [0, 1, 1];
        let visibility = Visibility::new(&cloud, &superpoint_of_point, 0.02);
        let checkpoints = Checkpoints::in_folder(folder, "scan");
        // Per call: the lifted frames, whether all came from checkpoints, the number of processed
        // frames, and the reported progress.
        let all = |frames: &[FrameRef]| {
            let (halves, told) = (Halves::default(), Arc::new(Mutex::new(Vec::new())));
            let lifting = LiftingInput {
                visibility: &visibility,
                superpoint_of_point: &superpoint_of_point,
                masks: &halves,
            };
            let sink = told.clone();
            let progress = Progress::new(
                move |stage, done| sink.lock().unwrap().push((stage, done)),
                || false,
            );
            let (lifted, all_kept) =
                lifting.lift_all(frames, checkpoints.open_log("masks", &0), &progress).unwrap();
            let told = told.lock().unwrap().clone();
            (lifted, all_kept, halves.0.into_inner(), told)
        };
        let seen =
            |number| vec![table(number, 0, 2, vec![row(0, 1, &[(1, 1)]), row(1, 2, &[(2, 2)])])];
        let tables_of = |lifted: Vec<Lifted>| {
            lifted.into_iter().map(|lifted| lifted.tables).collect::<Vec<_>>()
        };
        let stage = "masks_and_lifting";

        let (nothing, all_kept, asked, told) = all(&[]);
        assert_eq!((nothing, all_kept, asked, told), (vec![], false, 0, vec![]));
        let (first, all_kept, asked, told) = all(&frames[..2]);
        assert_eq!((all_kept, asked), (false, 2));
        assert_eq!(told, [(stage, 0.5), (stage, 1.0)]);
        assert_eq!(first[1].frame, FrameIndex(2));
        assert_eq!(tables_of(first), [seen(0), seen(2)]);
        // Two of four have checkpoints: the third ends at 3/4, the fourth at 1.
        let (more, all_kept, asked, told) = all(&frames);
        assert_eq!((all_kept, asked), (false, 2));
        assert_eq!(told, [(stage, 0.75), (stage, 1.0)]);
        assert_eq!(tables_of(more.clone()), [seen(0), seen(2), seen(4), seen(6)]);
        assert_eq!(more[3].masks, [IdRuns::from_image(&halves_of_a_frame())]);
        let (again, all_kept, asked, told) = all(&frames);
        assert_eq!((again, all_kept, asked, told), (more, true, 0, vec![]));
        // A different second frame: checkpoints before it are used, later ones are dropped.
        let others = frames_on_disk(folder, &[0, 3, 4, 6]);
        let (other, all_kept, asked, told) = all(&others);
        assert_eq!((all_kept, asked), (false, 3));
        assert_eq!(told, [(stage, 0.5), (stage, 0.75), (stage, 1.0)]);
        assert_eq!(tables_of(other), [seen(0), seen(3), seen(4), seen(6)]);
        // Fewer frames than checkpoints.
        let (fewer, all_kept, asked, _) = all(&others[..1]);
        assert_eq!((tables_of(fewer), all_kept, asked), (vec![seen(0)], true, 0));
        assert_eq!(all(&others).2, 3, "the other checkpoints were dropped");
    }

    fn halves_of_a_frame() -> IdImage {
        Halves::default().masks(&frame(), &Progress::silent()).unwrap().remove(0)
    }

    #[test]
    fn unreadable_frames_and_cancellation_stop_lifting() {
        let folder = tempfile::tempdir().unwrap();
        let folder = Utf8Path::from_path(folder.path()).unwrap();
        let mut frames = frames_on_disk(folder, &[0]);
        let cloud = on_wall(&frame(), &[(0.0, 0.0)]);
        let visibility = Visibility::new(&cloud, &[0], 0.02);
        let halves = Halves::default();
        let lifting =
            LiftingInput { visibility: &visibility, superpoint_of_point: &[0], masks: &halves };
        let nowhere = Checkpoints::disabled();
        let cancelled = Progress::new(|_, _| {}, || true);
        let stopped =
            lifting.lift_all(&frames, nowhere.open_log("masks", &0), &cancelled).unwrap_err();
        assert!(matches!(stopped, ParseError::Cancelled(_)), "{stopped:?}");
        assert_eq!(halves.0.load(Ordering::Relaxed), 0, "no masks were computed");
        frames[0].depth = folder.join("missing.png");
        let failed = lifting.lift_all(&frames, nowhere.open_log("masks", &0), &Progress::silent());
        assert!(matches!(failed, Err(ParseError::Frame(_))), "{:?}", failed.map(drop));
    }

    proptest! {
        /// No point is lost or counted twice, whichever superpoints become one region.
        #[test]
        fn coarsening_keeps_every_point(
            fine in prop::collection::vec((0_u32..9, prop::array::uniform3(0_u32..5)), 0..12),
            region_of in prop::collection::vec(0_u32..4, 12),
        ) {
            let rows = (0..).zip(&fine).map(|(superpoint, (bare, counts))| {
                let masks: Vec<(u16, u32)> =
                    (1..).zip(counts.iter().copied()).filter(|mask| mask.1 > 0).collect();
                row(superpoint, bare + counts.iter().sum::<u32>(), &masks)
            });
            let fine = table(0, 0, 3, rows.collect());
            let coarse = coarsen(&fine, &region_of);
            prop_assert!(coarse.rows.is_sorted_by(|a, b| a.superpoint < b.superpoint));
            for region in 0..4 {
                let of = |row: &&VisibleSuperpoint| region_of[row.superpoint as usize] == region;
                let visible: u32 = fine.rows.iter().filter(of).map(|row| row.visible).sum();
                let found = coarse.rows.iter().find(|row| row.superpoint == region);
                prop_assert_eq!(found.map_or(0, |row| row.visible), visible, "region {}", region);
                for mask in 1..=3 {
                    let in_mask = |row: &VisibleSuperpoint| {
                        row.masks.iter().filter(|m| m.0 == mask).map(|m| m.1).sum::<u32>()
                    };
                    let expected: u32 = fine.rows.iter().filter(of).map(in_mask).sum();
                    let found = found.map_or(0, in_mask);
                    prop_assert_eq!(found, expected, "region {} mask {}", region, mask);
                }
            }
        }

        #[test]
        fn coarsening_in_two_steps_equals_one_step(
            counts in prop::collection::vec(prop::array::uniform3(1_u32..5), 1..10),
            first in prop::collection::vec(0_u32..5, 10),
            second in prop::collection::vec(0_u32..3, 5),
        ) {
            let rows = (0..).zip(&counts).map(|(superpoint, counts)| {
                let masks: Vec<(u16, u32)> = (1..).zip(counts.iter().copied()).collect();
                row(superpoint, counts.iter().sum(), &masks)
            });
            let fine = table(0, 0, 3, rows.collect());
            let both: Vec<u32> = first.iter().map(|&region| second[region as usize]).collect();
            prop_assert_eq!(coarsen(&coarsen(&fine, &first), &second), coarsen(&fine, &both));
        }
    }
}
