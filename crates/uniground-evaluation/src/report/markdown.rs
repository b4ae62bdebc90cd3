//! Writes the report as Markdown tables.

use super::{CellReport, Report};
use crate::measures::{Figures, Share};
use std::fmt::Write;

/// Maximum number of omissions that are listed.
const SHOWN_OMISSIONS: usize = 50;

// Writing to a String cannot fail.
pub(super) fn render_page(report: &Report) -> String {
    let mut page = String::new();
    let run = &report.run;
    let _ = writeln!(page, "# {}\n", report.suite);
    let label = run.label.as_ref().map_or_else(String::new, |label| format!(", {label}"));
    let _ = writeln!(
        page,
        "{} expressions in {} scenes; uniground {}{label}, {}, {}, {}.{}\n",
        report.expressions,
        report.scenes,
        run.version,
        run.system,
        run.machine,
        run.written_at,
        if run.paper_compatible { " **Paper-compatible: not leak-free.**" } else { "" }
    );
    page.push_str(&cells_table(report));
    for cell in &report.cells {
        let _ = writeln!(page, "\n## {}\n", cell.name);
        for note in &cell.notes {
            let _ = writeln!(page, "> {note}\n");
        }
        if !cell.left_out.is_empty() {
            let _ = writeln!(
                page,
                "{} expressions left out: {}\n",
                cell.left_out.len(),
                cell.left_out[0].reason
            );
        }
        page.push_str(&splits_table(cell));
    }
    if !report.omissions.is_empty() {
        let _ = writeln!(page, "\n## Left out of the suite: {}\n", report.omissions.len());
        for omission in report.omissions.iter().take(SHOWN_OMISSIONS) {
            let _ = writeln!(page, "- {omission}");
        }
        if report.omissions.len() > SHOWN_OMISSIONS {
            let _ = writeln!(
                page,
                "- and {} more, in report.json",
                report.omissions.len() - SHOWN_OMISSIONS
            );
        }
    }
    page
}

const HEAD: &str = "| | n | Acc@.25 | Acc@.5 | filtered .25 | .5 | mIoU | first .25 | recall@k .25 | any instance .25 | absent told | denied |";
const RULE: &str = "|---|---|---|---|---|---|---|---|---|---|---|---|";

/// Returns a table with one row per cell.
fn cells_table(report: &Report) -> String {
    let mut table = format!(
        "{HEAD} ambiguous | failed | ms p50 | p95 | calls | tokens | USD |\n{RULE}---|---|---|---|---|---|---|\n"
    );
    for cell in &report.cells {
        let f = &cell.figures;
        let (p50, p95) = f.latency_ms.map_or(("-".into(), "-".into()), |l| {
            (format!("{:.2}", l.p50), format!("{:.2}", l.p95))
        });
        let _ = writeln!(
            table,
            "{} {} | {} | {p50} | {p95} | {:.2} | {:.0} | {:.3} |",
            row(&cell.name, f),
            f.ambiguous,
            f.failed,
            f.vlm_calls,
            f.prompt_tokens + f.completion_tokens,
            f.cost_usd
        );
    }
    table
}

/// Returns a table with one row per split and scene.
fn splits_table(cell: &CellReport) -> String {
    let mut table = format!("{HEAD}\n{RULE}\n");
    for (name, figures) in
        cell.splits.iter().chain(cell.by_scene.iter().filter(|_| cell.by_scene.len() > 1))
    {
        let _ = writeln!(table, "{}", row(name, figures));
    }
    if let Some(oriented) = cell.figures.oriented {
        let _ = writeln!(
            table,
            "\n9-DoF, {} targets with an oriented box: mean IoU {:.3}, Acc@.25 {:.3}, Acc@.5 {:.3}.",
            oriented.targets, oriented.mean_iou, oriented.accuracy[0], oriented.accuracy[1]
        );
    }
    if let Some(reliability) = &cell.figures.reliability {
        let _ = writeln!(table, "\nConfidence: {reliability}");
    }
    table
}

fn row(name: &str, f: &Figures) -> String {
    let percent =
        |share: Option<f32>| share.map_or_else(|| "-".to_owned(), |v| format!("{:.1}", v * 100.0));
    let recall = f.recall_at.last().map(|r| r[0]);
    let has_targets = f.complete[0].of > 0;
    let [any, _] = f.any_instance;
    format!(
        "| {} | {} | {} | {} | {} | {} | {} | {} | {} | {} | {} | {} |",
        name.replace(['|', '\n', '<'], " "),
        f.expressions,
        interval(&f.complete[0]),
        interval(&f.complete[1]),
        interval(&f.filtered[0]),
        interval(&f.filtered[1]),
        if has_targets { format!("{:.3}", f.mean_iou) } else { "-".into() },
        percent(f.recall_at.first().filter(|_| has_targets).map(|r| r[0])),
        percent(recall.filter(|_| has_targets)),
        percent(has_targets.then_some(any)),
        percent(f.abstention.recall),
        percent(f.abstention.denied)
    )
}

/// Formats a share with its interval in percent: "60.0 (45-75)".
pub(super) fn interval(share: &Share) -> String {
    if share.of == 0 {
        return "-".into();
    }
    format!("{:.1} ({:.0}-{:.0})", share.value * 100.0, share.low * 100.0, share.high * 100.0)
}
