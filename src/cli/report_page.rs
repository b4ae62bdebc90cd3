//! Renders `index.html` of `uniground parse --report`, which shows the result of every stage.

use camino::Utf8Path;
use std::fmt::Write;
use uniground_core::parsing::report_pictures::ReportPicture;
use uniground_core::scene::{ImportReport, ParsedScene};
use uniground_evaluation::report::escape_html;

const STYLE: &str = "body{font:15px/1.5 system-ui,sans-serif;max-width:1060px;margin:2rem auto;padding:0 1rem;color:#222}\
table{border-collapse:collapse}td,th{padding:.2rem .8rem;border-bottom:1px solid #ddd;text-align:left}td.n{text-align:right}\
img{max-width:100%;border:1px solid #ddd}figure{margin:1.5rem 0}.warning{background:#fff4d6;padding:.3rem .8rem;margin:.3rem 0}";

/// Renders the page. Pictures are links to `<name>.jpg` beside it.
pub(super) fn render(
    scan: &Utf8Path,
    import: &ImportReport,
    scene: &ParsedScene,
    pictures: &[ReportPicture],
) -> String {
    let report = &scene.report;
    let mut page = format!(
        "<!doctype html><html lang=\"en\"><meta charset=\"utf-8\"><title>{0}</title><style>{STYLE}</style><h1>{0}</h1>",
        escape_html(scan.file_name().unwrap_or(scan.as_str()))
    );
    let _ = write!(
        page,
        "<p>{} points, {} of {} frames used, {} superpoints, {} instances ({} structural), \
         {} parts and wholes, {} without a view; dropped {} regions that no mask supports and {} \
         specks. Read as {}, up was {}, poses {:?}.</p>",
        report.points,
        report.frames_used,
        import.frames,
        report.superpoints,
        report.instances,
        report.structural,
        report.parts_and_wholes,
        report.without_views,
        report.dropped,
        report.specks,
        escape_html(&import.format),
        import.up.name(),
        import.pose
    );
    for warning in import.warnings.iter().chain(&report.warnings) {
        let _ = write!(page, "<p class=\"warning\">{}</p>", escape_html(warning));
    }
    page.push_str("<h2>Stages</h2><table><tr><th>stage<th>seconds<th>peak memory<th>output</tr>");
    for stage in &report.stages {
        let memory = stage.peak_memory_mb.map_or_else(|| "-".to_owned(), |mb| format!("{mb} MB"));
        let name = escape_html(&stage.stage);
        let _ = write!(
            page,
            "<tr><td>{name}<td class=\"n\">{:.2}<td class=\"n\">{memory}<td class=\"n\">{}</tr>",
            stage.seconds, stage.produced
        );
        for time in &stage.models {
            let _ = write!(page, "<tr><td colspan=\"4\">{time}</tr>");
        }
    }
    page.push_str("</table><h2>Pictures</h2>");
    for picture in pictures {
        let _ = write!(
            page,
            "<figure><img src=\"{}.jpg\" alt=\"\"><figcaption>{}</figcaption></figure>",
            picture.name,
            escape_html(&picture.title)
        );
    }
    page.push_str(
        "<h2>Instances</h2><table><tr><th>id<th>level<th>name<th>center, m<th>size, m<th>points\
         <th>rests on</tr>",
    );
    for instance in &scene.instances {
        let triple = |v: [f32; 3]| format!("{:.2} {:.2} {:.2}", v[0], v[1], v[2]);
        let _ = write!(
            page,
            "<tr><td class=\"n\">{}<td>{}<td>{}<td>{}<td>{}<td class=\"n\">{}<td>{}</tr>",
            instance.id,
            instance.level.as_str(),
            escape_html(instance.label()),
            triple(instance.aabb.center.into()),
            triple(instance.aabb.size.into()),
            instance.point_count,
            instance.support
        );
    }
    page.push_str("</table></html>\n");
    page
}
