//! Coarse masks: which cells of a view's box show the instance.

use super::ViewMask;

/// The cells of a box that belong to an object: a grid of at most [`CellMask::MAX_CELLS`] cells
/// each way.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CellMask {
    columns: u32,
    /// Top row first; bit `c` is column `c`.
    rows: Vec<u64>,
}

impl CellMask {
    /// Maximum number of columns and of rows.
    pub const MAX_CELLS: u32 = 64;

    /// Creates an empty mask. Sizes are clamped to `1..=`[`Self::MAX_CELLS`].
    #[must_use]
    pub fn empty(columns: u32, rows: u32) -> Self {
        let side = |count: u32| count.clamp(1, Self::MAX_CELLS);
        Self { columns: side(columns), rows: vec![0; side(rows) as usize] }
    }

    /// Creates a mask of the cells (column, row) for which `inside` is true.
    #[must_use]
    pub fn from_fn(columns: u32, rows: u32, inside: impl Fn(u32, u32) -> bool) -> Self {
        let mut mask = Self::empty(columns, rows);
        for (row, bits) in (0..).zip(&mut mask.rows) {
            *bits = (0..mask.columns)
                .filter(|&column| inside(column, row))
                .fold(0, |bits, column| bits | 1 << column);
        }
        mask
    }

    /// Returns the number of columns and rows.
    #[must_use]
    pub fn size(&self) -> (u32, u32) {
        (self.columns, self.rows.len() as u32)
    }

    /// Adds the cell that contains a position, given as shares of the box.
    pub fn add(&mut self, (x, y): (f32, f32)) {
        let (columns, rows) = self.size();
        let cell = |share: f32, count: u32| ((share * count as f32).max(0.0) as u32).min(count - 1);
        self.rows[cell(y, rows) as usize] |= 1 << cell(x, columns);
    }

    /// Returns whether a cell belongs to the mask.
    #[must_use]
    pub fn is_set(&self, column: u32, row: u32) -> bool {
        column < self.columns
            && self.rows.get(row as usize).is_some_and(|bits| bits >> column & 1 == 1)
    }

    /// Returns the number of cells in the mask.
    #[must_use]
    pub fn count(&self) -> u32 {
        self.rows.iter().map(|bits| bits.count_ones()).sum()
    }

    /// Returns the share of the box that the mask covers, `0..=1`.
    #[must_use]
    pub fn share(&self) -> f32 {
        self.count() as f32 / (self.columns * self.rows.len() as u32) as f32
    }

    /// Returns the union of both masks; `other` must have the same size.
    #[must_use]
    pub fn union(&self, other: &Self) -> Self {
        Self {
            columns: self.columns,
            rows: self.rows.iter().zip(&other.rows).map(|(a, b)| a | b).collect(),
        }
    }

    /// Returns whether a position, given as shares of the box, belongs to the mask. Interpolates
    /// the nearest cells, so that the outline has no steps.
    #[must_use]
    pub fn contains(&self, (x, y): (f32, f32)) -> bool {
        let (columns, rows) = self.size();
        let (x, y) = (x * columns as f32 - 0.5, y * rows as f32 - 0.5);
        let (left, top) = (x.floor(), y.floor());
        let (right_share, low_share) = (x - left, y - top);
        let at = |column: f32, row: f32| {
            let known = column >= 0.0 && row >= 0.0 && self.is_set(column as u32, row as u32);
            f32::from(u8::from(known))
        };
        let upper = at(left, top) * (1.0 - right_share) + at(left + 1.0, top) * right_share;
        let lower =
            at(left, top + 1.0) * (1.0 - right_share) + at(left + 1.0, top + 1.0) * right_share;
        upper * (1.0 - low_share) + lower * low_share >= 0.5
    }

    /// Closes gaps of one or two cells: grows the mask by one cell on all sides, then shrinks it
    /// again.
    #[must_use]
    pub fn close_gaps(&self) -> Self {
        let all = self.full_row();
        let grown = Self { columns: self.columns, rows: grow(&self.rows, all) };
        // The mask does not shrink at the border of the box.
        let outside: Vec<u64> = grown.rows.iter().map(|bits| !bits & all).collect();
        let rows = grow(&outside, all)
            .iter()
            .zip(&self.rows)
            .map(|(bits, own)| !bits & all | own)
            .collect();
        Self { columns: self.columns, rows }
    }

    /// Fills holes: cells that cannot be reached from the border of the box.
    #[must_use]
    pub fn fill_holes(&self) -> Self {
        let all = self.full_row();
        let free: Vec<u64> = self.rows.iter().map(|bits| !bits & all).collect();
        let last = self.rows.len() - 1;
        let rim =
            |row: usize| if row == 0 || row == last { all } else { 1 | 1 << (self.columns - 1) };
        let reached =
            flood(free.iter().enumerate().map(|(row, bits)| bits & rim(row)).collect(), &free);
        Self { columns: self.columns, rows: reached.iter().map(|bits| !bits & all).collect() }
    }

