//! Which instances the frames of a scan show, and where: the cloud is drawn from every frame's
//! camera with the id of its instance in place of a color.

use super::building::box_contains;
use super::render_scene::{RenderScene, draw_splats};
use rayon::prelude::*;
use std::collections::{BTreeMap, BTreeSet, HashMap};
use uniground_geometry::Point3;
use uniground_geometry::scene::{
    Camera, CellMask, FrameIndex, FrameRef, Instance, InstanceId, Intrinsics, Level, PointCloud,
};

/// An instance in a frame's picture.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct VisibleInstance {
    /// The instance: a thing, or a piece of the building.
    pub id: InstanceId,
    /// Share of the picture's pixels that show it, `0..=1`.
    pub share: f32,
    /// The place in it that is farthest from its borders: shares of the picture's width and height.
    pub middle: [f32; 2],
    /// Distance of that place from its borders, as a share of the picture's width.
    pub margin: f32,
    /// Whether it reaches the rim of the picture.
    pub is_cut: bool,
}

/// What the frames of a scan show.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct FrameContents {
    /// In order of the frames.
    pub frames: Vec<FrameContent>,
}

/// What a frame shows.
#[derive(Debug, Clone, PartialEq)]
pub struct FrameContent {
    /// The frame.
    pub frame: FrameIndex,
    /// In order of id.
    pub instances: Vec<VisibleInstance>,
    /// The places whose surface it shows, of instances or not: indices of cubes of [`CELL_M`] in
    /// the world frame.
    pub cells: BTreeSet<[i32; 3]>,
}

/// Side of the cubes in which the visible surface is counted, meters.
const CELL_M: f32 = 0.4;
/// A frame shows a cube if this many pixels of its small picture do.
const CELL_PIXELS: usize = 12;

/// Width of the pictures in which visibility is determined, pixels.
const WIDTH_PX: u32 = 160;
/// Maximum number of points that are drawn; of a larger cloud, evenly chosen ones.
const MOST_POINTS: usize = 150_000;
/// Points this far outside of an instance's box still belong to it, meters.
const REACH_M: f32 = 0.01;
/// Side of the columns in which points are searched, meters.
const COLUMN_M: f32 = 0.25;

impl FrameContents {
    /// Determines what every frame shows. A point belongs to the smallest thing whose box has it,
    /// else to the piece of the building whose box has it.
    #[must_use]
    pub fn of(render_scene: &RenderScene, instances: &[Instance], frames: &[FrameRef]) -> Self {
        let cloud = with_ids_as_colors(&render_scene.cloud, instances);
        let step = (render_scene.cloud.len() as f32 / cloud.len().max(1) as f32).max(1.0);
        // Every n-th point: the gaps grow with the square root.
        let spacing_m = render_scene.spacing_m() * step.sqrt();
        let seen = |frame: &FrameRef| {
            let taken = &frame.color_intrinsics;
            let height = (WIDTH_PX * taken.height).div_ceil(taken.width.max(1)).max(1);
            let camera = Camera::new(taken.scaled_to(WIDTH_PX, height), &frame.camera_to_world);
            let drawn = draw_splats(&cloud, spacing_m, &camera, |_, _| true);
            let ids: Vec<u32> = drawn.picture.pixels().map(|pixel| id_of(pixel.0)).collect();
            FrameContent {
                frame: frame.index,
                instances: visible_in(&ids, WIDTH_PX as usize),
                cells: visible_cells(&drawn.depth_m, &camera),
            }
        };
        Self { frames: frames.par_iter().map(seen).collect() }
    }
}

