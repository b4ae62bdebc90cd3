//! Finds groups of frames whose poses are not in the same coordinates, or may not be.

use super::agreement::{Comparison, Overlap};
use super::sketch::FrameSketch;
use super::{MAX_NAMED, name_frames};
use crate::scan::Scan;
use uniground_types::findings::{Finding, FindingSubject};

/// Adds a finding if the frames are in groups that see nothing in common, or nothing that fits
/// closely. `fit_roughly`: all frames fit each other only roughly, which says nothing about groups.
pub(super) fn check(
    comparison: &Comparison,
    scan: &Scan,
    sketches: &[FrameSketch],
    fit_roughly: bool,
    findings: &mut Vec<Finding>,
) {
    let used: Vec<usize> =
        (0..sketches.len()).filter(|&i| !sketches[i].points.is_empty()).collect();
    let groups_of = |least: Overlap| {
        let mut groups = connected(&used, |i, j| comparison.overlap(i, j) >= least);
        // Single frames that fit nowhere are named one by one.
        groups.retain(|group| group.len() > 1);
        groups
    };
    let (apart, fitting) = (groups_of(Overlap::Doubtful), groups_of(Overlap::Same));
    let (groups, problem) = if apart.len() > 1 {
        (apart, "that never see each other")
    } else if fitting.len() > 1 && !fit_roughly {
        (fitting, "that do not fit each other")
    } else {
        return;
    };
    let name = |group: &Vec<usize>| {
        let first: Vec<usize> = group.iter().take(1).map(|&i| sketches[i].at).collect();
        format!("{} from {} on", group.len(), name_frames(scan, &first))
    };
    let named: Vec<String> = groups.iter().take(MAX_NAMED).map(name).collect();
    let text = format!(
        "the frames are in {} parts {problem} ({}): nothing shows that their poses are in the same coordinates",
        groups.len(),
        named.join(", ")
    );
    findings.push(Finding::unusual(FindingSubject::Poses, text).counting(groups.len()));
}

/// Returns the groups of frames that are connected, each ascending, in the order of their first
/// frames.
fn connected(frames: &[usize], are_connected: impl Fn(usize, usize) -> bool) -> Vec<Vec<usize>> {
    let mut left = frames.to_vec();
    let mut groups = Vec::new();
    while let Some(first) = left.first().copied() {
        left.remove(0);
        let mut group = vec![first];
        let mut examined = 0;
        while let Some(&frame) = group.get(examined) {
            examined += 1;
            let (near, far) = left.into_iter().partition(|&other| are_connected(frame, other));
            left = far;
            group.extend::<Vec<usize>>(near);
        }
        group.sort_unstable();
        groups.push(group);
    }
    groups
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn groups_are_chains_of_connections() {
        let near = |i: usize, j: usize| i.abs_diff(j) == 2;
        assert_eq!(connected(&[0, 1, 2, 3, 4, 9], near), [vec![0, 2, 4], vec![1, 3], vec![9]]);
        assert!(connected(&[], near).is_empty());
    }
}
