//! Exact distance transform on the grid, in time linear in its cells (Felzenszwalb and
//! Huttenlocher, Distance Transforms of Sampled Functions).

use rayon::prelude::*;
use std::f32::consts::FRAC_1_SQRT_2;

/// Returns the distance from the middle of each cell to the middle of the nearest of the `sites`,
/// in cells; infinite where there are none.
pub(super) fn distances(width: usize, height: usize, sites: impl Fn(usize) -> bool) -> Vec<f32> {
    let mut along_y: Vec<f32> =
        (0..width * height).map(|cell| if sites(cell) { 0.0 } else { f32::INFINITY }).collect();
    for cell in width..width * height {
        along_y[cell] = along_y[cell].min(along_y[cell - width] + 1.0);
    }
    for cell in (0..(width * height).saturating_sub(width)).rev() {
        along_y[cell] = along_y[cell].min(along_y[cell + width] + 1.0);
    }
    along_y.par_chunks_mut(width).for_each(across);
    along_y
}

/// Turns a row of distances along the other axis into distances over both axes: the lower envelope
/// of one parabola per cell.
fn across(row: &mut [f32]) {
    let square = |x: usize, row: &[f32]| f64::from(row[x]) * f64::from(row[x]);
    // Apex of each parabola of the envelope, and where it starts to be the lowest.
    let mut envelope: Vec<(usize, f64)> = Vec::new();
    for apex in (0..row.len()).filter(|&x| row[x].is_finite()) {
        let mut begins = f64::NEG_INFINITY;
        while let Some(&(last, last_begins)) = envelope.last() {
            let (a, b) = (last as f64, apex as f64);
            begins = (square(apex, row) + b * b - square(last, row) - a * a) / (2.0 * (b - a));
            if begins > last_begins {
                break;
            }
            envelope.pop();
            begins = f64::NEG_INFINITY;
        }
        envelope.push((apex, begins));
    }
    let squares: Vec<f64> = envelope.iter().map(|&(apex, _)| square(apex, row)).collect();
    let mut lowest = 0;
    for (x, distance) in row.iter_mut().enumerate() {
        while envelope.get(lowest + 1).is_some_and(|&(_, begins)| begins <= x as f64) {
            lowest += 1;
        }
        if let Some(&(apex, _)) = envelope.get(lowest) {
            let away = x as f64 - apex as f64;
            *distance = (away * away + squares[lowest]).sqrt() as f32;
        }
    }
}

/// Returns the distance that is certainly free around the middle of a cell, meters. An obstacle may
/// reach out to the corners of its own cell.
pub(super) fn clearance_m(distance_cells: f32, cell_m: f32) -> f32 {
    ((distance_cells - FRAC_1_SQRT_2) * cell_m).max(0.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn distance_equals_the_distance_to_the_nearest_site(width in 1_usize..24, height in 1_usize..24, sites in prop::collection::vec(0_usize..576, 0..12)) {
            let sites: Vec<usize> = sites.into_iter().map(|site| site % (width * height)).collect();
            let found = distances(width, height, |cell| sites.contains(&cell));
            for (cell, distance) in found.into_iter().enumerate() {
                let to = |site: &usize| {
                    let (dx, dy) = ((site % width).abs_diff(cell % width), (site / width).abs_diff(cell / width));
                    ((dx * dx + dy * dy) as f32).sqrt()
                };
                let nearest = sites.iter().map(to).fold(f32::INFINITY, f32::min);
                prop_assert!(distance == nearest || (distance - nearest).abs() < 1e-4, "{cell}: {distance}, not {nearest}");
            }
        }
    }
}