/// Returns the cubes of [`CELL_M`] that enough pixels show.
fn visible_cells(depth_m: &[f32], camera: &Camera) -> BTreeSet<[i32; 3]> {
    let Intrinsics { width, fx, fy, cx, cy, .. } = camera.intrinsics;
    let camera_to_world = camera.world_to_camera().inverse();
    let mut pixels: HashMap<[i32; 3], usize> = HashMap::new();
    for (at, &z_m) in depth_m.iter().enumerate().filter(|(_, z_m)| z_m.is_finite()) {
        let (u, v) = ((at as u32 % width) as f32, (at as u32 / width) as f32);
        let seen = Point3::new((u - cx) * z_m / fx, (v - cy) * z_m / fy, z_m);
        let place = camera_to_world * seen;
        let cell = [place.x, place.y, place.z].map(|at| (at / CELL_M).floor() as i32);
        *pixels.entry(cell).or_default() += 1;
    }
    pixels.into_iter().filter(|(_, count)| *count >= CELL_PIXELS).map(|(cell, _)| cell).collect()
}

/// Returns the cloud with ids as colors; 0 for points of no instance, which hide others as well.
fn with_ids_as_colors(cloud: &PointCloud, instances: &[Instance]) -> PointCloud {
    let step = cloud.len().div_ceil(MOST_POINTS).max(1);
    let positions: Vec<Point3<f32>> = cloud.positions.iter().step_by(step).copied().collect();
    let column = |v: f32| (v / COLUMN_M).floor() as i32;
    let mut columns: HashMap<(i32, i32), Vec<u32>> = HashMap::new();
    for (i, p) in positions.iter().enumerate() {
        columns.entry((column(p.x), column(p.y))).or_default().push(i as u32);
    }
    let mut order: Vec<&Instance> = instances
        .iter()
        .filter(|i| i.structure.is_some() || (i.level == Level::Thing && !i.dismissed))
        .collect();
    let volume = |i: &Instance| i.oriented_box.size.product();
    // The first that has a point keeps it: things before the building, small ones before large.
    order.sort_by(|a, b| {
        a.structure.is_some().cmp(&b.structure.is_some()).then(volume(a).total_cmp(&volume(b)))
    });
    let mut ids = vec![0_u32; positions.len()];
    for instance in order {
        let (low, high) = (instance.aabb.min(), instance.aabb.max());
        let span = |low: f32, high: f32| column(low - REACH_M)..=column(high + REACH_M);
        let within = span(low.x, high.x)
            .flat_map(|x| span(low.y, high.y).map(move |y| (x, y)))
            .filter_map(|key| columns.get(&key));
        for &i in within.flatten() {
            let id = &mut ids[i as usize];
            let p = &positions[i as usize];
            if *id == 0 && box_contains(&instance.oriented_box, REACH_M, p) {
                *id = instance.id.0;
            }
        }
    }
    let colors = ids
        .into_iter()
        .map(|id| {
            let [_, r, g, b] = id.to_be_bytes();
            [r, g, b]
        })
        .collect();
    PointCloud { positions, colors }
}

/// Returns the id that a pixel's color stands for; 0 where nothing was drawn.
fn id_of([r, g, b, _]: [u8; 4]) -> u32 {
    u32::from_be_bytes([0, r, g, b])
}

/// Returns the instances in a picture of ids.
fn visible_in(ids: &[u32], width: usize) -> Vec<VisibleInstance> {
    let height = ids.len() / width;
    let depth = distance_to_other(ids, width);
    let mut found: BTreeMap<u32, (usize, usize, bool)> = BTreeMap::new();
    for (at, &id) in ids.iter().enumerate().filter(|(_, id)| **id != 0) {
        let (x, y) = (at % width, at / width);
        let is_rim = x == 0 || y == 0 || x + 1 == width || y + 1 == height;
        let (count, deepest, is_cut) = found.entry(id).or_insert((0, at, false));
        *count += 1;
        *is_cut |= is_rim;
        if depth[at] > depth[*deepest] {
            *deepest = at;
        }
    }
    let visible = |(id, (count, deepest, is_cut)): (u32, (usize, usize, bool))| VisibleInstance {
        id: InstanceId(id),
        share: count as f32 / ids.len() as f32,
        middle: [
            ((deepest % width) as f32 + 0.5) / width as f32,
            ((deepest / width) as f32 + 0.5) / height as f32,
        ],
        margin: depth[deepest] as f32 / width as f32,
        is_cut,
    };
    found.into_iter().map(visible).collect()
}

