//! Finds why poses and depth do not agree: mistakes that scans often contain, tried one by one.

use super::{
    CLEARLY_BETTER, CLEARLY_RIGHT, PoseOf, ReprojectionSample, SourceConvention, TIMES_BETTER,
};
use nalgebra::{Matrix3, Matrix4, Quaternion, Rotation3, UnitQuaternion};
use uniground_types::findings::{Finding, FindingSubject};

/// Poses that are shifted by a frame must agree this much better than the frames' own: those of
/// neighboring frames nearly agree anyway.
const SHIFTED_BETTER: f32 = 1.1;

impl ReprojectionSample<'_> {
    /// Returns what would make poses and depth agree, as a sentence. `None` if nothing does.
    pub(super) fn likely_cause(&self, declared: &SourceConvention, fits: f32) -> Option<String> {
        let in_meters = SourceConvention { metres_per_unit: 1.0, ..*declared };
        let tried = [
            (
                *declared,
                PoseOf::ScalarFirst,
                "if quaternions are written as w x y z: write them as x y z w",
            ),
            (
                *declared,
                PoseOf::Next,
                "if every picture takes the pose of the next one: the lists are shifted",
            ),
            (
                *declared,
                PoseOf::Previous,
                "if every picture takes the pose of the previous one: the lists are shifted",
            ),
            (in_meters, PoseOf::Itself, "with metres_per_unit=1"),
        ];
        let best = tried
            .into_iter()
            .filter_map(|(reading, pose, cause)| {
                let is_declared = reading == *declared && pose == PoseOf::Itself;
                let agreement = self.agreement_with(&reading, pose).filter(|_| !is_declared)?;
                Some((agreement, cause))
            })
            .max_by(|a, b| a.0.total_cmp(&b.0));
        if let Some((agreement, cause)) = best
            && agreement >= CLEARLY_BETTER.max(fits * TIMES_BETTER)
        {
            return Some(format!("{:.0}% would agree {cause}", agreement * 100.0));
        }
        let alone =
            self.agreement_without_cloud(declared).filter(|alone| *alone >= CLEARLY_RIGHT)?;
        Some(format!(
            "the frames fit each other ({:.0}%), so the cloud has another unit, origin or axes, or is of another scan",
            alone * 100.0
        ))
    }

    /// Returns a finding if the poses of the next or previous frames fit better than the frames'
    /// own.
    pub(super) fn find_shift(&self, declared: &SourceConvention, fits: f32) -> Option<Finding> {
        let shifted = |pose, name| Some((self.agreement_with(declared, pose)?, name));
        let (agreement, name) =
            [shifted(PoseOf::Next, "next"), shifted(PoseOf::Previous, "previous")]
                .into_iter()
                .flatten()
                .max_by(|a, b| a.0.total_cmp(&b.0))?;
        let text = format!(
            "pictures and poses may be shifted by one: {:.0}% of the sampled points fit the depth pictures, but {:.0}% do if every picture takes the pose of the {name} one",
            fits * 100.0,
            agreement * 100.0
        );
        (agreement >= SHIFTED_BETTER * fits).then(|| Finding::unusual(FindingSubject::Frames, text))
    }
}

/// Returns the pose whose quaternion `w x y z` was read as `x y z w`. `None` if it is not a rigid
/// transform.
pub(super) fn with_scalar_first(pose: &Matrix4<f64>) -> Option<Matrix4<f64>> {
    let rotation: Matrix3<f64> = pose.fixed_view::<3, 3>(0, 0).into_owned();
    if (rotation.determinant() - 1.0).abs() > 0.01 {
        return None;
    }
    let read = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(rotation));
    let [w, x, y, z] = [read.i, read.j, read.k, read.w];
    let meant = UnitQuaternion::new_normalize(Quaternion::new(w, x, y, z));
    let mut corrected = *pose;
    corrected.fixed_view_mut::<3, 3>(0, 0).copy_from(meant.to_rotation_matrix().matrix());
    Some(corrected)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn order_of_a_quaternion_is_corrected(q in prop::array::uniform4(-1.0_f64..1.0)) {
            prop_assume!(q.iter().map(|v| v * v).sum::<f64>() > 0.01);
            let [w, x, y, z] = q;
            let matrix = |w, x, y, z| {
                UnitQuaternion::new_normalize(Quaternion::new(w, x, y, z)).to_homogeneous()
            };
            // The file holds `w x y z`, which is read as `x y z w`.
            let (meant, read) = (matrix(w, x, y, z), matrix(z, w, x, y));
            let corrected = with_scalar_first(&read).unwrap();
            prop_assert!((corrected - meant).norm() < 1e-6, "{corrected} {meant}");
        }
    }
}
