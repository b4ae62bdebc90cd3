//! Walls and ceilings as planes, which a picture leaves out so that it shows a room from outside.
//!
//! Stage 1 marks the instances that are parts of the building. Planes are fitted to the points in
//! the box of each, so sloped ceilings work as well as level ones, and parses of any age can be
//! drawn. A plane faces the room. If its back faces the camera, its points are not drawn, nor are
//! those of things that hang on it. A plane between the camera and a subject is left out too,
//! whichever way it faces.

use rayon::prelude::*;
use std::collections::BTreeMap;
use uniground_geometry::boxes::{Aabb, OrientedBox};
use uniground_geometry::least_axis::least_axis;
use uniground_geometry::moments::Moments;
use uniground_geometry::scene::{Instance, InstanceId, Structure, Support};
use uniground_geometry::statistics::quantile;
use uniground_geometry::{Point3, Vector3};

/// Maximum number of planes of a building: the number of a plane, from 1, fits in a byte. Further
/// planes are drawn as things.
const MAX_SHEETS: usize = 120;
/// Maximum number of planes fitted to one instance: a ceiling may have two slopes.
const MAX_PER_INSTANCE: usize = 3;
/// Minimum share of the points in an instance's box for a plane of the instance.
const MIN_SHARE: f32 = 0.2;
const MIN_POINTS: usize = 30;
/// Number of points of a box that candidate planes are tested on.
const SAMPLE: usize = 1500;
/// Number of candidate planes.
const TRIALS: u32 = 120;
/// Points within this distance of a candidate plane lie on it, meters.
const TRIED_M: f32 = 0.04;
/// Growth of a box on each side, because it can miss that much of its wall, meters.
const BOX_GROWTH_M: f32 = 0.05;
/// Largest `|z|` of the unit normal of a wall, and smallest of a ceiling.
const WALL_MAX_Z: f32 = 0.4;
const CEILING_MIN_Z: f32 = 0.35;
/// Maximum distance of a plane's points: this many standard deviations, but at least and at most so
/// many meters.
const SLACK_SIGMAS: f32 = 3.0;
const SLACK_M: [f32; 2] = [0.035, 0.10];
/// Share of its points that a wall's rectangle leaves out on each side. The rectangle is then grown
/// to include the wall's rims, meters.
const STRAY_SHARE: f32 = 0.005;
const WALL_GROWTH_M: f32 = 0.12;
/// Growth of a ceiling beyond where it was recognized, meters.
const CEILING_GROWTH_M: f32 = 1.5;
/// Depth behind a plane that belongs to it: window frames, reveals and reflections behind a wall,
/// and what is above a ceiling, meters.
const BEHIND_WALL_M: f32 = 0.25;
const BEHIND_CEILING_M: f32 = 0.5;
/// Range checked on both sides of a wall to find the side that faces the room: meters from the
/// wall, and number of points of the cloud.
const ROOM_M: [f32; 2] = [0.15, 4.0];
const ROOM_SAMPLE: usize = 60_000;
/// A wall with more than this share of the points on its emptier side is between two rooms.
const BOTH_SIDES: f32 = 0.2;
/// A wall is extended while there is a room before it and no more than this share of the points
/// behind it. It is extended in steps of so many meters, and for so many steps at most. The last
/// value is the depth checked behind the wall, meters.
const OUTSIDE: f32 = 0.1;
const STEP_M: f32 = 0.25;
const LONGEST_STEPS: i32 = 200;
const OUTSIDE_M: f32 = 1.5;
/// Maximum distance between two sides of one wall, meters, and minimum cosine between them.
const THICKEST_WALL_M: f32 = 0.45;
const PARALLEL: f32 = 0.95;
/// Maximum depth of things that hang on a wall, meters.
const HANGS_M: f32 = 0.35;
/// A thing that reaches higher than this above the foot of a wall hides the room behind it, meters.
const HIGH_M: f32 = 1.0;
/// Maximum depth of a subject that lies in its wall or on it, such as a door or a picture, meters.
const FLAT_M: f32 = 0.2;
/// Growth of robust boxes on every side, because they leave out a few points of their things,
/// meters.
pub(super) const RIM_M: f32 = 0.02;
/// A subject counts as hidden when more than this share of its center and corners is hidden.
const HIDDEN_SHARE: f32 = 0.3;
/// Share by which the corners of a subject are drawn in toward its center: a thing that leans
/// against a wall reaches into it.
const DRAWN_IN: f32 = 0.2;

