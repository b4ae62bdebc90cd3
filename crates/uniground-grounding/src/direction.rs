//! Directions as data: what "left" and "in front" mean in the world.

use super::solid::Solid;
use uniground_geometry::{Isometry3, Point3, Vector3};
use uniground_language::Look;
pub use uniground_types::question::{DirectionConvention, Observer};

/// The horizontal directions that a query is read in.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Directions {
    /// The direction of "to the right"; left is the opposite. Unit length, world frame.
    pub right: Vector3<f32>,
    /// The direction of "in front": towards the viewer; back is the opposite. Unit length, world
    /// frame.
    pub front: Vector3<f32>,
    /// Whether this is a viewer's perspective (an observer's, or given by the question) and not a
    /// convention.
    pub of_somebody: bool,
    /// Whether these are the default directions. Then the view from where people would stand takes
    /// precedence.
    pub by_default: bool,
}

impl From<DirectionConvention> for Directions {
    fn from(convention: DirectionConvention) -> Self {
        match convention {
            DirectionConvention::Paper => Self {
                right: -Vector3::x(),
                front: -Vector3::y(),
                of_somebody: false,
                by_default: true,
            },
            DirectionConvention::Viewer => Self {
                right: Vector3::x(),
                front: -Vector3::y(),
                of_somebody: false,
                by_default: false,
            },
        }
    }
}

impl Directions {
    /// Returns the directions as seen along `forward` (only its horizontal part counts); `None`
    /// when it points straight up or down.
    #[must_use]
    pub fn looking_along(forward: Vector3<f32>) -> Option<Self> {
        let forward = Vector3::new(forward.x, forward.y, 0.0).try_normalize(1e-3)?;
        Some(Self {
            right: forward.cross(&Vector3::z()),
            front: -forward,
            of_somebody: true,
            by_default: false,
        })
    }

    /// Returns the directions as seen by an observer. Only the yaw counts, not the position.
    #[must_use]
    pub fn of_observer(observer: &Observer) -> Self {
        let forward = Vector3::new(observer.yaw_rad.cos(), observer.yaw_rad.sin(), 0.0);
        Self {
            right: forward.cross(&Vector3::z()),
            front: -forward,
            of_somebody: true,
            by_default: false,
        }
    }

    /// Returns the directions of a person in the room who looks as the words say. Instances that
    /// are longer than deep are faced squarely: a window across the wall, a desk across its long
    /// side.
    #[must_use]
    pub fn of_look(look: Look, anchor: &Solid, room_center: &Point3<f32>) -> Option<Self> {
        let towards = anchor.center - room_center;
        match look {
            Look::Facing => Self::looking_along(squarely(anchor, &towards).unwrap_or(towards)),
            Look::From | Look::BackTo => {
                Self::looking_along(-squarely(anchor, &towards).unwrap_or(towards))
            }
        }
    }
}

/// Minimum length of the mean of the horizontal directions in which the frames of a scan look, if
/// they all look one way. Walks through rooms have 0 to 0.5.
const ONE_WAY: f32 = 0.8;

/// Returns the horizontal direction in which all frames of a scan look, given their poses
/// (camera-to-world), if there is one: that of a desk from the front, not of a walk through a room.
pub(crate) fn common_look(
    camera_to_world: impl IntoIterator<Item = Isometry3<f32>>,
) -> Option<Vector3<f32>> {
    let horizontal = |pose: Isometry3<f32>| {
        let ahead = pose * Vector3::z();
        Vector3::new(ahead.x, ahead.y, 0.0).try_normalize(1e-3)
    };
    let looks: Vec<Vector3<f32>> = camera_to_world.into_iter().filter_map(horizontal).collect();
    let mean = looks.iter().sum::<Vector3<f32>>() / looks.len().max(1) as f32;
    (mean.norm() >= ONE_WAY).then_some(mean)
}

/// Returns the direction across a long instance, on the side `towards` points to; `None` for an
/// instance about as deep as long, or seen end on.
fn squarely(anchor: &Solid, towards: &Vector3<f32>) -> Option<Vector3<f32>> {
    const LONGER_THAN_DEEP: f32 = 1.3;
    const MIN_SQUARE: f32 = 0.35;
    let (long, short) = anchor.sides();
    if long < LONGER_THAN_DEEP * short {
        return None;
    }
    let along = anchor.along();
    let across = Vector3::new(-along.y, along.x, 0.0);
    let towards = Vector3::new(towards.x, towards.y, 0.0).try_normalize(1e-3)?;
    let square = across.dot(&towards);
    (square.abs() >= MIN_SQUARE).then(|| across * square.signum())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_that_look_one_way_have_a_common_look() {
        let pose = |yaw_deg: &f32| {
            let (sin, cos) = yaw_deg.to_radians().sin_cos();
            let ahead = Point3::new(cos, sin, -0.5);
            Isometry3::face_towards(&Point3::origin(), &ahead, &-Vector3::z())
        };
        let looks = |yaws: &[f32]| common_look(yaws.iter().map(pose));
        let desk = looks(&[60.0, 90.0, 120.0]).unwrap();
        assert!(desk.y > 0.8 && desk.x.abs() < 1e-3, "{desk}");
        assert_eq!(looks(&[0.0, 90.0, 180.0, 270.0]), None);
        assert_eq!(looks(&[]), None);
    }

    #[test]
    fn viewer_looking_along_y_has_x_on_the_right() {
        let seen = Directions::looking_along(Vector3::new(0.0, 2.0, -0.5)).unwrap();
        assert!(
            (seen.right - Vector3::x()).norm() < 1e-6 && (seen.front + Vector3::y()).norm() < 1e-6
        );
        assert_eq!(seen.right, Directions::from(DirectionConvention::Viewer).right);
        let observer = Observer { position: [0.0; 3], yaw_rad: std::f32::consts::FRAC_PI_2 };
        assert!((Directions::of_observer(&observer).right - seen.right).norm() < 1e-6);
        assert_eq!(Directions::looking_along(Vector3::z()), None);
    }

    #[test]
    fn windows_are_faced_perpendicular_to_the_wall() {
        use uniground_geometry::boxes::Aabb;
        // A window in the wall at +X, far to one side: the line to its middle is oblique, the view
        // is not.
        let window = Solid::from(Aabb {
            center: Point3::new(3.0, 2.0, 1.5),
            size: Vector3::new(0.1, 1.4, 1.2),
        });
        let seen = Directions::of_look(Look::Facing, &window, &Point3::origin()).unwrap();
        assert!((seen.right + Vector3::y()).norm() < 1e-5, "{seen:?}");
        let from = Directions::of_look(Look::From, &window, &Point3::origin()).unwrap();
        assert!((from.right - Vector3::y()).norm() < 1e-5, "{from:?}");
        // A round table is faced along the line to it.
        let table = Solid::from(Aabb {
            center: Point3::new(1.0, 1.0, 0.4),
            size: Vector3::new(1.0, 1.0, 0.7),
        });
        let seen = Directions::of_look(Look::Facing, &table, &Point3::origin()).unwrap();
        assert!((seen.front + Vector3::new(1.0, 1.0, 0.0).normalize()).norm() < 1e-5, "{seen:?}");
    }

    #[test]
    fn paper_convention_mirrors_left_and_right() {
        assert_eq!(Directions::from(DirectionConvention::Paper).right, -Vector3::x());
    }
}
