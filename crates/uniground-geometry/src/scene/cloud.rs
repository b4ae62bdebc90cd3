//! Colored point clouds.

use crate::Point3;
use serde::{Deserialize, Serialize};

/// Points and their colors, same length. Meters, world frame.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct PointCloud {
    /// Coordinates, meters, Z up.
    pub positions: Vec<Point3<f32>>,
    /// 8-bit sRGB.
    #[serde(rename = "colours")]
    pub colors: Vec<[u8; 3]>,
}

impl PointCloud {
    /// Returns the number of points.
    #[must_use]
    pub fn len(&self) -> usize {
        self.positions.len()
    }

    /// Returns whether there are no points.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.positions.is_empty()
    }
}
