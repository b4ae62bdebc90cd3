//! Computes the paper's figures over a set of outcomes, with 95 % bootstrap intervals.

use super::reliability::Reliability;
use super::scoring::{ScoredExpression, TargetOutcome};
use super::segmentation::IOU_THRESHOLDS;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use uniground_geometry::statistics::quantile;
use uniground_grounding::Status;

/// A share and its 95 % interval, all in `0..=1`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Share {
    pub of: usize,
    pub value: f32,
    pub low: f32,
    pub high: f32,
}

/// `no_match` as a prediction of "not in this room".
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Abstention {
    /// Number of expressions about absent objects.
    pub absent: usize,
    /// Number of `no_match` answers.
    pub said: usize,
    /// Share of `no_match` answers that are right. `None` when there are none.
    pub precision: Option<f32>,
    /// Share of absent objects answered with `no_match`. `None` when nothing is absent.
    pub recall: Option<f32>,
    /// Share of present objects answered with `no_match`.
    pub denied: Option<f32>,
}

#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Percentiles {
    pub p50: f64,
    pub p95: f64,
    pub p99: f64,
}

/// The figures of one cell, or of one split of it. Pairs are at an IoU of 0.25 and 0.5.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Figures {
    pub expressions: usize,
    /// Acc@0.25 and Acc@0.5 over all expressions with a target.
    pub complete: [Share; 2],
    /// The same without expressions whose target no candidate covers with an IoU of 0.25: stage 2
    /// alone.
    pub filtered: [Share; 2],
    pub mean_iou: f32,
    /// Over targets annotated with an oriented box: their number, mean IoU, and accuracies.
    pub oriented: Option<Oriented>,
    /// Candidate recall at k = 1, 2, ... `top_k`.
    pub recall_at: Vec<[f32; 2]>,
    /// Recall of the shortlist, at k = 1, 2, ...
    pub shortlist_recall_at: Vec<[f32; 2]>,
    /// Share of targets that any instance covers: the upper bound set by stage 1.
    pub any_instance: [f32; 2],
    pub abstention: Abstention,
    /// Reliability of the confidences. `None` if no answer has a box.
    #[serde(default)]
    pub reliability: Option<Reliability>,
    /// Number of `ambiguous` answers.
    pub ambiguous: usize,
    /// Number of failed questions. They count as wrong.
    pub failed: usize,
    /// Mean per question.
    pub vlm_calls: f32,
    pub prompt_tokens: f32,
    pub completion_tokens: f32,
    /// Total of all questions.
    pub cost_usd: f64,
    pub latency_ms: Option<Percentiles>,
    /// Number of targets by IoU of the answer, in steps of 0.05. No answer counts as 0.
    pub iou_histogram: [usize; 20],
}

#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Oriented {
    pub targets: usize,
    pub mean_iou: f32,
    pub accuracy: [f32; 2],
}

/// Number of bootstrap resamples of an interval.
const RESAMPLES: usize = 1000;
/// Minimum number of scenes for resampling whole scenes. Expressions of one scene share its parse.
const CLUSTERED_FROM: usize = 10;

impl Figures {
    #[must_use]
    pub fn from_outcomes(outcomes: &[&ScoredExpression], seed: u64) -> Self {
        let targets: Vec<(&ScoredExpression, &TargetOutcome)> =
            outcomes.iter().filter_map(|o| Some((*o, o.target.as_ref()?))).collect();
        let retained: Vec<&ScoredExpression> = targets
            .iter()
            .filter(|(_, t)| best_iou(&t.candidate_ious) >= IOU_THRESHOLDS[0])
            .map(|(o, _)| *o)
            .collect();
        let with_target: Vec<&ScoredExpression> = targets.iter().map(|(o, _)| *o).collect();
        // An empty sum of floats is -0. Folding from zero avoids that.
        let mean = |values: &mut dyn Iterator<Item = f32>| {
            values.fold(0.0, |sum, v| sum + v) / targets.len().max(1) as f32
        };
        let recall = |of: &dyn Fn(&TargetOutcome) -> f32| {
            IOU_THRESHOLDS
                .map(|at| mean(&mut targets.iter().map(|(_, t)| f32::from(u8::from(of(t) >= at)))))
        };
        let curve = |of: fn(&TargetOutcome) -> &Vec<f32>| {
            let depth = targets.iter().map(|(_, t)| of(t).len()).max().unwrap_or(0);
            (1..=depth).map(|k| recall(&|t| best_iou(&of(t)[..k.min(of(t).len())]))).collect()
        };
        let answered = outcomes.iter().filter_map(|o| o.reply.as_ref());
        let per_question = |total: u64| total as f32 / outcomes.len().max(1) as f32;
        let mut iou_histogram = [0; 20];
        targets.iter().for_each(|(_, t)| iou_histogram[((t.iou * 20.0) as usize).min(19)] += 1);
        Self {
            expressions: outcomes.len(),
            complete: IOU_THRESHOLDS.map(|at| Share::share_right(&with_target, at, seed)),
            filtered: IOU_THRESHOLDS.map(|at| Share::share_right(&retained, at, seed)),
            mean_iou: mean(&mut targets.iter().map(|(_, t)| t.iou)),
            oriented: Oriented::from_ious(
                &targets.iter().filter_map(|(_, t)| t.iou_9dof).collect::<Vec<_>>(),
            ),
            recall_at: curve(|t| &t.candidate_ious),
            shortlist_recall_at: curve(|t| &t.shortlist_ious),
            any_instance: recall(&|t| t.best_instance_iou),
            abstention: Abstention::from_outcomes(outcomes),
            reliability: Reliability::from_outcomes(outcomes),
            ambiguous: outcomes.iter().filter(|o| o.status() == Some(Status::Ambiguous)).count(),
            failed: outcomes.iter().filter(|o| o.reply.is_none()).count(),
            vlm_calls: per_question(answered.clone().map(|r| u64::from(r.usage.vlm_calls)).sum()),
            prompt_tokens: per_question(answered.clone().map(|r| r.usage.prompt_tokens).sum()),
            completion_tokens: per_question(
                answered.clone().map(|r| r.usage.completion_tokens).sum(),
            ),
            cost_usd: answered.clone().fold(0.0, |sum, r| sum + r.usage.cost_usd),
            latency_ms: Percentiles::from_values(answered.map(|r| r.latency_ms).collect()),
            iou_histogram,
        }
    }
}

