use crate::render_scene::Cutaway;
use crate::{BoxStyle, GlobalView, LabeledBox, Orbit, RenderScene, Subjects};
use uniground_geometry::boxes::Aabb;
use uniground_geometry::scene::{Instance, InstanceId, PointCloud, Structure, Support};
use uniground_geometry::{Point3, Vector3};

const CEILING: [u8; 3] = [200, 200, 255];
const FLOOR: [u8; 3] = [120; 3];
/// The side that faces west, and the one that faces east.
const INNER: [[u8; 3]; 2] = [[250, 0, 250], [150, 0, 150]];
const RED: [u8; 3] = [255, 0, 0];
const GREEN: [u8; 3] = [0, 255, 0];
/// Colors of the walls, each with its direction from the center.
const WALLS: [([u8; 3], Vector3<f32>); 4] = [
    ([250, 250, 0], Vector3::new(-1.0, 0.0, 0.0)),
    ([0, 250, 250], Vector3::new(1.0, 0.0, 0.0)),
    ([250, 120, 0], Vector3::new(0.0, -1.0, 0.0)),
    ([0, 120, 250], Vector3::new(0.0, 1.0, 0.0)),
];
/// A few points at the rims of a wall can remain.
const SLIVER_PX: usize = 30;
const TILTS_DEG: [f32; 2] = [15.0, 35.0];
const AZIMUTHS_DEG: [f32; 7] = [-90.0, -30.0, 0.0, 75.0, 120.0, 180.0, 240.0];

#[derive(Default)]
struct Scene {
    cloud: PointCloud,
    instances: Vec<Instance>,
}

impl Scene {
    /// Adds a point every 3 cm: `at` maps two shares of `sides` (meters) to a position. Adds an
    /// instance if it is a part of the building.
    fn sheet(
        &mut self,
        sides: [f32; 2],
        color: [u8; 3],
        structure: Option<Structure>,
        at: impl Fn(f32, f32) -> Point3<f32>,
    ) {
        let first = self.cloud.len();
        let steps = sides.map(|side| (side / 0.03) as usize);
        for i in 0..=steps[0] {
            for j in 0..=steps[1] {
                // Noise of a few millimeters, as in scans.
                let shake =
                    Vector3::from_fn(|k, _| ((i * 31 + j * 57 + k * 17) % 13) as f32 * 1e-3 - 6e-3);
                self.cloud
                    .positions
                    .push(at(i as f32 / steps[0] as f32, j as f32 / steps[1] as f32) + shake);
                self.cloud.colors.push(color);
            }
        }
        let aabb = Aabb::around(&self.cloud.positions[first..]).unwrap();
        self.instance(aabb, structure, Support::Nothing);
    }

    fn instance(&mut self, aabb: Aabb, structure: Option<Structure>, support: Support) {
        let id = InstanceId(self.instances.len() as u32 + 1);
        self.instances.push(Instance {
            planarity: 1.0,
            structure,
            support,
            ..Instance::from_box(id, aabb)
        });
    }

    /// Adds the outside of a cube on the floor.
    fn cube(&mut self, center: [f32; 2], side: f32, color: [u8; 3]) {
        let low = Point3::new(center[0] - side / 2.0, center[1] - side / 2.0, 0.0);
        let first = self.cloud.len();
        for axis in 0..3 {
            for end in [0.0, 1.0] {
                let (a, b) = ((axis + 1) % 3, (axis + 2) % 3);
                self.sheet([side; 2], color, None, |u, v| {
                    low + side * (Vector3::ith(axis, end) + Vector3::ith(a, u) + Vector3::ith(b, v))
                });
                self.instances.pop();
            }
        }
        let aabb = Aabb::around(&self.cloud.positions[first..]).unwrap();
        self.instance(aabb, None, Support::Floor);
    }