    /// Returns the mask without pieces that have less than this share of the cells.
    #[must_use]
    pub fn without_small_pieces(&self, least: f32) -> Self {
        let least = self.count() as f32 * least;
        let mut left = self.rows.clone();
        let mut rows = vec![0; left.len()];
        while let Some(row) = left.iter().position(|bits| *bits != 0) {
            let mut seed = vec![0; left.len()];
            seed[row] = 1 << left[row].trailing_zeros();
            let piece = flood(seed, &left);
            let keeps = piece.iter().map(|bits| bits.count_ones()).sum::<u32>() as f32 >= least;
            for ((piece, left), kept) in piece.iter().zip(&mut left).zip(&mut rows) {
                *left &= !piece;
                *kept |= if keeps { *piece } else { 0 };
            }
        }
        Self { columns: self.columns, rows }
    }

    /// Serializes the mask as a string.
    #[must_use]
    pub fn to_view_mask(&self) -> ViewMask {
        let (columns, rows) = self.size();
        // Runs go down the columns and begin with cells outside the mask.
        let cells: Vec<bool> = (0..columns)
            .flat_map(|column| (0..rows).map(move |row| self.is_set(column, row)))
            .collect();
        let mut runs: Vec<i32> =
            cells.chunk_by(|a, b| a == b).map(|run| run.len() as i32).collect();
        if cells[0] {
            runs.insert(0, 0);
        }
        let mut counts = String::with_capacity(runs.len());
        for (i, &run) in runs.iter().enumerate() {
            let mut rest = if i > RAW_RUNS { run - runs[i - 2] } else { run };
            loop {
                let digit = rest & DIGIT;
                rest >>= DIGIT_BITS;
                let more = if digit & SIGN != 0 { rest != -1 } else { rest != 0 };
                counts.push(char::from(FIRST_CHAR + (digit | if more { MORE } else { 0 }) as u8));
                if !more {
                    break;
                }
            }
        }
        ViewMask { size: [rows, columns], counts }
    }

    /// Reads the output of [`to_view_mask`](Self::to_view_mask). Returns `None` for anything else.
    #[must_use]
    pub fn from_view_mask(written: &ViewMask) -> Option<Self> {
        let ViewMask { size: [rows, columns], counts } = written;
        let sizes = 1..=Self::MAX_CELLS;
        if !sizes.contains(rows) || !sizes.contains(columns) {
            return None;
        }
        let mut runs: Vec<i32> = Vec::new();
        let (mut run, mut shift) = (0_i32, 0);
        for char in counts.bytes() {
            let digit = i32::from(char.checked_sub(FIRST_CHAR)?);
            run |= (digit & DIGIT).checked_shl(shift).filter(|_| shift <= MAX_SHIFT)?;
            shift += DIGIT_BITS;
            if digit & MORE == 0 {
                run |= if digit & SIGN != 0 { -1 << shift } else { 0 };
                let i = runs.len();
                runs.push(run.checked_add(if i > RAW_RUNS { runs[i - 2] } else { 0 })?);
                (run, shift) = (0, 0);
            }
        }
        let total: i64 = runs.iter().map(|run| i64::from(*run)).sum();
        if total != i64::from(rows * columns) || runs.iter().any(|run| *run < 0) {
            return None;
        }
        let inside = [false, true].into_iter().cycle();
        let cells: Vec<bool> = runs
            .iter()
            .zip(inside)
            .flat_map(|(run, inside)| std::iter::repeat_n(inside, *run as usize))
            .collect();
        Some(Self::from_fn(*columns, *rows, |column, row| cells[(column * rows + row) as usize]))
    }

    /// Returns the bits of a full row.
    fn full_row(&self) -> u64 {
        u64::MAX >> (Self::MAX_CELLS - self.columns)
    }
}

// The characters of COCO run-length strings: five bits each. A sixth bit is set if more characters
// of the same run follow. Runs are stored as the difference to the run before the previous one.
const FIRST_CHAR: u8 = b'0';
const DIGIT_BITS: u32 = 5;
const DIGIT: i32 = 0x1f;
const SIGN: i32 = 0x10;
const MORE: i32 = 0x20;
/// Index of the last run that is written without a difference.
const RAW_RUNS: usize = 2;
/// A run of all cells takes three characters.
const MAX_SHIFT: u32 = 3 * DIGIT_BITS;

