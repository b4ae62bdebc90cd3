//! Writes the report as a single self-contained page: tables, charts, and every failure with its
//! picture.

use super::charts::{self, Line};
use super::markdown::interval;
use super::{CellReport, Report, escape_html};
use crate::measures::Figures;
use crate::pictures;
use crate::scoring::ScoredExpression;
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use camino::Utf8Path;
use std::collections::BTreeMap;
use std::fmt::Write;
use std::fs;
use uniground_grounding::Status;

const STYLE: &str = "body{font:15px/1.5 system-ui,sans-serif;max-width:1400px;margin:2rem auto;padding:0 1rem;color:#222}\
table{border-collapse:collapse;margin:1rem 0;font-size:14px}td,th{padding:.2rem .6rem;border-bottom:1px solid #ddd;text-align:right;white-space:nowrap}th{white-space:normal}\
td:first-child,th:first-child{text-align:left}figure{display:inline-block;margin:.5rem 1.5rem .5rem 0}figcaption{font-weight:600}\
svg text{font-size:11px;fill:#444}.note{background:#fff4d6;padding:.3rem .8rem;margin:.4rem 0}\
.failure{display:grid;grid-template-columns:minmax(0,460px) 1fr;gap:1rem;border-top:1px solid #ddd;padding:1rem 0}\
.failure img{width:100%;border:1px solid #ddd}.failure p{margin:.2rem 0}.q{font-weight:600}.id{color:#777;font-size:13px}\
summary{cursor:pointer;font-weight:600;margin:1rem 0}";

/// Returns the whole page.
pub(super) fn render_page(report: &Report, folder: &Utf8Path, embedded: usize) -> String {
    let run = &report.run;
    let mut page = format!(
        "<!doctype html><html lang=\"en\"><meta charset=\"utf-8\"><title>{0}</title><style>{STYLE}</style><h1>{0}</h1>",
        escape_html(&report.suite)
    );
    let _ = write!(
        page,
        "<p>{} expressions in {} scenes; uniground {} {}, {}, {}, {}. Intervals are 95 % bootstrap.</p>",
        report.expressions,
        report.scenes,
        escape_html(&run.version),
        escape_html(run.label.as_deref().unwrap_or("")),
        escape_html(&run.system),
        escape_html(&run.machine),
        escape_html(&run.written_at)
    );
    if run.paper_compatible {
        page.push_str("<p class=\"note\">Paper-compatible: annotated target classes and anchors were handed over. Not leak-free.</p>");
    }
    if !report.omissions.is_empty() {
        let _ = write!(
            page,
            "<details><summary>{} left out of the suite</summary><ul>",
            report.omissions.len()
        );
        for omission in &report.omissions {
            let _ = write!(page, "<li>{}", escape_html(&omission.to_string()));
        }
        page.push_str("</ul></details>");
    }
    let rows = report.cells.iter().map(|cell| (cell.name.as_str(), &cell.figures));
    page.push_str(&table(rows, true));
    page.push_str(&cost_charts(report));
    for cell in &report.cells {
        page.push_str(&render_section(cell, folder, embedded));
    }
    page.push_str("</html>\n");
    page
}