/// The planes of a scene, and the points and things that belong to each.
#[derive(Debug, Clone)]
pub(super) struct Building {
    sheets: Vec<PlaneRect>,
    /// The planes of each point, numbered from 1: two where planes meet; 0 for none.
    of_point: Vec<[u8; 2]>,
    /// Both boxes of every instance: those of things at a rotated wall are thin in only one of
    /// them.
    boxes: Vec<(Aabb, OrientedBox)>,
}

/// The planes that one camera looks through, and the subjects that it must see.
pub(super) struct Opening {
    /// By plane: whether the camera looks through it.
    open: Vec<bool>,
    shown: Vec<VisibleSubject>,
}

/// A subject of a picture.
struct VisibleSubject {
    within: OrientedBox,
    /// By plane: whether the subject lies in it or on it, as doors and pictures do.
    flat: Vec<bool>,
}

/// A rectangle of a wall or ceiling.
#[derive(Debug, Clone, PartialEq)]
struct PlaneRect {
    structure: Structure,
    /// The instance it was fitted to; below, that instance's box.
    instance: InstanceId,
    aabb: Aabb,
    /// Unit length, toward the room.
    normal: Vector3<f32>,
    middle: Point3<f32>,
    /// Unit vectors in the plane: `along` is level, `up` rises.
    along: Vector3<f32>,
    up: Vector3<f32>,
    /// Minimum and maximum coordinates on `along` and `up` from `middle`, meters.
    rect: [[f32; 2]; 2],
    /// Maximum distance of its points from the plane, meters.
    slack_m: f32,
    /// Depth behind the plane in which things still belong to it, meters.
    behind_m: f32,
    faces: WallSides,
}

/// What lies on the two sides of a plane.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum WallSides {
    /// A room on the side of the normal; nothing, or the wall's other side, behind.
    Room,
    /// A room on both sides, and one layer of points between them.
    Both,
}

impl Building {
    /// Fits planes to the walls and ceilings among `instances`; `None` where there are none.
    pub fn fit(positions: &[Point3<f32>], instances: &[Instance]) -> Option<Self> {
        let parts: Vec<(&Instance, Structure)> = instances
            .iter()
            .filter_map(|i| Some((i, i.structure.filter(|s| *s != Structure::Floor)?)))
            .take(MAX_SHEETS)
            .collect();
        let fitted: Vec<Vec<PlaneRect>> = parts
            .par_iter()
            .map(|(instance, structure)| find_planes(positions, instance, *structure))
            .collect();
        let mut sheets: Vec<PlaneRect> = fitted.into_iter().flatten().take(MAX_SHEETS).collect();
        if sheets.is_empty() {
            return None;
        }
        let sample: Vec<&Point3<f32>> =
            positions.iter().step_by(positions.len().div_ceil(ROOM_SAMPLE)).collect();
        orient_to_rooms(&mut sheets, &sample);
        extend_walls(&mut sheets, &sample);
        let hung: Vec<(usize, OrientedBox)> =
            instances.iter().filter_map(|i| find_wall_of(&sheets, i)).collect();
        let of_point = positions
            .par_iter()
            .map(|p| {
                // Ceilings take precedence: their rims would hover over the room.
                let mut nearest: [Option<(usize, f32)>; 2] = [None; 2];
                for (i, sheet) in sheets.iter().enumerate() {
                    let Some(distance_m) = sheet.distance_if_on_plane(p) else { continue };
                    let is_wall = |i: usize| sheets[i].structure == Structure::Wall;
                    let before = |(other, other_m): (usize, f32)| {
                        (is_wall(i), distance_m) < (is_wall(other), other_m)
                    };
                    if nearest[0].is_none_or(before) {
                        nearest = [Some((i, distance_m)), nearest[0]];
                    } else if nearest[1].is_none_or(before) {
                        nearest[1] = Some((i, distance_m));
                    }
                }
                if nearest[0].is_none() {
                    nearest[0] = hung
                        .iter()
                        .find(|(_, of)| box_contains(of, RIM_M, p))
                        .map(|(i, _)| (*i, 0.0));
                }
                nearest.map(|own| own.map_or(0, |(i, _)| i as u8 + 1))
            })
            .collect();
        let boxes = instances.iter().map(|i| (i.aabb, i.oriented_box)).collect();
        Some(Self { sheets, of_point, boxes })
    }

