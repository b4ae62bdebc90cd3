//! Compares two runs of the same expressions: which answers changed, and whether a drop is
//! significant.

use super::digest;
use super::measures::confidence_interval;
use super::report::{CellReport, Report};
use super::scoring::ScoredExpression;
use super::segmentation::IOU_THRESHOLDS;
use anyhow::{Context, ensure};
use camino::Utf8Path;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::fmt::Write;
use std::fs;

const FORMAT: &str = "uniground-baseline/1";

/// The reference for later runs: which expressions were right, and the interval of the accuracy.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Baseline {
    pub format: String,
    pub suite: String,
    pub label: Option<String>,
    /// Cells by name.
    pub cells: BTreeMap<String, BaselineCell>,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct BaselineCell {
    /// Lower ends of the 95 % intervals of the share right at an IoU of 0.25 and 0.5, over all
    /// expressions.
    pub low: [f32; 2],
    /// By expression: right at 0.25, right at 0.5.
    pub right: BTreeMap<String, [bool; 2]>,
}

/// One cell before and after, over the expressions that both runs have.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct CellChange {
    pub cell: String,
    pub expressions: usize,
    /// Number of expressions that only one of the runs has.
    pub unpaired: usize,
    /// At an IoU of 0.25 and 0.5.
    pub thresholds: [Change; 2],
}

#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Change {
    pub before: f32,
    pub after: f32,
    /// 95 % interval of the paired difference.
    pub interval: (f32, f32),
    /// Lower end of the first run's own interval.
    pub low_before: f32,
    pub gained: Vec<String>,
    pub lost: Vec<String>,
}

impl Change {
    /// Returns whether the drop is significant: below the first run's interval, or with a paired
    /// difference that is negative over its whole interval.
    #[must_use]
    pub fn is_drop(&self) -> bool {
        self.after < self.low_before || self.interval.1 < 0.0
    }
}

/// Returns a key of an expression from its id and its text. Where ids are positions in a list, the
/// text shows whether it is still the same expression.
#[must_use]
pub fn expression_key(outcome: &ScoredExpression) -> String {
    format!("{}~{:.6}", outcome.id, digest::short_digest(outcome.query.as_bytes()))
}

impl Baseline {
    #[must_use]
    pub fn from_report(report: &Report) -> Self {
        let cells = report
            .cells
            .iter()
            .map(|cell| (cell.name.clone(), BaselineCell::from_report(cell, report.run.seed)))
            .collect();
        Self {
            format: FORMAT.into(),
            suite: report.suite.clone(),
            label: report.run.label.clone(),
            cells,
        }
    }

    /// Reads a baseline, or a report as a baseline.
    ///
    /// # Errors
    /// Returns an error for a file that is neither.
    pub fn read(path: &Utf8Path) -> anyhow::Result<Self> {
        if path.is_dir() {
            return Ok(Self::from_report(&Report::read(path)?));
        }
        let text = fs::read_to_string(path).with_context(|| path.to_string())?;
        if let Ok(report) = serde_json::from_str::<Report>(&text) {
            return Ok(Self::from_report(&report));
        }
        let baseline: Self = serde_json::from_str(&text).with_context(|| path.to_string())?;
        ensure!(
            baseline.format == FORMAT,
            "{path}: the format is {:?}, expected {FORMAT:?}",
            baseline.format
        );
        Ok(baseline)
    }

    /// # Errors
    /// Returns an error when the file cannot be written.
    pub fn write(&self, file: &Utf8Path) -> anyhow::Result<()> {
        let mut text = serde_json::to_string_pretty(self)?;
        text.push('\n');
        fs::write(file, text).with_context(|| file.to_string())
    }

    /// Returns the changes, cell by cell. The second list names cells that only one side has.
    #[must_use]
    pub fn compare_with(&self, after: &Self) -> (Vec<CellChange>, Vec<String>) {
        let changes = self
            .cells
            .iter()
            .filter_map(|(name, before)| Some(before.compare_with(name, after.cells.get(name)?)))
            .collect();
        let only = |a: &Self, b: &Self| {
            a.cells.keys().filter(|name| !b.cells.contains_key(*name)).cloned().collect::<Vec<_>>()
        };
        (changes, [only(self, after), only(after, self)].concat())
    }
}

impl BaselineCell {
    fn from_report(cell: &CellReport, seed: u64) -> Self {
        let right = |o: &ScoredExpression| IOU_THRESHOLDS.map(|at| o.is_right_at(at));
        let low = std::array::from_fn(|i| {
            let values: Vec<(&str, f32)> = cell
                .outcomes
                .iter()
                .map(|o| (o.scene.as_str(), f32::from(u8::from(right(o)[i]))))
                .collect();
            confidence_interval(&values, seed).0
        });
        Self { low, right: cell.outcomes.iter().map(|o| (expression_key(o), right(o))).collect() }
    }