/// Returns the place in a mask that is farthest from its borders, as shares of its box's width and
/// height, and its distance from them as a share of the box's width; `None` for an empty mask.
#[must_use]
pub fn middle_of_mask(mask: &CellMask) -> Option<([f32; 2], f32)> {
    let (columns, rows) = mask.size();
    let cells = (0..rows).flat_map(|row| (0..columns).map(move |column| (column, row)));
    let ids: Vec<u32> = cells.map(|(column, row)| mask.is_set(column, row).into()).collect();
    let found = visible_in(&ids, columns as usize).into_iter().next()?;
    Some((found.middle, found.margin))
}

/// Returns for every pixel the steps to the nearest pixel of another id, or out of the picture.
fn distance_to_other(ids: &[u32], width: usize) -> Vec<u32> {
    let height = ids.len() / width;
    let mut depth = vec![0_u32; ids.len()];
    let near = |depth: &[u32], at: usize, other: Option<usize>| match other {
        Some(other) if ids[other] == ids[at] => depth[other] + 1,
        _ => 1,
    };
    for at in 0..ids.len() {
        let left = (!at.is_multiple_of(width)).then(|| at - 1);
        depth[at] = near(&depth, at, left).min(near(&depth, at, at.checked_sub(width)));
    }
    for at in (0..ids.len()).rev() {
        let right = ((at + 1) % width != 0).then_some(at + 1);
        let below = (at / width + 1 < height).then_some(at + width);
        depth[at] = depth[at].min(near(&depth, at, right)).min(near(&depth, at, below));
    }
    depth
}

#[cfg(test)]
mod tests {
    use super::*;
    use uniground_geometry::boxes::{Aabb, OrientedBox};
    use uniground_geometry::scene::Structure;
    use uniground_geometry::{Isometry3, Vector3};

    fn instance(id: u32, center: [f32; 3], size: [f32; 3]) -> Instance {
        let aabb = Aabb { center: Point3::from(center), size: Vector3::from(size) };
        Instance::from_box(InstanceId(id), aabb)
    }

    /// A camera at the origin that looks along +Z, 2 x 2 at a distance of 1.
    fn frame(index: u32) -> FrameRef {
        let view =
            Intrinsics { width: 320, height: 320, fx: 160.0, fy: 160.0, cx: 159.5, cy: 159.5 };
        FrameRef {
            index: FrameIndex(index),
            time_s: None,
            color: "".into(),
            depth: "".into(),
            color_intrinsics: view,
            depth_intrinsics: view,
            depth_scale_m: 1.0,
            camera_to_world: Isometry3::identity(),
            optics: uniground_geometry::scene::Optics::default(),
        }
    }

    /// A wall of points across the view at a depth of 2 m, with a patch before it.
    fn wall_and_patch() -> PointCloud {
        let mut cloud = PointCloud::default();
        for i in -100..=100 {
            for j in -100..=100 {
                let (x, y) = (i as f32 * 0.02, j as f32 * 0.02);
                cloud.positions.push(Point3::new(x, y, 2.0));
                if x.abs() <= 0.2 && y.abs() <= 0.3 {
                    cloud.positions.push(Point3::new(x, y, 1.5));
                }
            }
        }
        cloud.colors = vec![[0; 3]; cloud.positions.len()];
        cloud
    }