impl Share {
    fn share_right(outcomes: &[&ScoredExpression], at: f32, seed: u64) -> Self {
        let values: Vec<(&str, f32)> = outcomes
            .iter()
            .map(|o| (o.scene.as_str(), f32::from(u8::from(o.is_right_at(at)))))
            .collect();
        let value = values.iter().fold(0.0, |sum, (_, v)| sum + v) / values.len().max(1) as f32;
        let (low, high) = confidence_interval(&values, seed);
        Self { of: values.len(), value, low, high }
    }

    /// Returns the number of hits, out of [`of`](Self::of).
    #[must_use]
    pub fn count(&self) -> usize {
        (self.value * self.of as f32).round() as usize
    }
}

impl Abstention {
    fn from_outcomes(outcomes: &[&ScoredExpression]) -> Self {
        let share = |n: usize, of: usize| (of > 0).then(|| n as f32 / of as f32);
        let said = |o: &&&ScoredExpression| o.status() == Some(Status::NoMatch);
        let absent = outcomes.iter().filter(|o| o.target.is_none()).count();
        let all_said = outcomes.iter().filter(said).count();
        let right = outcomes.iter().filter(said).filter(|o| o.target.is_none()).count();
        Self {
            absent,
            said: all_said,
            precision: share(right, all_said),
            recall: share(right, absent),
            denied: share(all_said - right, outcomes.len() - absent),
        }
    }
}

impl Oriented {
    fn from_ious(ious: &[f32]) -> Option<Self> {
        let n = ious.len() as f32;
        (!ious.is_empty()).then(|| Self {
            targets: ious.len(),
            mean_iou: ious.iter().sum::<f32>() / n,
            accuracy: IOU_THRESHOLDS
                .map(|at| ious.iter().filter(|iou| **iou >= at).count() as f32 / n),
        })
    }
}

impl Percentiles {
    fn from_values(mut values: Vec<f64>) -> Option<Self> {
        values.sort_by(f64::total_cmp);
        let at =
            |q: f64| values[((q * values.len() as f64).ceil() as usize).clamp(1, values.len()) - 1];
        (!values.is_empty()).then(|| Self { p50: at(0.5), p95: at(0.95), p99: at(0.99) })
    }
}

fn best_iou(ious: &[f32]) -> f32 {
    ious.iter().copied().fold(0.0, f32::max)
}

/// Returns the 95 % percentile interval of a mean, by resampling. Each value has its scene. With
/// many scenes, whole scenes are resampled.
#[must_use]
pub fn confidence_interval(values: &[(&str, f32)], seed: u64) -> (f32, f32) {
    if values.is_empty() {
        return (0.0, 0.0);
    }
    let mut scenes: BTreeMap<&str, (f64, f64)> = BTreeMap::new();
    for (scene, value) in values {
        let (sum, n) = scenes.entry(scene).or_default();
        *sum += f64::from(*value);
        *n += 1.0;
    }
    let units: Vec<(f64, f64)> = match scenes.len() >= CLUSTERED_FROM {
        true => scenes.into_values().collect(),
        false => values.iter().map(|(_, value)| (f64::from(*value), 1.0)).collect(),
    };
    let mut state = seed;
    let mut means: Vec<f32> = (0..RESAMPLES)
        .map(|_| {
            let drawn = (0..units.len())
                .map(|_| units[(next_random(&mut state) % units.len() as u64) as usize]);
            let (sum, n) = drawn.fold((0.0, 0.0), |(sum, n), (s, m)| (sum + s, n + m));
            (sum / n) as f32
        })
        .collect();
    let [low, high] = [0.025, 0.975].map(|q| quantile(&mut means, q).unwrap_or(0.0));
    (low, high)
}