    /// Returns whether any of the planes is a ceiling.
    pub fn has_ceiling(&self) -> bool {
        self.sheets.iter().any(|sheet| sheet.structure == Structure::Ceiling)
    }

    /// Returns what a camera at `eye` looks through to see the room and the subjects in it. Parts
    /// of the building never count as subjects: drawn, they would hide the room.
    pub fn opening(&self, eye: &Point3<f32>, subjects: &[Aabb]) -> Opening {
        let things = subjects.iter().filter(|s| !self.sheets.iter().any(|sheet| sheet.aabb == **s));
        let shown: Vec<VisibleSubject> = things
            .map(|aabb| {
                let known =
                    self.boxes.iter().find(|(own, _)| own == aabb).map(|(_, turned)| *turned);
                let within = known.unwrap_or((*aabb).into());
                VisibleSubject {
                    flat: self.sheets.iter().map(|sheet| sheet.is_flat(&within, FLAT_M)).collect(),
                    within,
                }
            })
            .collect();
        let open = |sheet: &PlaneRect| {
            sheet.faces_away(eye) || shown.iter().any(|s| sheet.is_hiding(&s.within, eye))
        };
        Opening { open: self.sheets.iter().map(open).collect(), shown }
    }

    /// Returns whether a point is drawn. Where an open wall meets another, its rim is left out too.
    /// In a subject's box, the subject is drawn but not the wall it stands at.
    pub fn is_drawn(&self, point: usize, p: &Point3<f32>, opening: &Opening) -> bool {
        let own =
            self.of_point[point].into_iter().filter_map(|number| (number as usize).checked_sub(1));
        own.filter(|&i| opening.open[i]).all(|i| {
            let before = self.sheets[i].distance(p) > self.sheets[i].slack_m;
            opening.shown.iter().any(|s| (s.flat[i] || before) && box_contains(&s.within, RIM_M, p))
        })
    }

    /// Returns the lower edges of the walls that the camera looks through.
    pub fn open_wall_footings(&self, opening: &Opening) -> Vec<[Point3<f32>; 2]> {
        let walls = self
            .sheets
            .iter()
            .zip(&opening.open)
            .filter(|(sheet, open)| **open && sheet.structure == Structure::Wall);
        let mut drawn: Vec<&PlaneRect> = Vec::new();
        // Stretches of one wall that were recognized separately get one line.
        for (sheet, _) in walls {
            let on = |other: &&PlaneRect| {
                sheet
                    .footing()
                    .iter()
                    .all(|p| other.distance(p).abs() < BEHIND_WALL_M && other.covers(p, STEP_M))
            };
            if !drawn.iter().any(on) {
                drawn.push(sheet);
            }
        }
        drawn.into_iter().map(PlaneRect::footing).collect()
    }
}

impl Opening {
    /// Returns whether a point belongs to a subject.
    pub fn is_on_subject(&self, p: &Point3<f32>) -> bool {
        self.shown.iter().any(|s| box_contains(&s.within, RIM_M, p))
    }
}

impl PlaneRect {
    /// Fits a rectangle to the points on a plane.
    fn fit(on: &[Point3<f32>], instance: &Instance, structure: Structure) -> Self {
        let Moments { mean: middle, covariance } = Moments::from_points(on);
        let (variance, normal) = least_axis(&covariance);
        let along = Vector3::z().cross(&normal).try_normalize(1e-3).unwrap_or_else(Vector3::x);
        let up = normal.cross(&along);
        let up = if up.z < 0.0 { -up } else { up };
        let range = |axis: &Vector3<f32>| {
            let mut at: Vec<f32> = on.iter().map(|p| (p - middle).dot(axis)).collect();
            [STRAY_SHARE, 1.0 - STRAY_SHARE].map(|q| quantile(&mut at, q).unwrap_or(0.0))
        };
        Self {
            structure,
            instance: instance.id,
            aabb: instance.aabb,
            normal,
            middle,
            along,
            up,
            rect: [range(&along), range(&up)],
            slack_m: (SLACK_SIGMAS * variance.sqrt()).clamp(SLACK_M[0], SLACK_M[1]),
            behind_m: if structure == Structure::Ceiling {
                BEHIND_CEILING_M
            } else {
                BEHIND_WALL_M
            },
            faces: WallSides::Room,
        }
    }

