use super::*;
use image::RgbImage;
use uniground_geometry::Isometry3;
use uniground_geometry::scene::{Camera, DepthImage};

/// A look along +Z at a desk 1 m away and a wall 3 m away: a point for every tenth pixel of 200 x
/// 100. The wall fills the right half. The first row of the desk is hidden.
fn desk_before_wall() -> FrameLookup {
    let intrinsics =
        Intrinsics { width: 200, height: 100, fx: 100.0, fy: 100.0, cx: 100.0, cy: 50.0 };
    let camera = Camera::new(intrinsics, &Isometry3::identity());
    let seen = (0..200).map(|i| {
        let (column, row) = (i % 20 * 10 + 5, i / 20 * 10 + 5);
        let z_m = if column < 100 { 1.0 } else { 3.0 };
        let along = |at: u32, middle: f32| (at as f32 - middle) * z_m / 100.0;
        let is_hidden = column < 100 && row == 5;
        FramePoint {
            point: i,
            position: Point3::new(along(column, 100.0), along(row, 50.0), z_m),
            cell: (column, row),
            sight: if is_hidden { PointVisibility::Hidden } else { PointVisibility::Visible },
        }
    });
    let frame = Frame {
        index: FrameIndex(0),
        color: RgbImage::new(200, 100),
        depth: DepthImage { width: 200, height: 100, depth_m: vec![1.0; 20_000] },
        color_camera: camera,
        depth_camera: camera,
    };
    FrameLookup { frame, seen: seen.collect(), cut: FrameSegmentation::Images(Vec::new()) }
}

#[test]
fn points_in_an_area_are_visible_and_as_far_away_as_its_middle() {
    let looked = desk_before_wall();
    // Columns 55 to 105 and rows 5 to 45: the last column is the wall's.
    let area = PixelArea { left: 50.0, top: 0.0, right: 110.0, bottom: 50.0 };
    let points = looked.points_in_area(&area);
    let expected: Vec<u32> = (1..5).flat_map(|row| (5..10).map(move |i| row * 20 + i)).collect();
    assert_eq!(points, expected);
    // They are seen at columns 55 to 95 and rows 15 to 45.
    let seen = PixelArea { left: 55.0, top: 15.0, right: 95.0, bottom: 45.0 };
    assert!((looked.fill(&points, &seen) - 1.0).abs() < 1e-4);
    assert!((looked.fill(&points, &area) - 0.4).abs() < 1e-4);
    let beside = PixelArea { left: 300.0, top: 0.0, right: 310.0, bottom: 10.0 };
    assert!(looked.points_in_area(&beside).is_empty() && looked.fill(&[], &area) == 0.0);
}
