use super::*;
use crate::visibility::PointVisibility;
use camino::Utf8Path;
use image::{ImageBuffer, Luma, Rgb, RgbImage};
use uniground_geometry::Isometry3;
use uniground_geometry::scene::{Camera, DepthImage, Frame, Intrinsics, Optics};

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

/// Half the side of the red board, meters.
const HALF_M: f32 = 0.4;

/// A gray wall 2 m in front of the camera at the origin, which looks along +Z, with a red board of
/// 0.8 x 0.8 m that stands out by 0.1 m. The picture shows 4 x 3 m of the wall.
fn red_board(folder: &Utf8Path) -> (PointCloud, FrameRef) {
    let intrinsics =
        Intrinsics { width: 200, height: 150, fx: 100.0, fy: 100.0, cx: 99.5, cy: 74.5 };
    let is_board = |x: f32, y: f32| x.abs() <= HALF_M && y.abs() <= HALF_M;
    let (red, gray) = ([200, 20, 20], [128, 128, 128]);
    let mut cloud = PointCloud::default();
    for (i, j) in (-70..=70).flat_map(|i| (-50..=50).map(move |j| (i, j))) {
        let (x, y) = (i as f32 * 0.02, j as f32 * 0.02);
        cloud.positions.push(Point3::new(x, y, if is_board(x, y) { 1.9 } else { 2.0 }));
        cloud.colors.push(if is_board(x, y) { red } else { gray });
    }
    let on_board =
        |u: u32, v: u32| is_board((u as f32 - 99.5) / 100.0 * 1.9, (v as f32 - 74.5) / 100.0 * 1.9);
    let picture = RgbImage::from_fn(200, 150, |u, v| Rgb(if on_board(u, v) { red } else { gray }));
    let depth_mm = |u, v| Luma([if on_board(u, v) { 1900_u16 } else { 2000 }]);
    let (color, depth) = (folder.join("color.png"), folder.join("depth.png"));
    picture.save(&color).unwrap();
    ImageBuffer::from_fn(200, 150, depth_mm).save(&depth).unwrap();
    let frame = FrameRef {
        index: FrameIndex(0),
        time_s: None,
        color,
        depth,
        color_intrinsics: intrinsics,
        depth_intrinsics: intrinsics,
        depth_scale_m: 0.001,
        camera_to_world: Isometry3::identity(),
        optics: Optics::default(),
    };
    (cloud, frame)
}

#[test]
fn a_piece_is_replaced_by_what_fills_the_area_of_the_object() {
    let folder = tempfile::tempdir().unwrap();
    let (cloud, frame) = red_board(Utf8Path::from_path(folder.path()).unwrap());
    let settings = ParsingSettings::default();
    let frames = [frame];
    let finder = PointedObjectFinder {
        cloud: &cloud,
        frames: &frames,
        segmenter: None,
        settings: &settings,
    };
    let square = |id: u32, x: (f32, f32), y: (f32, f32)| {
        let (low, high) = (Point3::new(x.0, y.0, 1.85), Point3::new(x.1, y.1, 1.95));
        Instance::from_box(InstanceId(id), Aabb::from_corners(low, high))
    };
    // A quarter of the board, a piece of the wall far from it, and all of the board.
    let quarter = square(1, (-HALF_M, 0.0), (-HALF_M, 0.0));
    let beside = square(2, (0.9, 1.3), (-0.9, -0.5));
    let whole = square(3, (-HALF_M, HALF_M), (-HALF_M, HALF_M));
    let area = |half_px: f32| PixelArea {
        left: 99.5 - half_px,
        top: 74.5 - half_px,
        right: 99.5 + half_px,
        bottom: 74.5 + half_px,
    };
    let better = |known: &[Instance], taken: u32, area: PixelArea| {
        let place = PhotographPoint { frame: FrameIndex(0), at: (99.5, 74.5), area: Some(area) };
        finder.find_better(place, known, InstanceId(taken)).unwrap()
    };
    let known = [quarter.clone(), beside.clone()];
    let made = better(&known, 1, area(21.0)).expect("the board is not found");
    assert_eq!(made.id, InstanceId(3));
    assert!(made.aabb.iou(&whole.aabb) > 0.0 && made.views.len() == 1);
    assert!((made.aabb.size.xy() - whole.aabb.size.xy()).norm() < 0.1, "{:?}", made.aabb);
    // A known instance that fits is taken.
    let known = [quarter, beside, whole];
    assert_eq!(better(&known, 1, area(21.0)).map(|found| found.id), Some(InstanceId(3)));
    // What fits already stays, and so does what has nothing to do with the area, or reaches out of
    // the picture.
    assert_eq!(better(&known, 3, area(21.0)), None);
    assert_eq!(better(&known, 2, area(21.0)), None);
    assert_eq!(better(&known, 1, area(90.0)), None);
}
