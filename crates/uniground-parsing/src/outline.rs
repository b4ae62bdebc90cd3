//! Which pixels of a picture show an instance: its projected points, closed and filled, or a mask
//! that a segmenter found.

use uniground_geometry::scene::CellMask;

/// A tight box in a color picture, and the cells in it that show the instance.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Outline {
    /// Left, top, right, bottom, pixels.
    pub box_px: [u32; 4],
    /// Covers that box.
    pub mask: CellMask,
}

/// Average number of points per cell on the instance. With fewer there would be holes.
const POINTS_PER_CELL: f32 = 2.5;
/// Maximum number of points used, spread over all: more would not make a finer mask.
const MAX_POINTS: usize = 4000;
/// Rounds of estimating the cell size. Points can fill little of their box; the area they fill
/// gives a better estimate of their spacing.
const ROUNDS: usize = 3;
/// Pieces below this share of the mask are noise at the rims of what lies in front or behind.
const CRUMB_SHARE: f32 = 0.03;

impl Outline {
    /// Builds a mask from points. They are sparser than pixels, so cells are as large as the
    /// spacing of points, and gaps are closed.
    #[must_use]
    pub fn from_points(pixels: &[(f32, f32)], box_px: [u32; 4]) -> Self {
        let mask = cells_of_points(pixels, box_px, ROUNDS)
            .close_gaps()
            .fill_holes()
            .without_small_pieces(CRUMB_SHARE);
        Self { box_px, mask }
    }

    /// Builds a mask known by pixel: `inside` tests a position in the picture.
    #[must_use]
    pub fn from_predicate(box_px: [u32; 4], inside: impl Fn((f32, f32)) -> bool) -> Self {
        let [left, top, right, bottom] = box_px;
        let (width, height) =
            (right.saturating_sub(left).max(1), bottom.saturating_sub(top).max(1));
        let (columns, rows) = (width.min(CellMask::MAX_CELLS), height.min(CellMask::MAX_CELLS));
        let at = |low: u32, length: u32, cell: u32, cells: u32| {
            low as f32 + (cell as f32 + 0.5) * length as f32 / cells as f32
        };
        let mask = CellMask::from_fn(columns, rows, |column, row| {
            inside((at(left, width, column, columns), at(top, height, row, rows)))
        });
        Self { box_px, mask: mask.close_gaps().fill_holes().without_small_pieces(CRUMB_SHARE) }
    }

    /// Returns the number of pixels of the picture that show the instance.
    #[must_use]
    pub fn covered_px(&self) -> f32 {
        let [left, top, right, bottom] = self.box_px;
        (right - left) as f32 * (bottom - top) as f32 * self.mask.share()
    }
}

/// Returns the cells of a box that contain points. Cells are so large that an even surface leaves
/// none empty.
fn cells_of_points(
    pixels: &[(f32, f32)],
    [left, top, right, bottom]: [u32; 4],
    rounds: usize,
) -> CellMask {
    let (width, height) = ((right - left).max(1) as f32, (bottom - top).max(1) as f32);
    let finest = (width.max(height) / CellMask::MAX_CELLS as f32).max(1.0);
    let inside = |&&(x, y): &&(f32, f32)| {
        (left as f32..=right as f32).contains(&x) && (top as f32..=bottom as f32).contains(&y)
    };
    let points: Vec<(f32, f32)> = pixels
        .iter()
        .step_by(pixels.len().div_ceil(MAX_POINTS).max(1))
        .filter(inside)
        .map(|(x, y)| ((x - left as f32) / width, (y - top as f32) / height))
        .collect();
    let (mut covered, mut mask) = (1.0, CellMask::empty(1, 1));
    for _ in 0..rounds {
        let side = (width * height * covered * POINTS_PER_CELL / points.len().max(1) as f32)
            .sqrt()
            .max(finest);
        mask = CellMask::empty((width / side).ceil() as u32, (height / side).ceil() as u32);
        points.iter().for_each(|point| mask.add(*point));
        covered = mask.share();
        if side <= finest {
            break;
        }
    }
    mask
}