    fn distance(&self, p: &Point3<f32>) -> f32 {
        (p - self.middle).dot(&self.normal)
    }

    /// Returns its lower edge.
    fn footing(&self) -> [Point3<f32>; 2] {
        self.rect[0].map(|along_m| self.at(along_m, self.rect[1][0]))
    }

    fn foot_z(&self) -> f32 {
        self.middle.z + self.up.z * self.rect[1][0]
    }

    fn at(&self, along_m: f32, up_m: f32) -> Point3<f32> {
        self.middle + self.along * along_m + self.up * up_m
    }

    /// Returns whether a point is over the rectangle, grown by `growth_m`.
    fn covers(&self, p: &Point3<f32>, growth_m: f32) -> bool {
        let d = p - self.middle;
        [self.along, self.up].iter().zip(&self.rect).all(|(axis, [low, high])| {
            let at = d.dot(axis);
            at >= low - growth_m && at <= high + growth_m
        })
    }

    /// Returns the distance to the plane for a point that belongs to it, meters.
    fn distance_if_on_plane(&self, p: &Point3<f32>) -> Option<f32> {
        let distance = self.distance(p);
        let growth_m =
            if self.structure == Structure::Ceiling { CEILING_GROWTH_M } else { WALL_GROWTH_M };
        (distance <= self.slack_m
            && distance >= -self.behind_m.max(self.slack_m)
            && self.covers(p, growth_m))
        .then_some(distance.abs())
    }

    /// Returns whether a box lies flat on the plane, as pictures do.
    fn is_flat(&self, of: &OrientedBox, depth_m: f32) -> bool {
        of.corners().iter().all(|corner| self.distance(corner).abs() < depth_m)
    }

    fn faces_away(&self, eye: &Point3<f32>) -> bool {
        self.faces == WallSides::Room && self.distance(eye) < 0.0
    }

    /// Returns whether the plane is between the eye and much of a box.
    fn is_hiding(&self, subject: &OrientedBox, eye: &Point3<f32>) -> bool {
        let corners = subject.corners().map(|corner| corner + (subject.center - corner) * DRAWN_IN);
        let before = self.distance(eye);
        let hidden = |p: &&Point3<f32>| {
            let behind = self.distance(p);
            // Beyond the plane, and not only within its noise.
            let crosses = before.signum() != behind.signum() && behind.abs() > self.slack_m;
            crosses && self.covers(&(eye + (*p - eye) * (before / (before - behind))), 0.0)
        };
        let points: Vec<Point3<f32>> = corners.into_iter().chain([subject.center]).collect();
        points.iter().filter(hidden).count() as f32 > HIDDEN_SHARE * points.len() as f32
    }
}

/// Finds the planes in the box of a wall or a ceiling, largest first.
fn find_planes(
    positions: &[Point3<f32>],
    instance: &Instance,
    structure: Structure,
) -> Vec<PlaneRect> {
    let inside = |p: &&Point3<f32>| box_contains(&instance.oriented_box, BOX_GROWTH_M, p);
    let mut left: Vec<Point3<f32>> = positions.iter().filter(inside).copied().collect();
    let enough = MIN_POINTS.max((left.len() as f32 * MIN_SHARE) as usize);
    let mut sheets = Vec::new();
    while sheets.len() < MAX_PER_INSTANCE && left.len() >= enough {
        let Some((normal, offset)) = best_plane(&left, structure) else { break };
        let is_on = |p: &Point3<f32>| (normal.dot(&p.coords) - offset).abs() <= TRIED_M;
        let on: Vec<Point3<f32>> = left.iter().filter(|p| is_on(p)).copied().collect();
        if on.len() < enough {
            break;
        }
        let sheet = PlaneRect::fit(&on, instance, structure);
        left.retain(|p| sheet.distance(p).abs() > 2.0 * sheet.slack_m);
        sheets.push(sheet);
    }
    sheets
}