fn render_section(cell: &CellReport, folder: &Utf8Path, embedded: usize) -> String {
    let mut html = format!("<h2>{}</h2>", escape_html(&cell.name));
    for note in &cell.notes {
        let _ = write!(html, "<p class=\"note\">{}</p>", escape_html(note));
    }
    if let Some(models) = &cell.models {
        let _ = write!(
            html,
            "<p>Masks {}, encoder {}, reasoner {}.</p>",
            escape_html(&models.masks),
            escape_html(&models.encoder),
            escape_html(&models.reasoner)
        );
    }
    let mut reasons: BTreeMap<&str, usize> = BTreeMap::new();
    cell.left_out.iter().for_each(|left| *reasons.entry(&left.reason).or_default() += 1);
    for (reason, count) in reasons {
        let _ = write!(
            html,
            "<p class=\"note\">{count} expressions left out: {}</p>",
            escape_html(reason)
        );
    }
    let scenes = cell.by_scene.iter().filter(|_| cell.by_scene.len() > 1);
    html.push_str(&table(
        cell.splits.iter().chain(scenes).map(|(name, f)| (name.as_str(), f)),
        false,
    ));
    if let Some(oriented) = cell.figures.oriented {
        let _ = write!(
            html,
            "<p>9-DoF, {} targets with an oriented box: mean IoU {:.3}, Acc@.25 {:.1} %, Acc@.5 {:.1} %.</p>",
            oriented.targets,
            oriented.mean_iou,
            oriented.accuracy[0] * 100.0,
            oriented.accuracy[1] * 100.0
        );
    }
    if let Some(reliability) = &cell.figures.reliability {
        let _ = write!(html, "<p>Confidence: {reliability}</p>");
    }
    html.push_str(&charts::histogram(
        "Targets by IoU of the answer",
        "IoU",
        &cell.figures.iou_histogram,
    ));
    let curve = |name: &str, recall: &[[f32; 2]], i: usize| Line {
        name: name.to_owned(),
        points: recall.iter().enumerate().map(|(k, r)| ((k + 1) as f32, r[i])).collect(),
    };
    let curves = [
        curve("candidates, IoU .25", &cell.figures.recall_at, 0),
        curve("candidates, IoU .5", &cell.figures.recall_at, 1),
        curve("shortlist, .25", &cell.figures.shortlist_recall_at, 0),
        curve("shortlist, .5", &cell.figures.shortlist_recall_at, 1),
    ];
    html.push_str(&charts::line_chart("Recall at k", "k", &curves, Some(1.0)));
    let failures: Vec<&ScoredExpression> = cell.failures().collect();
    let _ = write!(
        html,
        "<details><summary>{} of {} wrong</summary><p>Truth green, answer red, other candidates blue.</p>",
        failures.len(),
        cell.outcomes.len()
    );
    for (i, outcome) in failures.into_iter().enumerate() {
        html.push_str(&render_failure(outcome, folder, i < embedded));
    }
    html.push_str("</details>");
    html
}

fn render_failure(outcome: &ScoredExpression, folder: &Utf8Path, embed: bool) -> String {
    let mut html = String::from("<div class=\"failure\"><div>");
    if let Some(name) = &outcome.picture {
        let link = format!("{}/{name}", pictures::FOLDER);
        let source = match fs::read(folder.join(&link)) {
            Ok(jpeg) if embed => format!("data:image/jpeg;base64,{}", STANDARD.encode(jpeg)),
            _ => link,
        };
        let _ = write!(html, "<img loading=\"lazy\" alt=\"\" src=\"{source}\">");
    }
    let _ = write!(
        html,
        "</div><div><p class=\"q\">{}</p><p class=\"id\">{} &middot; {}</p>",
        escape_html(&outcome.query),
        escape_html(&outcome.id),
        escape_html(&outcome.splits.join(", "))
    );
    match &outcome.target {
        Some(target) => {
            let best = target.candidate_ious.iter().copied().fold(0.0, f32::max);
            let _ = write!(
                html,
                "<p>Truth: {}. IoU of the answer {:.2}, of the best candidate {best:.2}, of the best instance {:.2}.</p>",
                escape_html(target.name.as_deref().unwrap_or("a box")),
                target.iou,
                target.best_instance_iou
            );
        }
        None => html.push_str("<p>Truth: no such object in the room.</p>"),
    }
    if let Some(error) = &outcome.error {
        let _ = write!(html, "<p>Failed: {}</p>", escape_html(error));
    }
    if let Some(reply) = &outcome.reply {
        let status = match reply.status {
            Status::Grounded => "grounded",
            Status::Uncertain => "uncertain",
            Status::Ambiguous => "ambiguous",
            Status::NoMatch => "no match",
        };
        let _ = write!(
            html,
            "<p>Reply: {status}, confidence {:.2}. {}</p>",
            reply.confidence,
            escape_html(&reply.answer.explanation)
        );
        let candidates: Vec<String> = reply
            .candidates
            .iter()
            .map(|c| {
                format!(
                    "{} {} ({:.2})",
                    c.id,
                    reply.answer.candidate_names.get(&c.id.0).map_or("", String::as_str),
                    c.score
                )
            })
            .collect();
        let _ = write!(html, "<p>Candidates: {}</p>", escape_html(&candidates.join(", ")));
    }
    html.push_str("</div></div>");
    html
}

