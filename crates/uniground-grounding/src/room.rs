//! The room that an object stands in: walls around it, corners, the middle, and the direction of
//! its own front.
//!
//! A scan may hold several rooms, or one with a recess. An object is bounded by the next wall on
//! each of its four sides, or by the outline of everything where no wall comes before it.

use super::relations::fade;
use super::solid::Solid;
use uniground_geometry::{Point2, Vector2, Vector3};

/// The room that relations to the room are measured against.
#[derive(Debug, Clone, PartialEq)]
pub struct Room {
    /// The smallest upright box around everything.
    pub outline: Solid,
    /// Boxes of the instances flagged as walls; may be empty.
    pub walls: Vec<Solid>,
    /// Pairs of walls that meet at an angle, by index.
    corners: Vec<(usize, usize)>,
}

/// How a viewer faces an object.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Faced {
    /// Horizontal direction away from the viewer; `None` right in the middle of a room.
    pub ahead: Option<Vector3<f32>>,
    /// Whether the object has its back to a wall. In the open no side is the front, so people look
    /// from the middle of the room.
    pub has_a_front: bool,
}

impl Room {
    /// Creates a room with this outline and these walls.
    #[must_use]
    pub fn new(outline: Solid, walls: Vec<Solid>) -> Self {
        const MEET_M: f32 = 0.4;
        const AT_AN_ANGLE: f32 = 0.5;
        let meet = |a: &Solid, b: &Solid| {
            a.along().perp(&b.along()).abs() > AT_AN_ANGLE && a.horizontal_gap(b) < MEET_M
        };
        let pairs = (0..walls.len()).flat_map(|i| (i + 1..walls.len()).map(move |j| (i, j)));
        let corners = pairs.filter(|&(i, j)| meet(&walls[i], &walls[j])).collect();
        Self { outline, walls, corners }
    }

    /// Returns how close an object is to a wall, or to one side of the room, `0..=1`.
    #[must_use]
    pub fn against_wall(&self, thing: &Solid) -> f32 {
        let walls = self.walls.iter().map(|wall| fade(thing.horizontal_gap(wall), 0.25));
        self.gaps(thing).into_iter().map(|gap| fade(gap, 0.3)).chain(walls).fold(0.0, f32::max)
    }

    /// Returns how close an object is to two sides of the room, or two walls, that meet, `0..=1`.
    #[must_use]
    pub fn in_corner(&self, thing: &Solid) -> f32 {
        let [a, b, c, d] = self.gaps(thing).map(|gap| fade(gap, 0.5));
        let near = |wall: usize| fade(thing.horizontal_gap(&self.walls[wall]), 0.5);
        let meeting = self.corners.iter().map(|&(i, j)| near(i) * near(j)).fold(0.0, f32::max);
        meeting.max(a.max(b) * c.max(d))
    }

    /// Returns how near an object is to the middle of the room, relative to the room's size,
    /// `0..=1`.
    #[must_use]
    pub fn in_middle(&self, thing: &Solid) -> f32 {
        let gaps = self.gaps(thing);
        let aside = |axis: usize| {
            let (low, high) = thing.span(&self.axes()[axis]);
            let [before, behind] = [gaps[2 * axis], gaps[2 * axis + 1]];
            (before - behind).abs() / (before + behind + high - low).max(0.2)
        };
        fade(aside(0), 0.45) * fade(aside(1), 0.45)
    }

    /// Returns how a viewer faces an object.
    #[must_use]
    pub fn faced(&self, thing: &Solid) -> Faced {
        let front = self.own_front(thing);
        let from_the_middle = || {
            let gaps = self.gaps(thing);
            let aside =
                |(axis, i): (Vector2<f32>, usize)| axis * ((gaps[2 * i] - gaps[2 * i + 1]) / 2.0);
            let ahead: Vector2<f32> = self.axes().into_iter().zip(0..).map(aside).sum();
            Vector3::new(ahead.x, ahead.y, 0.0).try_normalize(1e-4)
        };
        Faced {
            ahead: front.map(|front| -front).or_else(from_the_middle),
            has_a_front: front.is_some(),
        }
    }