/// Returns the share of an instance's silhouette that nothing hides, `0..=1`: of the cells that
/// hold its points, those with visible ones.
///
/// Points on the instance's far side lie behind its visible side and do not count as hidden.
/// Positions are pixels of one picture.
#[must_use]
pub fn unoccluded_share(visible: &[(f32, f32)], hidden: &[(f32, f32)]) -> f32 {
    if hidden.is_empty() || visible.is_empty() {
        return if hidden.is_empty() { 1.0 } else { 0.0 };
    }
    let reach = |of: fn(&(f32, f32)) -> f32| {
        let all = visible.iter().chain(hidden).map(of);
        let (low, high) =
            all.fold((f32::INFINITY, 0.0_f32), |(low, high), v| (low.min(v), high.max(v)));
        (low.floor().max(0.0) as u32, high.floor() as u32 + 1)
    };
    let ((left, right), (top, bottom)) = (reach(|p| p.0), reach(|p| p.1));
    let box_px = [left, top, right, bottom];
    let all: Vec<(f32, f32)> = visible.iter().chain(hidden).copied().collect();
    let whole = cells_of_points(&all, box_px, 1);
    let (columns, rows) = whole.size();
    let mut own = CellMask::empty(columns, rows);
    for (x, y) in visible {
        own.add((
            (x - left as f32) / (right - left) as f32,
            (y - top as f32) / (bottom - top) as f32,
        ));
    }
    let own = own.close_gaps();
    own.count() as f32 / own.union(&whole).count().max(1) as f32
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Returns the points every `step` pixels over columns and rows.
    fn grid(
        columns: std::ops::Range<u16>,
        rows: std::ops::Range<u16>,
        step: usize,
    ) -> Vec<(f32, f32)> {
        columns
            .step_by(step)
            .flat_map(|x| rows.clone().step_by(step).map(move |y| (f32::from(x), f32::from(y))))
            .collect()
    }

    proptest! {
        /// Whatever the spacing of points on an even surface, its mask has no holes and reaches
        /// little beyond them.
        #[test]
        fn mask_of_an_even_surface_has_no_holes(step in 1_usize..12, width in 60_u16..200, height in 60_u16..200) {
            let outline = Outline::from_points(&grid(40..40 + width, 50..50 + height, step), [40, 50, 40 + u32::from(width), 50 + u32::from(height)]);
            prop_assert!(outline.mask.share() > 0.85, "{:?}", outline.mask);
        }
    }

    #[test]
    fn shape_that_fills_little_of_its_box_has_a_fine_mask() {
        let l_shape = [grid(0..20, 0..200, 4), grid(0..200, 180..200, 4)].concat();
        let outline = Outline::from_points(&l_shape, [0, 0, 200, 200]);
        assert!((0.15..0.3).contains(&outline.mask.share()), "{}", outline.mask.share());
        assert!(!outline.mask.contains((0.6, 0.4)) && outline.mask.contains((0.04, 0.4)));
    }

    #[test]
    fn things_in_front_occlude_but_the_own_front_side_does_not() {
        let (front, back) = (grid(0..100, 0..100, 4), grid(2..98, 2..98, 8));
        assert!(unoccluded_share(&front, &back) > 0.95);
        let (left, right) = (grid(0..50, 0..100, 4), grid(50..100, 0..100, 8));
        assert!(
            (0.4..0.6).contains(&unoccluded_share(&left, &right)),
            "{}",
            unoccluded_share(&left, &right)
        );
        assert_eq!((unoccluded_share(&front, &[]), unoccluded_share(&[], &back)), (1.0, 0.0));
    }

    #[test]
    fn predicate_mask_is_sampled_by_cell() {
        let outline = Outline::from_predicate([100, 40, 300, 60], |(x, _)| x < 200.0);
        assert_eq!((outline.mask.size(), outline.mask.share()), ((64, 20), 0.5));
        assert_eq!(outline.covered_px(), 2000.0);
    }
}
