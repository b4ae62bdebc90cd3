//! Finds the frames that agree with the others much less than most do.

use uniground_geometry::statistics::median;

/// Minimum number of compared frames.
const MIN_FRAMES: usize = 4;

/// Returns the median agreement of the used frames. `None` if too few can be compared.
///
/// `agreement` of a frame counts only other frames that are used.
pub(super) fn median_agreement(
    used: &[bool],
    agreement: impl Fn(usize, &[bool]) -> Option<f32>,
) -> Option<f32> {
    let mut all: Vec<f32> = ascending(used, &agreement).into_iter().map(|(a, _)| a).collect();
    median(&mut all).filter(|_| all.len() >= MIN_FRAMES)
}

/// Takes the frames out of `used` that stand out, and returns them, ascending. The worst is taken
/// first, because it lowers the agreement of its neighbors as well.
///
/// `stands_out` is given the lowest agreement and the median.
pub(super) fn remove_outliers(
    used: &mut [bool],
    agreement: impl Fn(usize, &[bool]) -> Option<f32>,
    stands_out: impl Fn(f32, f32) -> bool,
) -> Vec<usize> {
    let mut removed = Vec::new();
    while let (Some(middle), Some((lowest, frame))) =
        (median_agreement(used, &agreement), ascending(used, &agreement).first().copied())
        && stands_out(lowest, middle)
    {
        used[frame] = false;
        removed.push(frame);
    }
    removed.sort_unstable();
    removed
}

/// Returns the agreement of the used frames and their positions, the lowest first.
fn ascending(
    used: &[bool],
    agreement: &impl Fn(usize, &[bool]) -> Option<f32>,
) -> Vec<(f32, usize)> {
    let one = |frame: usize| Some((agreement(frame, used)?, frame));
    let mut all: Vec<(f32, usize)> =
        (0..used.len()).filter(|&frame| used[frame]).filter_map(one).collect();
    all.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    all
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A frame agrees with the others by the mean of its agreement with each that is used.
    fn mean(table: &[[f32; 5]; 5]) -> impl Fn(usize, &[bool]) -> Option<f32> {
        |frame, used| {
            let others: Vec<f32> =
                (0..5).filter(|&o| o != frame && used[o]).map(|o| table[frame][o]).collect();
            (!others.is_empty()).then(|| others.iter().sum::<f32>() / others.len() as f32)
        }
    }

    #[test]
    fn one_bad_frame_does_not_drag_its_neighbors_along() {
        let mut table = [[1.0, 1.0, 1.0, 1.0, 0.0]; 5];
        table[4] = [0.0; 5];
        let mut used = [true; 5];
        let removed = remove_outliers(&mut used, mean(&table), |low, middle| low < middle - 0.1);
        assert_eq!((removed, used), (vec![4], [true, true, true, true, false]));
    }

    #[test]
    fn too_few_frames_have_no_median() {
        let mut used = [true, true, true, false, false];
        assert_eq!(median_agreement(&used, |_, _| Some(0.5)), None);
        assert!(remove_outliers(&mut used, |_, _| Some(0.0), |_, _| true).is_empty());
    }
}