    /// Returns the direction away from the wall that an object stands against: a side of the room
    /// or a wall within. `None` in the open and, unless the object is long, in corners.
    #[must_use]
    pub fn own_front(&self, thing: &Solid) -> Option<Vector3<f32>> {
        const AT_THE_WALL_M: f32 = 0.35;
        const NEXT_WALL_M: f32 = 0.3;
        let [a, b] = self.axes();
        let sides = self.gaps(thing).into_iter().zip([a, -a, b, -b]);
        let inwards = |wall: &Solid| {
            let across = perpendicular(wall.along());
            across * (thing.center - wall.center).xy().dot(&across).signum()
        };
        let walls = self.walls.iter().map(|wall| (thing.horizontal_gap(wall), inwards(wall)));
        let backs: Vec<(f32, Vector2<f32>)> = sides.chain(walls).collect();
        let (gap, front) = *backs.iter().min_by(|x, y| x.0.total_cmp(&y.0))?;
        let other = backs
            .iter()
            .filter(|(_, other)| other.dot(&front).abs() < 0.5)
            .map(|(gap, _)| *gap)
            .fold(f32::INFINITY, f32::min);
        let flat = thing.sides().0 > 2.0 * thing.sides().1;
        // In a corner only the shape of a long object shows which wall it has at its back.
        let clear = other > gap + NEXT_WALL_M || flat && thing.along().dot(&front).abs() < 0.3;
        (gap <= AT_THE_WALL_M && clear).then(|| Vector3::new(front.x, front.y, 0.0))
    }

    /// Returns whether a person at one object has to leave the room for the other: a wall crosses
    /// the line between their middles.
    #[must_use]
    pub fn apart_by_a_wall(&self, a: &Solid, b: &Solid) -> bool {
        self.walls.iter().any(|wall| crosses(wall, a, b))
    }

    /// Returns how much of the room lies on the side of an object that `direction` (horizontal,
    /// unit) points to, meters: up to the next wall.
    #[must_use]
    pub fn depth(&self, thing: &Solid, direction: &Vector2<f32>) -> f32 {
        let [a, b] = self.axes();
        let sides = [-a, a, -b, b].into_iter().zip(self.gaps(thing));
        sides
            .max_by(|(x, _), (y, _)| x.dot(direction).total_cmp(&y.dot(direction)))
            .map_or(0.0, |(_, gap)| gap)
    }

    /// Returns the distances from an object to the bounds of its room, on both sides along each of
    /// [`axes`](Self::axes); meters.
    fn gaps(&self, thing: &Solid) -> [f32; 4] {
        let mut gaps = [0.0; 4];
        for (i, axis) in self.axes().into_iter().enumerate() {
            let (low, high) = thing.span(&axis);
            let (start, end) = self.outline.span(&axis);
            let (mut before, mut behind) = (low - start, end - high);
            let (middle, across) = (thing.center.xy().coords.dot(&axis), perpendicular(axis));
            let aside = thing.center.xy().coords.dot(&across);
            let beside = |wall: &&Solid| {
                let (from, to) = wall.span(&across);
                wall.along().dot(&axis).abs() < 0.5 && (from..=to).contains(&aside)
            };
            for (near, far) in self.walls.iter().filter(beside).map(|wall| wall.span(&axis)) {
                // A window is in its wall, not beside it.
                match () {
                    () if far < middle => before = before.min((low - far).max(0.0)),
                    () if near > middle => behind = behind.min((near - high).max(0.0)),
                    () => {}
                }
            }
            gaps[2 * i] = before;
            gaps[2 * i + 1] = behind;
        }
        gaps
    }

    /// Returns the directions of the outline's sides.
    fn axes(&self) -> [Vector2<f32>; 2] {
        [self.outline.axis, perpendicular(self.outline.axis)]
    }
}

/// Returns whether a wall stands between the middles of two objects, and is as high as they are.
fn crosses(wall: &Solid, a: &Solid, b: &Solid) -> bool {
    /// An object nearer to the middle of a wall is in it, or hangs on it.
    const IN_THE_WALL_M: f32 = 0.15;
    let along = wall.along();
    let place = |p: Point2<f32>| {
        ((p - wall.center.xy()).dot(&along), (p - wall.center.xy()).dot(&perpendicular(along)))
    };
    let ((along_a, across_a), (along_b, across_b)) = (place(a.center.xy()), place(b.center.xy()));
    let on_both_sides =
        across_a * across_b < 0.0 && across_a.abs().min(across_b.abs()) > IN_THE_WALL_M;
    let high_enough =
        wall.top > a.center.z.max(b.center.z) && wall.bottom < a.center.z.min(b.center.z);
    let at = || along_a + (along_b - along_a) * across_a / (across_a - across_b);
    on_both_sides && high_enough && at().abs() <= wall.sides().0 / 2.0
}

fn perpendicular(axis: Vector2<f32>) -> Vector2<f32> {
    Vector2::new(-axis.y, axis.x)
}

#[cfg(test)]
mod tests {
    use super::*;
    use uniground_geometry::Point3;
    use uniground_geometry::boxes::Aabb;