    /// Returns a room of 6 by 4 m. Its ceiling is `top(x)` high for x from -3, over the share
    /// `covered` of its width. An inner wall 10 cm thick runs from the south wall to 1 m before the
    /// north wall. A red and a green cube stand on its two sides.
    fn room(top: impl Fn(f32) -> f32, covered: f32) -> Self {
        let mut scene = Self::default();
        scene.sheet([6.0, 4.0], FLOOR, Some(Structure::Floor), |u, v| {
            Point3::new(6.0 * u - 3.0, 4.0 * v - 2.0, 0.0)
        });
        for (color, side) in WALLS {
            let length = if side.x == 0.0 { 6.0 } else { 4.0 };
            scene.sheet([length, 2.4], color, Some(Structure::Wall), |u, v| {
                let (across, along) =
                    (u * length - length / 2.0, Vector3::new(side.y, side.x, 0.0).abs());
                let at = Vector3::new(side.x * 3.0, side.y * 2.0, 0.0) + along * across;
                Point3::new(at.x, at.y, v * top(at.x))
            });
        }
        scene.sheet([6.0 * covered, 4.0], CEILING, Some(Structure::Ceiling), |u, v| {
            let x = 6.0 * covered * u - 3.0;
            Point3::new(x, 4.0 * v - 2.0, top(x))
        });
        for (color, x) in INNER.into_iter().zip([-0.05, 0.05]) {
            scene.sheet([3.0, 2.4], color, Some(Structure::Wall), |u, v| {
                Point3::new(x, 3.0 * u - 2.0, v * top(x))
            });
        }
        scene.cube([-1.7, 0.3], 0.5, RED);
        scene.cube([1.5, -0.6], 0.5, GREEN);
        scene
    }

    fn rendered(&self) -> (RenderScene, Aabb) {
        (
            RenderScene::with_building(self.cloud.clone(), &self.instances),
            Aabb::around(&self.cloud.positions).unwrap(),
        )
    }

    fn box_of(&self, color: [u8; 3]) -> Aabb {
        let points = self.cloud.positions.iter().zip(&self.cloud.colors);
        Aabb::around(points.filter(|(_, c)| **c == color).map(|(p, _)| p)).unwrap()
    }
}

/// Returns a function that counts the pixels of a color in the view from `orbit`.
fn pixel_counter(
    scene: &(RenderScene, Aabb),
    orbit: Orbit,
    cutaway: Cutaway,
    subjects: &[Aabb],
) -> impl Fn([u8; 3]) -> usize + use<> {
    let drawn = scene.0.draw_from_outside(&orbit.camera(&scene.1), cutaway, subjects);
    move |color| drawn.picture.pixels().filter(|p| p.0[3] > 0 && p.0[..3] == color).count()
}

fn orbit(azimuth_deg: f32, tilt_deg: f32) -> Orbit {
    Orbit { width: 480, height: 480, azimuth_deg, tilt_deg }
}

/// Checks from every side that things and the far walls are visible, and that the ceiling and the
/// near walls are not.
fn assert_interior_is_visible(scene: &Scene) {
    let rendered = scene.rendered();
    let subjects = [scene.box_of(RED), scene.box_of(GREEN)];
    for azimuth_deg in AZIMUTHS_DEG {
        for tilt_deg in TILTS_DEG {
            let pixels = pixel_counter(
                &rendered,
                orbit(azimuth_deg, tilt_deg),
                Cutaway::Building,
                &subjects,
            );
            let from = format!("azimuth {azimuth_deg}, tilt {tilt_deg}");
            assert_eq!(pixels(CEILING), 0, "{from}");
            assert!(
                pixels(RED) > 300 && pixels(GREEN) > 300,
                "{from}: {} {}",
                pixels(RED),
                pixels(GREEN)
            );
            // From steeply above, the eye can be over the room. Then no wall turns its back to it.
            let eye = orbit(azimuth_deg, tilt_deg).camera(&rendered.1).center();
            for (color, side) in WALLS {
                let outside_m =
                    eye.coords.dot(&side) - Vector3::new(3.0, 2.0, 0.0).dot(&side.abs());
                match outside_m {
                    outside if outside > 0.2 => {
                        assert!(
                            pixels(color) < SLIVER_PX,
                            "{from}: {} of {color:?}",
                            pixels(color)
                        );
                    }
                    outside if outside < -2.0 => {
                        assert!(pixels(color) > 500, "{from}: {} of {color:?}", pixels(color));
                    }
                    // Walls seen edge on can be either.
                    _ => {}
                }
            }
        }
    }
}

#[test]
fn interior_is_visible_under_a_full_ceiling() {
    assert_interior_is_visible(&Scene::room(|_| 2.5, 1.0));
}

#[test]
fn interior_is_visible_under_a_sloped_ceiling() {
    assert_interior_is_visible(&Scene::room(|x| 2.6 + 0.3 * x, 1.0));
}

#[test]
fn interior_is_visible_under_a_partly_scanned_ceiling() {
    assert_interior_is_visible(&Scene::room(|_| 2.5, 0.4));
}

