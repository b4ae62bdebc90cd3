//! Order statistics that do not care about a few wild values.

/// The value below which the share `q` (0..=1) of `values` lies; reorders them. `None` when there are none.
///
/// Nearest rank, no interpolation: the answer is always one of the values. NaN sorts last.
pub fn quantile(values: &mut [f32], q: f32) -> Option<f32> {
    if values.is_empty() {
        return None;
    }
    let rank = ((values.len() - 1) as f32 * q.clamp(0.0, 1.0)).round() as usize;
    Some(*values.select_nth_unstable_by(rank, f32::total_cmp).1)
}

/// The middle value; reorders them.
pub fn median(values: &mut [f32]) -> Option<f32> {
    quantile(values, 0.5)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_are_members_of_the_set() {
        let mut values = [5.0, 1.0, 4.0, 2.0, 3.0];
        assert_eq!(quantile(&mut values, 0.0), Some(1.0));
        assert_eq!(median(&mut values), Some(3.0));
        assert_eq!(quantile(&mut values, 1.0), Some(5.0));
        assert_eq!(median(&mut []), None);
    }
}
