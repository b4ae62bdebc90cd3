//! Renders `index.html` of `uniground import --report`.

use camino::Utf8Path;
use image::RgbImage;
use image::imageops::{FilterType, replace, resize};
use std::fmt::Write;
use uniground_core::scene::FrameRef;
use uniground_evaluation::report::escape_html;

const STYLE: &str = "body{font:15px/1.5 system-ui,sans-serif;max-width:1060px;margin:2rem auto;padding:0 1rem;color:#222}\
td{padding:.2rem .8rem;border-bottom:1px solid #ddd;vertical-align:top}img{max-width:100%;border:1px solid #ddd}\
.warning td{background:#fff4d6}";

/// Layout of the contact sheet: number of frames, columns, and width of a frame in pixels.
const FRAMES: usize = 12;
const COLUMNS: u32 = 4;
const WIDTH: u32 = 256;

/// Renders the page. Pictures are links to `<name>.jpg` beside it.
pub(super) fn render(
    scan: &Utf8Path,
    lines: &[(&str, String)],
    pictures: &[(&str, &str)],
) -> String {
    let mut page = format!(
        "<!doctype html><html lang=\"en\"><meta charset=\"utf-8\"><title>{0}</title><style>{STYLE}</style><h1>{0}</h1><table>",
        escape_html(scan.file_name().unwrap_or(scan.as_str()))
    );
    for (what, value) in lines {
        let class = if *what == "warning" { " class=\"warning\"" } else { "" };
        let _ = write!(page, "<tr{class}><td>{what}<td>{}</tr>", escape_html(value));
    }
    page.push_str("</table>");
    for (name, title) in pictures {
        let _ = write!(page, "<h2>{title}</h2><img src=\"{name}.jpg\" alt=\"\">");
    }
    page.push_str("</html>\n");
    page
}

/// Renders a few frames spread over the scan. Frames that cannot be decoded stay white.
pub(super) fn contact_sheet(frames: &[FrameRef]) -> Option<RgbImage> {
    let first = frames.first()?.color_intrinsics;
    let height = (WIDTH * first.height / first.width.max(1)).clamp(1, 4 * WIDTH);
    let shown = FRAMES.min(frames.len());
    let rows = (shown as u32).div_ceil(COLUMNS);
    let mut sheet = RgbImage::from_pixel(
        WIDTH * COLUMNS.min(shown as u32),
        height * rows,
        image::Rgb([255; 3]),
    );
    for k in 0..shown {
        let frame = &frames[frames.len() * (2 * k + 1) / (2 * shown)];
        let Ok(picture) = frame.decode_color() else { continue };
        let (column, row) = (k as u32 % COLUMNS, k as u32 / COLUMNS);
        replace(
            &mut sheet,
            &resize(&picture, WIDTH, height, FilterType::Triangle),
            i64::from(column * WIDTH),
            i64::from(row * height),
        );
    }
    Some(sheet)
}