/// Returns unit normal and offset of the plane through three of the points that most points lie on,
/// among planes whose direction fits a wall or a ceiling.
fn best_plane(points: &[Point3<f32>], structure: Structure) -> Option<(Vector3<f32>, f32)> {
    let sample: Vec<Point3<f32>> =
        points.iter().step_by(points.len().div_ceil(SAMPLE)).copied().collect();
    // The same points are tried every time, so that the result is reproducible.
    let mut state = 1_u32;
    let mut pick = || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        sample[((u64::from(state) * sample.len() as u64) >> 32) as usize]
    };
    let mut best: Option<(usize, Vector3<f32>, f32)> = None;
    for _ in 0..TRIALS {
        let (a, b, c) = (pick(), pick(), pick());
        let Some(normal) = (b - a).cross(&(c - a)).try_normalize(1e-4) else { continue };
        let fits = match structure {
            Structure::Wall => normal.z.abs() <= WALL_MAX_Z,
            Structure::Floor | Structure::Ceiling => normal.z.abs() >= CEILING_MIN_Z,
        };
        if fits {
            let offset = normal.dot(&a.coords);
            let on =
                sample.iter().filter(|p| (normal.dot(&p.coords) - offset).abs() <= TRIED_M).count();
            if best.is_none_or(|(most, ..)| on > most) {
                best = Some((on, normal, offset));
            }
        }
    }
    best.map(|(_, normal, offset)| (normal, offset))
}

/// Orients the planes. Ceilings face down. Walls face the side with the room on it. If a wall
/// between two rooms was scanned from both, each side faces away from the other.
fn orient_to_rooms(sheets: &mut [PlaneRect], sample: &[&Point3<f32>]) {
    let flipped = |sheet: &mut PlaneRect| sheet.normal = -sheet.normal;
    for sheet in sheets
        .iter_mut()
        .filter(|sheet| sheet.structure == Structure::Ceiling && sheet.normal.z > 0.0)
    {
        flipped(sheet);
    }
    let shares: Vec<f32> = sheets
        .par_iter()
        .map(|sheet| {
            let before = sample.iter().filter(|p| sheet.covers(p, 0.0)).map(|p| sheet.distance(p));
            let (mut front, mut back) = (0.0, 0.0);
            for distance in before.filter(|d| (ROOM_M[0]..ROOM_M[1]).contains(&d.abs())) {
                *(if distance > 0.0 { &mut front } else { &mut back }) += 1.0;
            }
            front / (front + back + f32::EPSILON)
        })
        .collect();
    let all = sheets.to_vec();
    for (sheet, in_front) in
        sheets.iter_mut().zip(shares).filter(|(sheet, _)| sheet.structure == Structure::Wall)
    {
        if in_front < BOTH_SIDES {
            flipped(sheet);
        } else if in_front <= 1.0 - BOTH_SIDES {
            let other = all
                .iter()
                .filter_map(|other| sheet.distance_to_other_side(other))
                .min_by(|a, b| a.abs().total_cmp(&b.abs()));
            if let Some(distance) = other {
                if distance > 0.0 {
                    flipped(sheet);
                }
                sheet.behind_m = distance.abs() / 2.0;
            } else {
                (sheet.faces, sheet.behind_m) = (WallSides::Both, sheet.slack_m);
            }
        }
    }
}