/// Returns the next number of `SplitMix64`.
fn next_random(state: &mut u64) -> u64 {
    *state = state.wrapping_add(0x9e37_79b9_7f4a_7c15);
    let mut z = *state;
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::reply::Reply;
    use uniground_geometry::boxes::Aabb;
    use uniground_geometry::{Point3, Vector3};

    fn outcome(id: u32, target: Option<(f32, &[f32])>, status: Status) -> ScoredExpression {
        let aabb = Aabb { center: Point3::origin(), size: Vector3::repeat(1.0) };
        let target = target.map(|(iou, candidates)| TargetOutcome {
            name: None,
            aabb,
            iou,
            iou_9dof: None,
            candidate_ious: candidates.to_vec(),
            shortlist_ious: Vec::new(),
            best_instance_iou: candidates.iter().copied().fold(0.0, f32::max),
        });
        let reply = Reply { status, latency_ms: f64::from(id), ..Reply::empty() };
        let splits = Vec::new();
        ScoredExpression {
            id: id.to_string(),
            scene: "room".into(),
            query: "q".into(),
            splits,
            target,
            reply: Some(reply),
            error: None,
            picture: None,
        }
    }

    #[test]
    fn figures_match_hand_computed_values() {
        let outcomes = [
            outcome(1, Some((0.6, &[0.6, 0.1])), Status::Grounded),
            outcome(2, Some((0.3, &[0.3])), Status::Grounded),
            outcome(3, Some((0.0, &[0.1, 0.7])), Status::Grounded),
            // Stage 1 missed it, so it does not count in the filtered figure.
            outcome(4, Some((0.0, &[0.1])), Status::NoMatch),
            outcome(5, None, Status::NoMatch),
            outcome(6, None, Status::Grounded),
        ];
        let figures = Figures::from_outcomes(&outcomes.iter().collect::<Vec<_>>(), 0);
        assert_eq!(figures.expressions, 6);
        assert_eq!(figures.complete.map(|s| (s.value, s.of)), [(0.5, 4), (0.25, 4)]);
        assert_eq!(figures.filtered.map(|s| s.of), [3, 3]);
        assert!((figures.filtered[0].value - 2.0 / 3.0).abs() < 1e-6);
        assert_eq!(figures.recall_at, [[0.5, 0.25], [0.75, 0.5]]);
        assert_eq!(figures.any_instance, [0.75, 0.5]);
        assert!((figures.mean_iou - 0.225).abs() < 1e-6);
        let Abstention { precision, recall, denied, absent, said } = figures.abstention;
        assert_eq!(
            (absent, said, precision, recall, denied),
            (2, 2, Some(0.5), Some(0.5), Some(0.25))
        );
        assert_eq!(figures.latency_ms, Some(Percentiles { p50: 3.0, p95: 6.0, p99: 6.0 }));
        assert_eq!(
            (figures.iou_histogram[0], figures.iou_histogram[6], figures.iou_histogram[12]),
            (2, 1, 1)
        );
    }

    #[test]
    fn intervals_contain_the_mean_and_narrow_with_more_values() {
        let few: Vec<(&str, f32)> = (0..40_u8).map(|i| ("a", f32::from(i % 2))).collect();
        let many: Vec<(&str, f32)> = (0..4000_u16).map(|i| ("a", f32::from(i % 2))).collect();
        let (low, high) = confidence_interval(&few, 7);
        assert!(
            low < 0.5 && high > 0.5 && (high - low) > 0.2 && (high - low) < 0.4,
            "{low} {high}"
        );
        let (narrow_low, narrow_high) = confidence_interval(&many, 7);
        assert!(narrow_high - narrow_low < 0.05, "{narrow_low} {narrow_high}");
        assert_eq!(
            confidence_interval(&few, 7),
            (low, high),
            "the same seed gives the same interval"
        );
    }

    #[test]
    fn bootstrap_resamples_whole_scenes_when_there_are_many() {
        // Twelve scenes, each entirely right or wrong: 1,200 expressions carry the information of
        // twelve.
        let names: Vec<String> = (0..12).map(|i| format!("s{i}")).collect();
        let values: Vec<(&str, f32)> =
            (0..1200).map(|i| (names[i % 12].as_str(), f32::from(u8::from(i % 12 < 6)))).collect();
        let (low, high) = confidence_interval(&values, 1);
        assert!(high - low > 0.3, "{low} {high}");
    }
}
