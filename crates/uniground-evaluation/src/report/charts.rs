//! Small charts as inline SVG.

use std::fmt::Write;

const WIDTH: f32 = 420.0;
const HEIGHT: f32 = 220.0;
const LEFT: f32 = 46.0;
const BOTTOM: f32 = 34.0;
const TOP: f32 = 14.0;
const COLOURS: [&str; 6] = ["#2a6fbb", "#c0392b", "#2c8a4b", "#8e5bb5", "#c77f1b", "#4a4a4a"];

/// One line of a chart.
pub(super) struct Line {
    pub name: String,
    pub points: Vec<(f32, f32)>,
}

/// Draws lines over a common X axis. Y starts at zero and ends at `top`, or slightly above the
/// highest point.
pub(super) fn lines(title: &str, x_label: &str, lines: &[Line], top: Option<f32>) -> String {
    let points = || lines.iter().flat_map(|line| &line.points);
    let highest = points().map(|p| p.1).fold(0.0, f32::max);
    let top = top.unwrap_or(highest * 1.1).max(f32::MIN_POSITIVE);
    let (first, last) =
        points().fold((f32::INFINITY, f32::NEG_INFINITY), |(lo, hi), p| (lo.min(p.0), hi.max(p.0)));
    let x_of = |x: f32| {
        LEFT + if last > first { (x - first) / (last - first) * (WIDTH - LEFT - 10.0) } else { 0.0 }
    };
    let y_of = |y: f32| HEIGHT - BOTTOM - y / top * (HEIGHT - BOTTOM - TOP);
    let mut svg = frame(title, x_label, top, &y_of);
    let mut ticks: Vec<f32> = points().map(|p| p.0).collect();
    ticks.sort_by(f32::total_cmp);
    ticks.dedup();
    let step = ticks.len().div_ceil(10).max(1);
    for x in ticks.iter().step_by(step) {
        let _ = write!(
            svg,
            "<text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{x}</text>",
            x_of(*x),
            HEIGHT - BOTTOM + 14.0
        );
    }
    for (i, line) in lines.iter().enumerate() {
        let color = COLOURS[i % COLOURS.len()];
        let path: String =
            line.points.iter().map(|(x, y)| format!("{:.1},{:.1} ", x_of(*x), y_of(*y))).collect();
        let _ = write!(
            svg,
            "<polyline fill=\"none\" stroke=\"{color}\" stroke-width=\"2\" points=\"{path}\"/>"
        );
        for (x, y) in &line.points {
            let _ = write!(
                svg,
                "<circle cx=\"{:.1}\" cy=\"{:.1}\" r=\"2.5\" fill=\"{color}\"/>",
                x_of(*x),
                y_of(*y)
            );
        }
        // Curves rise to the right, so the legend is placed where they seldom are.
        let y = HEIGHT - BOTTOM - 8.0 - 14.0 * (lines.len() - 1 - i) as f32;
        let name = super::escaped(&line.name);
        let _ = write!(
            svg,
            "<text x=\"{:.1}\" y=\"{y:.1}\" text-anchor=\"end\" style=\"fill:{color}\">{name}</text>",
            WIDTH - 10.0
        );
    }
    svg.push_str("</svg></figure>");
    svg
}

/// Draws bars of equal width over `0..=1`.
pub(super) fn histogram(title: &str, x_label: &str, counts: &[usize]) -> String {
    let top = counts.iter().copied().max().unwrap_or(0).max(1) as f32;
    let y_of = |y: f32| HEIGHT - BOTTOM - y / top * (HEIGHT - BOTTOM - TOP);
    let mut svg = frame(title, x_label, top, &y_of);
    let width = (WIDTH - LEFT - 10.0) / counts.len().max(1) as f32;
    for (i, &count) in counts.iter().enumerate() {
        let (x, y) = (LEFT + width * i as f32, y_of(count as f32));
        let height = HEIGHT - BOTTOM - y;
        let color = COLOURS[0];
        let _ = write!(
            svg,
            "<rect x=\"{x:.1}\" y=\"{y:.1}\" width=\"{:.1}\" height=\"{height:.1}\" fill=\"{color}\"><title>{count}</title></rect>",
            width - 1.0
        );
    }
    for tick in 0..=4_u8 {
        let at = f32::from(tick) / 4.0;
        let x = LEFT + at * (WIDTH - LEFT - 10.0);
        let _ = write!(
            svg,
            "<text x=\"{x:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{at}</text>",
            HEIGHT - BOTTOM + 14.0
        );
    }
    svg.push_str("</svg></figure>");
    svg
}

fn frame(title: &str, x_label: &str, top: f32, y_of: &dyn Fn(f32) -> f32) -> String {
    let mut svg = format!(
        "<figure><figcaption>{title}</figcaption><svg viewBox=\"0 0 {WIDTH} {HEIGHT}\" width=\"{WIDTH}\" role=\"img\">"
    );
    for part in 0..=4_u8 {
        let value = top * f32::from(part) / 4.0;
        let y = y_of(value);
        let _ = write!(
            svg,
            "<line x1=\"{LEFT}\" x2=\"{:.1}\" y1=\"{y:.1}\" y2=\"{y:.1}\" stroke=\"#ddd\"/><text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"end\">{}</text>",
            WIDTH - 10.0,
            LEFT - 6.0,
            y + 4.0,
            short(value)
        );
    }
    let _ = write!(
        svg,
        "<text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{x_label}</text>",
        f32::midpoint(WIDTH, LEFT),
        HEIGHT - 4.0
    );
    svg
}

fn short(value: f32) -> String {
    if value >= 1000.0 {
        format!("{:.1}k", value / 1000.0)
    } else if value >= 10.0 {
        format!("{value:.0}")
    } else {
        format!("{value:.2}")
    }
}