    #[test]
    fn visible_instances_have_share_and_middle() {
        let wall = Instance {
            structure: Some(Structure::Wall),
            ..instance(1, [0.0, 0.0, 2.0], [4.2, 4.2, 0.1])
        };
        let patch = instance(2, [0.0, 0.0, 1.5], [0.42, 0.62, 0.1]);
        let hidden = instance(3, [0.0, 0.0, 2.0], [0.2, 0.2, 0.1]);
        let beside = instance(4, [9.0, 0.0, 1.5], [0.4, 0.4, 0.1]);
        let scene = RenderScene::new(wall_and_patch());
        let seen = FrameContents::of(&scene, &[wall, patch, hidden, beside], &[frame(7)]);
        let [FrameContent { frame: FrameIndex(7), instances: seen, cells }] = &seen.frames[..]
        else {
            panic!("{seen:?}")
        };
        // The view has 4 x 4 m of the wall at 2 m, and the patch before it.
        let has = |x: i32, y: i32, deep: std::ops::Range<i32>| {
            deep.into_iter().any(|z| cells.contains(&[x, y, z]))
        };
        assert!(has(4, 4, 4..6) && has(0, 0, 3..4), "{cells:?}");
        assert!(!has(5, 0, 4..6) && !has(4, 4, 3..4), "{cells:?}");
        let ids: Vec<u32> = seen.iter().map(|visible| visible.id.0).collect();
        assert_eq!(ids, [1, 2], "what is hidden or outside is not visible");
        let patch = seen[1];
        // 0.4 x 0.6 m at 1.5 m of a view of 3 x 3 m.
        assert!((0.02..0.04).contains(&patch.share), "{patch:?}");
        assert!(patch.middle.iter().all(|at| (at - 0.5).abs() < 0.05), "{patch:?}");
        assert!(!patch.is_cut && seen[0].is_cut && seen[0].share > 0.9);
        assert!((0.05..0.09).contains(&patch.margin), "half its width: {patch:?}");
    }

    #[test]
    fn middle_is_inside_of_a_concave_shape() {
        // A ring of 9 x 9 pixels around another id.
        let width = 11;
        let ids: Vec<u32> = (0..width * width)
            .map(|at| {
                let (x, y) = ((at % width) as i32 - 5, (at / width) as i32 - 5);
                match x.abs().max(y.abs()) {
                    0..=1 => 2,
                    2..=4 => 1,
                    _ => 0,
                }
            })
            .collect();
        let seen = visible_in(&ids, width);
        let at = seen[0].middle.map(|share| (share * width as f32) as usize);
        assert_eq!((seen[0].id, ids[at[1] * width + at[0]]), (InstanceId(1), 1));
        assert_eq!(seen[0].margin, 2.0 / 11.0);
        assert_eq!(seen[1].margin, 2.0 / 11.0);
    }

    #[test]
    fn middle_of_a_mask_is_inside_of_it() {
        // An upright bar at the right of a box of 10 x 4 cells.
        let mask = CellMask::from_fn(10, 4, |column, _| column >= 7);
        let ([x, y], margin) = middle_of_mask(&mask).unwrap();
        assert_eq!(((x * 10.0) as u32, margin), (8, 0.2));
        assert!((0.25..0.75).contains(&y), "{y}");
        assert_eq!(middle_of_mask(&CellMask::empty(4, 4)), None);
    }

    #[test]
    fn points_belong_to_the_smallest_box() {
        let table = instance(1, [0.0, 0.0, 0.4], [1.0, 1.0, 0.8]);
        let mug = instance(2, [0.0, 0.0, 0.75], [0.1, 0.1, 0.1]);
        let turned = Instance {
            oriented_box: OrientedBox {
                center: Point3::new(3.0, 0.0, 0.5),
                size: Vector3::new(1.0, 0.1, 1.0),
                yaw_rad: std::f32::consts::FRAC_PI_4,
            },
            ..instance(3, [3.0, 0.0, 0.5], [0.8, 0.8, 1.0])
        };
        let points = [[0.4, 0.4, 0.1], [0.0, 0.0, 0.75], [3.0, 0.0, 0.5], [3.3, -0.3, 0.5]];
        let positions: Vec<Point3<f32>> = points.map(Point3::from).to_vec();
        let colors = vec![[9; 3]; 4];
        let cloud = PointCloud { positions, colors };
        let ids = with_ids_as_colors(&cloud, &[table, mug, turned]).colors;
        assert_eq!(ids, [[0, 0, 1], [0, 0, 2], [0, 0, 3], [0, 0, 0]]);
    }
}
