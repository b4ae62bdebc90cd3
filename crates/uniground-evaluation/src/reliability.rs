//! Measures how reliable the confidence of answers is.

use super::scoring::ScoredExpression;
use serde::{Deserialize, Serialize};
use std::fmt;
use uniground_grounding::Status;

/// Confidence of answers with a box, compared with their correctness.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Reliability {
    /// Number of answers with a box.
    pub grounded: usize,
    /// Share of those that are right at an IoU of 0.25.
    pub right: f32,
    /// Expected calibration error: the difference between the share of right answers and the mean
    /// confidence, in tenths of confidence, weighted by the number of answers.
    pub calibration_error: f32,
    /// Coverage and correctness for callers that only accept answers of at least this confidence.
    pub at_least: Vec<Risk>,
}

/// A point of the risk-coverage curve.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Risk {
    pub confidence: f32,
    /// Share of the grounded answers with at least this confidence.
    pub coverage: f32,
    /// Share of those that are right. `None` when there are none.
    pub right: Option<f32>,
}

const STEPS: [f32; 5] = [0.1, 0.3, 0.5, 0.7, 0.9];

impl Reliability {
    /// Computes the reliability. Returns `None` if no answer has a box.
    #[must_use]
    pub fn from_outcomes(outcomes: &[&ScoredExpression]) -> Option<Self> {
        let grounded: Vec<(f32, bool)> = outcomes
            .iter()
            .filter(|o| o.status() == Some(Status::Grounded))
            .filter_map(|o| Some((o.reply.as_ref()?.confidence, o.is_right())))
            .collect();
        let share = |of: &[(f32, bool)]| {
            (!of.is_empty())
                .then(|| of.iter().filter(|(_, right)| *right).count() as f32 / of.len() as f32)
        };
        let right = share(&grounded)?;
        let mut tenths: Vec<Vec<(f32, bool)>> = vec![Vec::new(); 10];
        grounded
            .iter()
            .for_each(|answer| tenths[((answer.0 * 10.0) as usize).min(9)].push(*answer));
        let off = |tenth: &Vec<(f32, bool)>| {
            let mean = tenth.iter().fold(0.0, |sum, (confidence, _)| sum + confidence)
                / tenth.len().max(1) as f32;
            share(tenth).map_or(0.0, |right| (right - mean).abs() * tenth.len() as f32)
        };
        let at = |confidence: f32| {
            let sure: Vec<(f32, bool)> =
                grounded.iter().copied().filter(|answer| answer.0 >= confidence).collect();
            Risk {
                confidence,
                coverage: sure.len() as f32 / grounded.len() as f32,
                right: share(&sure),
            }
        };
        Some(Self {
            grounded: grounded.len(),
            right,
            calibration_error: tenths.iter().map(off).fold(0.0, |sum, v| sum + v)
                / grounded.len() as f32,
            at_least: STEPS.map(at).to_vec(),
        })
    }
}

impl fmt::Display for Reliability {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { grounded, right, calibration_error, at_least } = self;
        write!(
            f,
            "{grounded} answers with a box, {:.1} % right; calibration error {calibration_error:.3}",
            right * 100.0
        )?;
        for Risk { confidence, coverage, right } in at_least {
            if let Some(right) = right {
                write!(
                    f,
                    "; from {confidence} on {:.1} % right of {:.0} %",
                    right * 100.0,
                    coverage * 100.0
                )?;
            }
        }
        write!(f, ".")
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::reply::Reply;

    fn answer(confidence: f32, right: bool) -> ScoredExpression {
        // Without a target every answer with a box is wrong. With one, its IoU decides.
        let target = right.then(|| crate::scoring::TargetOutcome {
            name: None,
            aabb: uniground_geometry::boxes::Aabb {
                center: uniground_geometry::Point3::origin(),
                size: uniground_geometry::Vector3::repeat(1.0),
            },
            iou: 1.0,
            iou_9dof: None,
            candidate_ious: Vec::new(),
            shortlist_ious: Vec::new(),
            best_instance_iou: 1.0,
        });
        let reply = Some(Reply { status: Status::Grounded, confidence, ..Reply::empty() });
        ScoredExpression {
            id: String::new(),
            scene: String::new(),
            query: String::new(),
            splits: Vec::new(),
            target,
            reply,
            error: None,
            picture: None,
        }
    }

    #[test]
    fn reliability_matches_hand_computed_values() {
        let outcomes =
            [answer(0.95, true), answer(0.85, true), answer(0.55, false), answer(0.05, false)];
        let found = Reliability::from_outcomes(&outcomes.iter().collect::<Vec<_>>()).unwrap();
        assert_eq!((found.grounded, found.right), (4, 0.5));
        let at: Vec<(f32, Option<f32>)> =
            found.at_least.iter().map(|risk| (risk.coverage, risk.right)).collect();
        let two_thirds = 2.0 / 3.0;
        assert_eq!(
            at,
            [
                (0.75, Some(two_thirds)),
                (0.75, Some(two_thirds)),
                (0.75, Some(two_thirds)),
                (0.5, Some(1.0)),
                (0.25, Some(1.0))
            ]
        );
        assert!(
            (found.calibration_error - (0.05 + 0.15 + 0.55 + 0.05) / 4.0).abs() < 1e-6,
            "{}",
            found.calibration_error
        );
        assert!(
            found
                .to_string()
                .starts_with("4 answers with a box, 50.0 % right; calibration error 0.200; from 0.1 on 66.7 % right of 75 %")
        );
        assert_eq!(Reliability::from_outcomes(&[]), None);
    }
}
