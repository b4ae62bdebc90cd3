//! Direction words as data: what "left" and "in front" mean in the world.

use crate::geometry::{Point3, Vector3};
use crate::scene::Instance;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

/// Named conventions. World frame, Z up.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum DirectionConvention {
    /// The paper's: left = +X, right = -X, front = -Y, back = +Y.
    #[default]
    Paper,
    /// Somebody at -Y who looks along +Y: right = +X, front (nearer) = -Y.
    Viewer,
}

impl DirectionConvention {
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Paper => "paper",
            Self::Viewer => "viewer",
        }
    }
}

/// Somebody who stands in the room.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct Observer {
    /// Metres, world frame (Z up).
    pub position: [f32; 3],
    /// Direction of view about +Z, radians; 0 looks along +X.
    pub yaw_rad: f32,
}

/// The horizontal directions a query's words are read in.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Directions {
    pub right: Vector3<f32>,
    /// Where something stands that is "in front": towards the viewer.
    pub front: Vector3<f32>,
}

impl From<DirectionConvention> for Directions {
    fn from(convention: DirectionConvention) -> Self {
        match convention {
            DirectionConvention::Paper => Self { right: -Vector3::x(), front: -Vector3::y() },
            DirectionConvention::Viewer => Self { right: Vector3::x(), front: -Vector3::y() },
        }
    }
}

impl Directions {
    /// As seen by somebody who looks along `forward` (only its horizontal part counts); `None` when it points straight up or down.
    #[must_use]
    pub fn looking_along(forward: Vector3<f32>) -> Option<Self> {
        let forward = Vector3::new(forward.x, forward.y, 0.0).try_normalize(1e-3)?;
        Some(Self { right: forward.cross(&Vector3::z()), front: -forward })
    }

    #[must_use]
    pub fn of_observer(observer: &Observer) -> Self {
        let forward = Vector3::new(observer.yaw_rad.cos(), observer.yaw_rad.sin(), 0.0);
        Self { right: forward.cross(&Vector3::z()), front: -forward }
    }

    /// As seen by a person in the middle of the room who faces `anchor`.
    #[must_use]
    pub fn facing(anchor: &Instance, room_center: &Point3<f32>) -> Option<Self> {
        Self::looking_along(anchor.aabb.center - room_center)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn somebody_looking_along_y_has_x_to_the_right() {
        let seen = Directions::looking_along(Vector3::new(0.0, 2.0, -0.5)).unwrap();
        assert!((seen.right - Vector3::x()).norm() < 1e-6 && (seen.front + Vector3::y()).norm() < 1e-6);
        assert_eq!(seen, Directions::from(DirectionConvention::Viewer));
        let observer = Observer { position: [0.0; 3], yaw_rad: std::f32::consts::FRAC_PI_2 };
        assert!((Directions::of_observer(&observer).right - seen.right).norm() < 1e-6);
        assert_eq!(Directions::looking_along(Vector3::z()), None);
    }

    #[test]
    fn the_paper_mirrors_left_and_right() {
        assert_eq!(Directions::from(DirectionConvention::Paper).right, -Vector3::x());
    }
}