/// Returns the cells of a piece and their eight neighbors, within `all`.
fn grow(rows: &[u64], all: u64) -> Vec<u64> {
    let wide: Vec<u64> = rows.iter().map(|bits| (bits | bits << 1 | bits >> 1) & all).collect();
    let at = |row: Option<usize>| row.and_then(|row| wide.get(row)).copied().unwrap_or(0);
    (0..wide.len()).map(|row| at(row.checked_sub(1)) | wide[row] | at(row.checked_add(1))).collect()
}

/// Returns the cells of `within` that are reachable from the seeds through their four neighbors.
fn flood(mut reached: Vec<u64>, within: &[u64]) -> Vec<u64> {
    loop {
        let mut grew = false;
        // Down and up again, so that most shapes take one or two rounds.
        for row in (0..reached.len()).chain((0..reached.len()).rev()) {
            let above = row.checked_sub(1).map_or(0, |above| reached[above]);
            let mut bits =
                (reached[row] | above | reached.get(row + 1).copied().unwrap_or(0)) & within[row];
            loop {
                let wider = (bits | bits << 1 | bits >> 1) & within[row];
                if wider == bits {
                    break;
                }
                bits = wider;
            }
            grew |= bits != reached[row];
            reached[row] = bits;
        }
        if !grew {
            return reached;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn parse_mask(rows: &[&str]) -> CellMask {
        CellMask::from_fn(rows[0].len() as u32, rows.len() as u32, |column, row| {
            rows[row as usize].as_bytes()[column as usize] == b'#'
        })
    }

    fn any_mask() -> impl Strategy<Value = CellMask> {
        let rows = prop::collection::vec(any::<u64>(), 1..=64);
        (1..=64_u32, rows, any::<u64>()).prop_map(|(columns, rows, thin)| {
            CellMask::from_fn(columns, rows.len() as u32, |column, row| {
                rows[row as usize] & thin.rotate_left(row) | thin >> 3 & 1 << column != 0
            })
        })
    }

    proptest! {
        #[test]
        fn serialized_masks_are_read_back_unchanged(mask in any_mask()) {
            prop_assert_eq!(CellMask::from_view_mask(&mask.to_view_mask()), Some(mask));
        }

        #[test]
        fn closing_gaps_and_filling_holes_remove_no_cells(mask in any_mask()) {
            let (closed, filled) = (mask.close_gaps(), mask.fill_holes());
            prop_assert_eq!(&closed.union(&mask), &closed);
            prop_assert_eq!(&filled.union(&mask), &filled);
            prop_assert_eq!(&filled.fill_holes(), &filled);
        }

        #[test]
        fn arbitrary_input_is_refused_or_read_with_its_stated_size(size in prop::array::uniform2(0..70_u32), counts in "[ -~]{0,40}") {
            if let Some(mask) = CellMask::from_view_mask(&ViewMask { size, counts }) {
                prop_assert_eq!([mask.size().1, mask.size().0], size);
            }
        }
    }

    /// COCO's own tools write a 4 x 5 mask of runs 5, 2, 2, 1, 4, 1, 5 as this string.
    #[test]
    fn strings_match_the_coco_encoding() {
        let mask = parse_mask(&[".....", ".##..", ".#.#.", "....."]);
        assert_eq!(mask.to_view_mask(), ViewMask { size: [4, 5], counts: "522O201".into() });
        assert_eq!(parse_mask(&["#"]).to_view_mask().counts, "01");
    }

    #[test]
    fn gaps_are_closed_holes_filled_and_small_pieces_removed() {
        assert_eq!(
            parse_mask(&["#.##", "#..#", "####"]).close_gaps(),
            parse_mask(&["####", "####", "####"])
        );
        assert_eq!(
            parse_mask(&["#####", "#...#", "#...#", "#...#", "##.##"]).close_gaps(),
            parse_mask(&["#####", "#...#", "#...#", "#...#", "#####"])
        );
        assert_eq!(
            parse_mask(&["#####", "#...#", "#...#", "#####"]).fill_holes(),
            parse_mask(&["#####"; 4])
        );
        assert_eq!(
            parse_mask(&["###", "#.#", "#.#"]).fill_holes(),
            parse_mask(&["###", "#.#", "#.#"]),
            "open at the bottom, so not a hole"
        );
        assert_eq!(
            parse_mask(&["###..", "###.#"]).without_small_pieces(0.2),
            parse_mask(&["###..", "###.."])
        );
    }

    #[test]
    fn the_outline_lies_halfway_between_cells() {
        let mask = parse_mask(&["##..", "##.."]);
        assert!(
            mask.contains((0.01, 0.5))
                && mask.contains((0.49, 0.5))
                && !mask.contains((0.51, 0.5))
                && !mask.contains((-0.1, 0.5))
        );
    }
}