#[test]
fn inner_wall_shows_only_the_side_that_faces_the_camera() {
    let rendered = Scene::room(|_| 2.5, 1.0).rendered();
    for (azimuth_deg, near, far) in [(180.0, INNER[0], INNER[1]), (0.0, INNER[1], INNER[0])] {
        let pixels = pixel_counter(&rendered, orbit(azimuth_deg, 50.0), Cutaway::Building, &[]);
        assert!(
            pixels(near) > 1000 && pixels(far) < SLIVER_PX,
            "{azimuth_deg}: {} {}",
            pixels(near),
            pixels(far)
        );
    }
}

/// A cube close behind the inner wall, seen from a low viewpoint. The wall is left out only if the
/// cube is a subject.
#[test]
fn wall_in_front_of_a_subject_is_not_drawn() {
    let mut scene = Scene::room(|_| 2.5, 1.0);
    scene.cube([0.5, -0.8], 0.4, [0, 80, 0]);
    let (rendered, cube) = (scene.rendered(), scene.box_of([0, 80, 0]));
    let from = orbit(180.0, 65.0);
    let (without, with) = (
        pixel_counter(&rendered, from, Cutaway::Building, &[]),
        pixel_counter(&rendered, from, Cutaway::Building, &[cube]),
    );
    assert!(without([0, 80, 0]) == 0 && without(INNER[0]) > 1000);
    assert!(
        with([0, 80, 0]) > 300 && with(INNER[0]) < SLIVER_PX,
        "{} {}",
        with([0, 80, 0]),
        with(INNER[0])
    );
}

#[test]
fn things_on_an_open_wall_are_drawn_only_if_they_are_subjects() {
    const PICTURE: [u8; 3] = [90, 0, 0];
    let mut scene = Scene::room(|_| 2.5, 1.0);
    scene.sheet([1.0, 0.7], PICTURE, None, |u, v| Point3::new(u - 2.0, -1.96, 1.2 + 0.7 * v));
    let picture = scene.instances.last().unwrap().aabb;
    let rendered = scene.rendered();
    let from = |azimuth_deg, subjects: &[Aabb]| {
        pixel_counter(&rendered, orbit(azimuth_deg, 35.0), Cutaway::Building, subjects)(PICTURE)
    };
    assert!(from(90.0, &[]) > 200, "visible from inside the room");
    assert_eq!(from(-90.0, &[]), 0);
    assert!(from(-90.0, &[picture]) > 200);
}

/// Without known parts of the building, the paper's filter is used. It can also be selected.
#[test]
fn paper_filter_is_selectable_and_the_fallback_without_structure() {
    let scene = Scene::room(|x| 2.6 + 0.3 * x, 1.0);
    let (known, extent) = scene.rendered();
    let unknown = RenderScene::new(scene.cloud.clone());
    let camera = orbit(-90.0, 35.0).camera(&extent);
    let paper = known.draw_from_outside(&camera, Cutaway::HighestPoints, &[]).picture;
    assert_eq!(paper, unknown.draw_from_outside(&camera, Cutaway::HighestPoints, &[]).picture);
    assert_eq!(paper, unknown.draw_from_outside(&camera, Cutaway::Building, &[]).picture);
    assert!(
        paper.pixels().filter(|p| p.0[..3] == CEILING).count() > 10_000,
        "with this filter a sloped ceiling hides the room"
    );
}

#[test]
fn global_render_leaves_out_the_ceiling() {
    let scene = Scene::room(|_| 2.5, 1.0);
    let (rendered, extent) = scene.rendered();
    let label = |aabb, label: &str| LabeledBox::axis_aligned(aabb, label, BoxStyle::Candidate);
    let boxes = vec![label(scene.box_of(RED), "1"), label(scene.box_of(GREEN), "2")];
    let subjects = Subjects { boxes, words: Vec::new(), target: Point3::new(0.0, 0.0, 0.25) };
    let view = GlobalView { shading: 0.0, ..GlobalView::default() };
    let seen = |cutaway| {
        let picture = GlobalView { cutaway, ..view.clone() }.draw(&rendered, &extent, &subjects);
        [RED, GREEN, CEILING].map(|color| picture.pixels().filter(|p| p.0 == color).count())
    };
    let [red, green, ceiling] = seen(Cutaway::Building);
    assert!(red > 3000 && green > 3000 && ceiling == 0, "{red} {green} {ceiling}");
    // With the paper's filter, a level ceiling of more than 5 % of the points still hides the room.
    assert!(seen(Cutaway::HighestPoints)[0] < red / 2);
}