/// Returns charts of latency and tokens over `top_k`, if a run varies it.
fn cost_charts(report: &Report) -> String {
    let mut latency: BTreeMap<String, Vec<(f32, f32)>> = BTreeMap::new();
    let mut tokens = latency.clone();
    for cell in &report.cells {
        let k = cell.configuration.top_k;
        // Cells that differ only in top_k form one line.
        let name = cell
            .name
            .split(", ")
            .filter(|part| !part.starts_with("top_k="))
            .collect::<Vec<_>>()
            .join(", ");
        let ms = cell.figures.latency_ms.map_or(0.0, |l| l.p50 as f32);
        latency.entry(name.clone()).or_default().push((k as f32, ms));
        tokens
            .entry(name)
            .or_default()
            .push((k as f32, cell.figures.prompt_tokens + cell.figures.completion_tokens));
    }
    latency
        .values_mut()
        .chain(tokens.values_mut())
        .for_each(|points| points.sort_by(|a, b| a.0.total_cmp(&b.0)));
    if !latency.values().any(|points| points.len() > 1) {
        return String::new();
    }
    let chart = |title: &str, lines: BTreeMap<String, Vec<(f32, f32)>>| {
        let lines: Vec<Line> =
            lines.into_iter().map(|(name, points)| Line { name, points }).collect();
        charts::line_chart(title, "top_k", &lines, None)
    };
    chart("Median latency, ms", latency) + &chart("Tokens per question", tokens)
}

fn table<'a>(rows: impl Iterator<Item = (&'a str, &'a Figures)>, whole: bool) -> String {
    let more = if whole {
        "<th>ambiguous<th>failed<th>ms p50<th>p95<th>p99<th>calls<th>tokens<th>USD"
    } else {
        ""
    };
    let mut html = format!(
        "<table><tr><th><th>n<th>Acc@.25<th>Acc@.5<th>filtered .25<th>.5<th>mean IoU<th>first .25<th>recall@k .25<th>.5<th>any instance .25\
         <th>absent told<th>no_match right<th>denied{more}</tr>"
    );
    let percent =
        |share: Option<f32>| share.map_or_else(|| "-".to_owned(), |v| format!("{:.1}", v * 100.0));
    for (name, f) in rows {
        let targets = f.complete[0].of > 0;
        let recall = f.recall_at.last().filter(|_| targets);
        let _ = write!(
            html,
            "<tr><td>{}<td>{}<td>{}<td>{}<td>{}<td>{}<td>{}<td>{}<td>{}<td>{}<td>{}<td>{}<td>{}<td>{}",
            escape_html(name),
            f.expressions,
            interval(&f.complete[0]),
            interval(&f.complete[1]),
            interval(&f.filtered[0]),
            interval(&f.filtered[1]),
            if targets { format!("{:.3}", f.mean_iou) } else { "-".into() },
            percent(f.recall_at.first().filter(|_| targets).map(|r| r[0])),
            percent(recall.map(|r| r[0])),
            percent(recall.map(|r| r[1])),
            percent(targets.then_some(f.any_instance[0])),
            percent(f.abstention.recall),
            percent(f.abstention.precision),
            percent(f.abstention.denied)
        );
        if whole {
            let ms = f.latency_ms.map_or_else(
                || "<td>-<td>-<td>-".into(),
                |l| format!("<td>{:.2}<td>{:.2}<td>{:.2}", l.p50, l.p95, l.p99),
            );
            let tokens = f.prompt_tokens + f.completion_tokens;
            let _ = write!(
                html,
                "<td>{}<td>{}{ms}<td>{:.2}<td>{tokens:.0}<td>{:.3}",
                f.ambiguous, f.failed, f.vlm_calls, f.cost_usd
            );
        }
        html.push_str("</tr>");
    }
    html.push_str("</table>");
    html
}