    fn compare_with(&self, cell: &str, after: &Self) -> CellChange {
        let pairs: Vec<(&String, [bool; 2], [bool; 2])> = self
            .right
            .iter()
            .filter_map(|(id, before)| Some((id, *before, *after.right.get(id)?)))
            .collect();
        let n = pairs.len().max(1) as f32;
        let change = |i: usize| {
            let difference = |p: &(&String, [bool; 2], [bool; 2])| {
                f32::from(i8::from(p.2[i]) - i8::from(p.1[i]))
            };
            let named = |sign: f32| {
                pairs.iter().filter(|p| difference(p) == sign).map(|p| p.0.clone()).collect()
            };
            // Ids carry no scene here, so expressions are resampled individually.
            let differences: Vec<(&str, f32)> = pairs.iter().map(|p| ("", difference(p))).collect();
            Change {
                before: pairs.iter().filter(|p| p.1[i]).count() as f32 / n,
                after: pairs.iter().filter(|p| p.2[i]).count() as f32 / n,
                interval: confidence_interval(&differences, 0),
                low_before: self.low[i],
                gained: named(1.0),
                lost: named(-1.0),
            }
        };
        CellChange {
            cell: cell.to_owned(),
            expressions: pairs.len(),
            unpaired: self.right.len() + after.right.len() - 2 * pairs.len(),
            thresholds: [change(0), change(1)],
        }
    }
}

/// Formats changes as a table and lists. `name` returns the text of an expression.
#[must_use]
pub fn describe(changes: &[CellChange], name: impl Fn(&str) -> Option<String>) -> String {
    let mut text = String::from(
        "| cell | n | IoU | before | after | difference (95 %) | gained | lost |\n|---|---|---|---|---|---|---|---|\n",
    );
    for change in changes {
        for (threshold, c) in IOU_THRESHOLDS.iter().zip(&change.thresholds) {
            let _ = writeln!(
                text,
                "| {} | {} | {threshold} | {:.1} | {:.1} | {:+.1} ({:+.1} to {:+.1}){} | {} | {} |",
                change.cell,
                change.expressions,
                c.before * 100.0,
                c.after * 100.0,
                (c.after - c.before) * 100.0,
                c.interval.0 * 100.0,
                c.interval.1 * 100.0,
                if c.is_drop() { " **drop**" } else { "" },
                c.gained.len(),
                c.lost.len()
            );
        }
    }
    for change in changes {
        let [c, _] = &change.thresholds;
        for (word, ids) in [("gained", &c.gained), ("lost", &c.lost)] {
            for id in ids {
                let query = name(id).map_or_else(String::new, |query| format!(": {query}"));
                let _ = writeln!(text, "{word} in {}: {id}{query}", change.cell);
            }
        }
        if change.unpaired > 0 {
            let _ = writeln!(
                text,
                "{}: {} expressions are in one of the two only",
                change.cell, change.unpaired
            );
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cell(low: f32, right: &[bool]) -> BaselineCell {
        BaselineCell {
            low: [low; 2],
            right: right.iter().enumerate().map(|(i, r)| (format!("t{i:02}"), [*r; 2])).collect(),
        }
    }

    fn change(before: &BaselineCell, after: &BaselineCell) -> Change {
        before.compare_with("cell", after).thresholds[0].clone()
    }

    #[test]
    fn only_significant_losses_count_as_a_drop() {
        let all = cell(0.8, &[true; 40]);
        let mut one = [true; 40];
        one[3] = false;
        let lost_one = change(&all, &cell(0.8, &one));
        assert_eq!((lost_one.lost.as_slice(), lost_one.gained.len()), (&["t03".to_owned()][..], 0));
        assert!(!lost_one.is_drop(), "{lost_one:?}");
        let mut many = [true; 40];
        many[..7].fill(false);
        assert!(change(&all, &cell(0.8, &many)).is_drop());
        // Below the old interval, although the paired difference alone could be chance.
        assert!(change(&cell(0.99, &[true; 40]), &cell(0.8, &one)).is_drop());
        assert!(!change(&all, &all).is_drop());
    }

    #[test]
    fn unpaired_expressions_are_counted_but_not_compared() {
        let compared =
            cell(0.0, &[true, false]).compare_with("cell", &cell(0.0, &[true, true, false]));
        assert_eq!((compared.expressions, compared.unpaired), (2, 1));
        assert_eq!(compared.thresholds[0].gained, ["t01"]);
    }
}