    fn boxed(center: [f32; 3], size: [f32; 3]) -> Solid {
        Aabb { center: Point3::from(center), size: Vector3::from(size) }.into()
    }

    fn cube(x: f32, y: f32) -> Solid {
        boxed([x, y, 0.25], [0.5; 3])
    }

    fn outline() -> Solid {
        boxed([0.0, 0.0, 1.3], [6.0, 5.0, 2.6])
    }

    fn room() -> Room {
        Room::new(outline(), vec![boxed([0.0, 2.55, 1.3], [6.0, 0.1, 2.6])])
    }

    #[test]
    fn corner_wall_and_middle_scores_follow_the_room() {
        let room = room();
        assert!(room.in_corner(&cube(2.7, 2.2)) > 0.9);
        assert!(room.in_corner(&cube(0.0, 2.2)) < 0.1 && room.against_wall(&cube(0.0, 2.2)) > 0.9);
        assert!(room.against_wall(&cube(0.0, 0.0)) < 0.1);
        assert!(room.in_middle(&cube(0.2, -0.2)) > 0.8 && room.in_middle(&cube(2.7, 2.2)) < 0.1);
    }

    #[test]
    fn inner_corners_count_as_corners() {
        // An L-shaped room: two walls meet at (0, 0.5), in the middle of its outline.
        let walls =
            vec![boxed([-1.5, 0.5, 1.3], [3.0, 0.1, 2.6]), boxed([0.0, 1.5, 1.3], [0.1, 2.0, 2.6])];
        let l_shaped = Room::new(outline(), walls);
        assert!(
            l_shaped.in_corner(&cube(0.4, 0.8)) > 0.8 && room().in_corner(&cube(0.4, 0.8)) < 0.1
        );
        assert!(l_shaped.in_corner(&cube(1.5, 0.5)) < 0.2);
        // A long shelf at the inner wall has its back there.
        let shelf = boxed([-1.5, 0.3, 0.9], [1.2, 0.3, 1.8]);
        assert!(
            l_shaped.own_front(&shelf).is_some_and(|front| front.y < -0.9)
                && room().own_front(&shelf).is_none()
        );
    }

    #[test]
    fn each_of_two_rooms_has_its_own_middle_and_walls() {
        // A wall across at x = 1: rooms of 4 and of 2 meters.
        let two = Room::new(outline(), vec![boxed([1.0, 0.0, 1.3], [0.1, 5.0, 2.6])]);
        assert!(two.in_middle(&cube(-1.0, 0.0)) > 0.95 && two.in_middle(&cube(2.0, 0.0)) > 0.95);
        assert!(two.in_middle(&cube(0.6, 0.0)) < 0.3 && two.against_wall(&cube(0.6, 0.0)) > 0.7);
        let chair = cube(-2.0, 0.5);
        // A viewer in the middle of the chair's room sees it along -X and +Y; from the middle of
        // the whole outline too, but less to the side.
        let ahead = two.faced(&chair).ahead.unwrap();
        assert!((ahead - Vector3::new(-1.0, 0.5, 0.0).normalize()).norm() < 0.1, "{ahead}");
    }

    #[test]
    fn objects_on_both_sides_of_a_wall_are_apart() {
        let low = boxed([1.0, -1.5, 0.3], [0.1, 2.0, 0.6]);
        let two = Room::new(outline(), vec![boxed([1.0, 1.0, 1.3], [0.1, 3.0, 2.6]), low]);
        assert!(two.apart_by_a_wall(&cube(0.5, 0.5), &cube(1.5, 0.5)));
        assert!(!two.apart_by_a_wall(&cube(0.5, 0.5), &cube(0.0, 0.0)));
        // An object that hangs on the wall is in both rooms; one can see past its end and over a
        // low wall.
        assert!(!two.apart_by_a_wall(&boxed([0.94, 0.5, 1.5], [0.02, 0.4, 0.4]), &cube(1.5, 0.5)));
        let lamp = |x: f32| boxed([x, -1.5, 1.6], [0.3; 3]);
        assert!(
            !two.apart_by_a_wall(&lamp(0.5), &lamp(1.5))
                && two.apart_by_a_wall(&cube(0.5, -1.5), &cube(1.5, -1.5))
        );
    }

    #[test]
    fn objects_at_a_wall_face_the_room() {
        assert!(
            room()
                .own_front(&boxed([0.0, 2.3, 1.0], [0.8, 0.4, 2.0]))
                .is_some_and(|front| front.y < -0.9)
        );
        assert!(
            room().own_front(&cube(0.0, 0.0)).is_none()
                && room().own_front(&cube(2.7, 2.2)).is_none()
        );
    }
}
