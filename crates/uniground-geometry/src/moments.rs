//! Mean and covariance of many points, summed in double precision. In single precision, the sum of
//! five million points is off by meters.

use super::{Matrix3, Point3};

/// First and second moments of a set of points.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Moments {
    /// Average position, meters; the origin when there are no points.
    pub mean: Point3<f32>,
    /// Covariance of the coordinates, square meters; divided by the number of points, zero when
    /// there are none.
    pub covariance: Matrix3<f32>,
}

impl Moments {
    /// Computes the moments. Without points, they are the origin and no spread.
    #[must_use]
    pub fn from_points(points: &[Point3<f32>]) -> Self {
        let n = points.len().max(1) as f64;
        let mean =
            points.iter().fold(nalgebra::Vector3::zeros(), |sum, p| sum + p.coords.cast::<f64>())
                / n;
        let scatter = points.iter().fold(nalgebra::Matrix3::zeros(), |sum, p| {
            let d = p.coords.cast::<f64>() - mean;
            sum + d * d.transpose()
        });
        Self { mean: Point3::from(mean.cast::<f32>()), covariance: (scatter / n).cast() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn moments_are_accurate_for_millions_of_points_far_from_the_origin() {
        // A level plane at 2.3 m, a kilometer away.
        let points: Vec<_> = (0..3_000_000)
            .map(|i| {
                Point3::new(
                    1000.0 + (i % 1500) as f32 * 0.003,
                    -800.0 + (i / 1500) as f32 * 0.002,
                    2.3,
                )
            })
            .collect();
        let moments = Moments::from_points(&points);
        assert!(
            (moments.mean - Point3::new(1002.25, -798.0, 2.3)).norm() < 0.01,
            "{}",
            moments.mean
        );
        assert!(
            moments.covariance[(2, 2)] < 1e-6
                && (moments.covariance[(1, 1)] - 4.0_f32.powi(2) / 12.0).abs() < 0.01
        );
    }
}
