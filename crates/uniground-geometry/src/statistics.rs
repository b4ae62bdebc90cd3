//! Order statistics, which are robust against a few outliers.

/// Returns the value below which the share `q` (0..=1) of `values` lies, or `None` when there are
/// no values. Reorders them.
///
/// Nearest rank, no interpolation: the answer is always one of the values. NaN sorts last.
pub fn quantile(values: &mut [f32], q: f32) -> Option<f32> {
    if values.is_empty() {
        return None;
    }
    let rank = ((values.len() - 1) as f32 * q.clamp(0.0, 1.0)).round() as usize;
    Some(*values.select_nth_unstable_by(rank, f32::total_cmp).1)
}

/// Returns the median value. Reorders the values.
pub fn median(values: &mut [f32]) -> Option<f32> {
    quantile(values, 0.5)
}

/// Returns the positions of the `count` largest values, largest first, ties in order of position.
/// NaN is larger than all.
#[must_use]
pub fn largest_indices(values: &[f32], count: usize) -> Vec<usize> {
    let by_value = |a: &usize, b: &usize| values[*b].total_cmp(&values[*a]).then(a.cmp(b));
    let mut positions: Vec<usize> = (0..values.len()).collect();
    if count < positions.len() {
        positions.select_nth_unstable_by(count, by_value);
        positions.truncate(count);
    }
    positions.sort_unstable_by(by_value);
    positions
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn largest_indices_are_sorted_with_ties_by_position() {
        assert_eq!(largest_indices(&[0.2, 0.9, 0.2, 0.5, 0.9], 3), [1, 4, 3]);
        assert_eq!(largest_indices(&[0.2, 0.9, 0.2], 9), [1, 0, 2]);
        assert!(largest_indices(&[], 2).is_empty() && largest_indices(&[1.0], 0).is_empty());
    }

    #[test]
    fn a_quantile_is_one_of_the_values() {
        let mut values = [5.0, 1.0, 4.0, 2.0, 3.0];
        assert_eq!(quantile(&mut values, 0.0), Some(1.0));
        assert_eq!(median(&mut values), Some(3.0));
        assert_eq!(quantile(&mut values, 1.0), Some(5.0));
        assert_eq!(median(&mut []), None);
    }
}