/// Extends walls from floor to ceiling, and along the room where stage 1 recognized only a stretch
/// of them.
fn extend_walls(sheets: &mut [PlaneRect], sample: &[&Point3<f32>]) {
    let mut heights: Vec<f32> = sample.iter().map(|p| p.z).collect();
    let [low_z, high_z] =
        [STRAY_SHARE, 1.0 - STRAY_SHARE].map(|q| quantile(&mut heights, q).unwrap_or(0.0));
    let outer = |sheet: &&mut PlaneRect| {
        sheet.structure == Structure::Wall && sheet.faces == WallSides::Room
    };
    sheets.par_iter_mut().filter(outer).for_each(|sheet| {
        let rises = sheet.up.z.max(1e-3);
        let [low, high] = &mut sheet.rect[1];
        (*low, *high) = (
            low.min((low_z - sheet.middle.z) / rises),
            high.max((high_z - sheet.middle.z) / rises),
        );
        // Points before and behind, by steps along the wall.
        let mut steps: BTreeMap<i32, [f32; 2]> = BTreeMap::new();
        let mut room: Vec<f32> = Vec::new();
        for p in sample {
            let distance = sheet.distance(p);
            let side = match distance > 0.0 {
                true => (ROOM_M[0]..ROOM_M[1]).contains(&distance).then_some(0),
                false => (sheet.behind_m..OUTSIDE_M).contains(&-distance).then_some(1),
            };
            if let Some(side) = side {
                let at = (*p - sheet.middle).dot(&sheet.along);
                steps.entry((at / STEP_M).floor() as i32).or_default()[side] += 1.0;
                room.extend((side == 0).then_some(at));
            }
        }
        let [room_from, room_to] =
            [STRAY_SHARE, 1.0 - STRAY_SHARE].map(|q| quantile(&mut room, q).unwrap_or(0.0));
        let goes_on = |step: &i32| {
            steps.get(step).is_some_and(|[before, behind]| *behind <= OUTSIDE * before)
        };
        let [from, to] = sheet.rect[0].map(|at| (at / STEP_M).floor() as i32);
        let first = (0..=LONGEST_STEPS).map(|k| from - k).take_while(goes_on).last();
        let last = (0..=LONGEST_STEPS).map(|k| to + k).take_while(goes_on).last();
        let [low, high] = &mut sheet.rect[0];
        *low = first.map_or(*low, |step| low.min(room_from.max(step as f32 * STEP_M)));
        *high = last.map_or(*high, |step| high.max(room_to.min((step + 1) as f32 * STEP_M)));
    });
}

impl PlaneRect {
    /// Returns the distance of the other side of the same wall, meters along the normal.
    fn distance_to_other_side(&self, other: &Self) -> Option<f32> {
        let distance = self.distance(&other.middle);
        let parallel =
            other.structure == Structure::Wall && self.normal.dot(&other.normal).abs() > PARALLEL;
        let apart = (self.slack_m..THICKEST_WALL_M).contains(&distance.abs());
        (parallel && apart && self.covers(&other.middle, 0.0)).then_some(distance)
    }
}

/// Returns the plane of the wall that a thing belongs to, and the thing's box. This is the wall it
/// hangs on; windows, doors and curtains, which reach high and lie flat, belong to the wall they
/// are in.
fn find_wall_of(sheets: &[PlaneRect], instance: &Instance) -> Option<(usize, OrientedBox)> {
    let of = instance.oriented_box;
    let hangs = |sheet: &PlaneRect| match instance.support {
        Support::Wall { id } => sheet.instance == id && sheet.is_flat(&of, HANGS_M),
        _ => {
            sheet.is_flat(&of, FLAT_M)
                && sheet.covers(&of.center, 0.0)
                && of.center.z + of.size.z / 2.0 > sheet.foot_z() + HIGH_M
        }
    };
    let is_wall =
        |sheet: &PlaneRect| sheet.structure == Structure::Wall && sheet.faces == WallSides::Room;
    let wall = sheets
        .iter()
        .position(|sheet| instance.structure.is_none() && is_wall(sheet) && hangs(sheet))?;
    Some((wall, of))
}

/// Returns whether a point is in a box grown by `growth_m` on all sides, meters.
pub(super) fn box_contains(of: &OrientedBox, growth_m: f32, p: &Point3<f32>) -> bool {
    let (sin, cos) = of.yaw_rad.sin_cos();
    let d = p - of.center;
    let (x, y) = (cos * d.x + sin * d.y, cos * d.y - sin * d.x);
    [x, y, d.z].iter().zip(&of.size).all(|(at, size)| at.abs() <= size / 2.0 + growth_m)
}

#[cfg(test)]
mod tests;
