//! Lines of numbers: XYZ, PTS, TXT, CSV. The meaning of the columns comes from a heading, or from
//! the number of columns and their values.

use super::CloudBuilder;
use super::color_range::{ColorRange, channel_of_name};
use super::gathered::GREY;
use crate::IngestError;
use crate::limited_reader::{BYTE_ORDER_MARK, read_line};
use camino::Utf8Path;
use std::borrow::Cow;
use std::fs::File;
use std::io::{BufRead, BufReader};
use uniground_types::findings::{Finding, FindingSubject};

const MAX_LINE_BYTES: u64 = 4 << 10;
/// Number of lines that are used to detect the columns.
const LOOKED_AT: usize = 1000;
/// Maximum number of columns of a line that are examined.
const MAX_COLUMNS: usize = 32;
/// Maximum number of lines without three numbers: headings, a count and damaged lines.
const MAX_BROKEN: usize = 3;

#[derive(Debug, Clone, PartialEq)]
struct Columns {
    /// The columns of x, y and z.
    position: [usize; 3],
    /// The columns of red, green and blue, and the range of their first values.
    color: Option<([usize; 3], ColorRange)>,
    /// What was assumed.
    assumption: Option<Finding>,
    /// Number of points that the first line announces.
    announced: Option<usize>,
}

/// Returns whether a file begins with lines of at least three numbers, after at most a heading or a
/// count.
pub(super) fn can_read(head: &[u8]) -> bool {
    let end = head.iter().rposition(|b| *b == b'\n').map_or(head.len(), |at| at + 1);
    // Headings can be in any encoding.
    let text = String::from_utf8_lossy(&head[..end]);
    let mut lines = text.lines().filter(|line| !line.trim().is_empty()).take(12).peekable();
    if lines.peek().is_none() {
        return false;
    }
    let (mut rows, mut others) = (0, 0);
    for line in lines {
        match parse_numbers(line) {
            Some(values) if values.len() >= 3 => rows += 1,
            _ => others += 1,
        }
    }
    rows > 0 && others <= 3
}

/// Returns a line with points in place of decimal commas. A comma is one if semicolons, or spaces
/// around every number, separate the columns.
fn with_decimal_points(line: &str) -> Cow<'_, str> {
    let is_decimal = |word: &str| {
        word.split_once(',').is_some_and(|(whole, part)| {
            let digits = |text: &str| !text.is_empty() && text.bytes().all(|b| b.is_ascii_digit());
            digits(whole.trim_start_matches(['-', '+']))
                && part.starts_with(|c: char| c.is_ascii_digit())
                && !part.contains(',')
        })
    };
    if !line.contains(',') {
        return line.into();
    }
    let decimal = if line.contains(';') {
        line.split(';').map(str::trim).filter(|word| word.contains(',')).all(is_decimal)
    } else {
        line.split_ascii_whitespace().count() >= 3 && line.split_ascii_whitespace().all(is_decimal)
    };
    if decimal { line.replace(',', ".").into() } else { line.into() }
}

fn split_words(line: &str) -> impl Iterator<Item = &str> {
    line.split([' ', '\t', ',', ';', '\r'])
        .map(|word| word.trim_matches('"'))
        .filter(|word| !word.is_empty())
        .take(MAX_COLUMNS)
}

fn parse_numbers(line: &str) -> Option<Vec<f64>> {
    split_words(&with_decimal_points(line)).map(|word| word.parse().ok()).collect()
}

pub(super) fn read(
    root: &Utf8Path,
    file: &Utf8Path,
    mut gathered: CloudBuilder,
) -> Result<CloudBuilder, IngestError> {
    let malformed = |reason: String| IngestError::malformed(file, reason);
    let columns = detect_columns(root, file)?;
    gathered.set_has_color(columns.color.is_some());
    columns.color.iter().for_each(|(_, range)| gathered.set_color_range(*range));
    columns.assumption.iter().cloned().for_each(|assumption| gathered.add_finding(assumption));
    let mut source = open(root, file)?;
    let mut line = Vec::new();
    let (mut number, mut skipped, mut broken) = (0_usize, 0_usize, Vec::new());
    while read_line(&mut source, &mut line, MAX_LINE_BYTES)
        .map_err(|e| malformed(format!("line {}: {e}", number + 1)))?
    {
        number += 1;
        let mut values = [f64::NAN; MAX_COLUMNS];
        let text = String::from_utf8_lossy(line.strip_prefix(BYTE_ORDER_MARK).unwrap_or(&line));
        let text = with_decimal_points(&text);
        let (mut found, mut readable) = (0, true);
        for (value, word) in values.iter_mut().zip(split_words(&text)) {
            match word.parse() {
                Ok(v) => *value = v,
                Err(_) => readable = false,
            }
            found += 1;
        }
        if !readable || found < 3 {
            // Headings, counts and comments are no points.
            let is_broken = found > 0 && !text.trim_start().starts_with(['#', '/']);
            skipped += usize::from(is_broken);
            if is_broken && gathered.points_read() > 0 {
                broken.push(number);
            }
            if skipped > MAX_BROKEN {
                return Err(malformed(format!(
                    "line {number} does not have three or more numbers"
                )));
            }
            continue;
        }
        let position = columns.position.map(|i| values[i]);
        match columns.color {
            Some((at, _)) => gathered.push_channels(position, at.map(|i| values[i])),
            None => gathered.push(position, GREY),
        }
        if number.is_multiple_of(1 << 16) {
            gathered.thin_if_full(file)?;
        }
    }
    gathered.thin_if_full(file)?;
    let points = gathered.points_read();
    if let Some(announced) = columns.announced.filter(|announced| *announced != points) {
        let text = format!("its first line announces {announced} points, but it has {points}");
        gathered.add_finding(Finding::unusual(FindingSubject::Cloud, text));
    }
    if !broken.is_empty() {
        let text = format!("lines without three numbers are skipped: {broken:?}");
        let finding = Finding::left_out(FindingSubject::Cloud, text).counting(broken.len());
        gathered.add_finding(finding);
    }
    Ok(gathered)
}

fn open(root: &Utf8Path, file: &Utf8Path) -> Result<BufReader<File>, IngestError> {
    let source =
        File::open(root.join(file)).map_err(|source| IngestError::reading(file, source))?;
    Ok(BufReader::with_capacity(1 << 20, source))
}

fn detect_columns(root: &Utf8Path, file: &Utf8Path) -> Result<Columns, IngestError> {
    let mut source = open(root, file)?.take_lines();
    let (mut heading, mut announced, mut lines) = (None, None, 0);
    let mut rows: Vec<Vec<f64>> = Vec::new();
    while let Some(line) = source.next_line(file)? {
        lines += 1;
        if lines == 1 {
            announced = line.trim().parse().ok();
        }
        match parse_numbers(&line) {
            Some(values) if values.len() >= 3 => rows.push(values),
            _ if rows.is_empty() && heading.is_none() => heading = columns_from_heading(&line),
            _ => {}
        }
        if rows.len() == LOOKED_AT {
            break;
        }
    }
    if rows.is_empty() {
        return Err(IngestError::malformed(file, "it has no lines of three or more numbers"));
    }
    let range = |at: [usize; 3]| {
        let shares = rows
            .iter()
            .all(|row| at.iter().all(|i| row.get(*i).is_none_or(|v| (0.0..=1.0).contains(v))));
        if shares { ColorRange::Unit } else { ColorRange::Bytes }
    };
    if let Some((position, color)) = heading {
        return Ok(Columns {
            position,
            color: color.map(|at| (at, range(at))),
            assumption: None,
            announced,
        });
    }
    let count = rows.iter().map(Vec::len).min().unwrap_or(3);
    let is_color = |first: &usize| {
        let triples = || rows.iter().map(|row| [row[*first], row[first + 1], row[first + 2]]);
        let bytes = triples().flatten().all(|v| (0.0..=255.0).contains(&v) && v.fract() == 0.0);
        let shares = triples().flatten().all(|v| (0.0..=1.0).contains(&v));
        let unit = triples().all(|t| (t.iter().map(|v| v * v).sum::<f64>() - 1.0).abs() < 0.02);
        (bytes || shares) && !unit
    };
    // `x y z intensity r g b` is PTS. Elsewhere normals or labels can stand before or after the
    // color.
    let expected = if count == 7 && file.extension() == Some("pts") { 4 } else { 3 };
    let candidates: Vec<usize> = (3..(count + 1).saturating_sub(3)).filter(is_color).collect();
    let score = |first: usize| {
        // The channels of a color rise and fall together; labels do not.
        let likeness =
            correlation(&rows, first, first + 1) + correlation(&rows, first + 1, first + 2);
        likeness + if first == expected { 0.5 } else { 0.0 }
    };
    let best = candidates.iter().rev().copied().max_by(|a, b| score(*a).total_cmp(&score(*b)));
    let next = candidates
        .iter()
        .filter(|first| Some(**first) != best)
        .map(|first| score(*first))
        .max_by(f64::total_cmp);
    let assumption = best.map(|first| {
        let others = if next.is_some() { ", which others could be too" } else { "" };
        let text = format!(
            "columns {} to {} are read as the color{others}: a heading such as \"x y z r g b label\" settles it",
            first + 1,
            first + 3
        );
        let lead = next.map(|next| score(first) - next);
        let finding = Finding::assumed(FindingSubject::Color, text)
            .with_confidence(lead.map(|lead| 1.0 / (1.0 + (-4.0 * lead as f32).exp())))
            .stated_with("heading");
        if lead.is_some() { finding } else { finding.without_warning() }
    });
    Ok(Columns {
        position: [0, 1, 2],
        color: best.map(|f| [f, f + 1, f + 2]).map(|at| (at, range(at))),
        assumption,
        announced,
    })
}

/// Returns the correlation of two columns, -1 to 1; 0 if one of them is constant.
fn correlation(rows: &[Vec<f64>], a: usize, b: usize) -> f64 {
    let mean = |at: usize| rows.iter().map(|row| row[at]).sum::<f64>() / rows.len() as f64;
    let (mean_a, mean_b) = (mean(a), mean(b));
    let (mut both, mut of_a, mut of_b) = (0.0, 0.0, 0.0);
    for row in rows {
        let (a, b) = (row[a] - mean_a, row[b] - mean_b);
        both += a * b;
        of_a += a * a;
        of_b += b * b;
    }
    if of_a > 0.0 && of_b > 0.0 { both / (of_a * of_b).sqrt() } else { 0.0 }
}

/// Finds columns by the names that CloudCompare and most tables use.
fn columns_from_heading(line: &str) -> Option<([usize; 3], Option<[usize; 3]>)> {
    let line = line.trim_start_matches(['#', '/']).to_ascii_lowercase();
    let names: Vec<&str> = split_words(&line).map(|word| word.trim_matches('"')).collect();
    let find = |of: &dyn Fn(usize, &str) -> bool| -> Option<[usize; 3]> {
        let at = [0, 1, 2].map(|i| names.iter().position(|name| of(i, name)));
        let [Some(a), Some(b), Some(c)] = at else { return None };
        Some([a, b, c])
    };
    let position = find(&|axis, name| name == ["x", "y", "z"][axis])?;
    Some((position, find(&|channel, name| channel_of_name(name) == Some(channel))))
}

/// Reads lines of text with a limit on their length.
struct BoundedLines<R> {
    source: R,
    line: Vec<u8>,
}

trait TakeLines: Sized {
    fn take_lines(self) -> BoundedLines<Self>;
}

impl<R: BufRead> TakeLines for R {
    fn take_lines(self) -> BoundedLines<Self> {
        BoundedLines { source: self, line: Vec::new() }
    }
}

impl<R: BufRead> BoundedLines<R> {
    fn next_line(&mut self, file: &Utf8Path) -> Result<Option<String>, IngestError> {
        match read_line(&mut self.source, &mut self.line, MAX_LINE_BYTES) {
            Ok(true) => {
                let line = self.line.strip_prefix(BYTE_ORDER_MARK).unwrap_or(&self.line);
                Ok(Some(String::from_utf8_lossy(line).into_owned()))
            }
            Ok(false) => Ok(None),
            Err(e) => Err(IngestError::malformed(file, e)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::clouds::{self, CloudBounds, CoordinateOrigin, LoadedCloud};
    use proptest::prelude::*;
    use uniground_geometry::Point3;

    fn read_text(name: &str, text: &[u8]) -> Result<LoadedCloud, IngestError> {
        let folder = tempfile::tempdir().unwrap();
        let root = Utf8Path::from_path(folder.path()).unwrap();
        std::fs::write(root.join(name), text).unwrap();
        clouds::read(
            root,
            Utf8Path::new(name),
            &CloudBounds { announced: 1 << 30, kept: 1 << 30 },
            CoordinateOrigin::Free,
        )
    }

    #[test]
    fn columns_are_detected_by_heading_count_and_values() {
        let (p, c) = (Point3::new(1.0, 2.0, 3.0), [10, 20, 255]);
        for (name, text, color) in [
            ("a.xyz", "1 2 3\n", GREY),
            ("a.xyz", "1 2 3 10 20 255\n", c),
            ("a.txt", "1,2,3,0.0392,0.0784,0.502\n", [10, 20, 128]),
            ("a.xyz", "1 2 3 0 0.6 0.8\n", GREY),
            ("a.pts", "1\n1 2 3 -1200 10 20 255\n", c),
            ("a.csv", "r;g;b;x;y;z\n10;20;255;1;2;3\n", c),
            ("a.asc", "//X Y Z Scalar R G B\n1 2 3 7 10 20 255\n", c),
        ] {
            let loaded = read_text(name, text.as_bytes()).unwrap();
            assert_eq!(
                (loaded.cloud.positions, loaded.cloud.colors),
                (vec![p], vec![color]),
                "{text}"
            );
        }
    }

    #[test]
    fn decimal_commas_byte_order_marks_and_foreign_headings_are_read() {
        let (p, c) = (Point3::new(1.5, -2.0, 3.25), [10, 20, 255]);
        for text in [
            &b"x;y;z;r;g;b\n1,5;-2,0;3,25;10;20;255\n"[..],
            b"1,5;-2;3,25;10;20;255\n",
            b"1,5\t-2,0\t3,25\t10,0\t20,0\t255,0\n",
            b"\xef\xbb\xbf1.5 -2 3.25 10 20 255\n",
            b"# gr\xfc\xdfe\n1.5 -2 3.25 10 20 255\n",
            b"\"x\",\"y\",\"z\",\"r\",\"g\",\"b\"\n\"1.5\",\"-2\",\"3.25\",10,20,255\n",
        ] {
            let loaded = read_text("a.csv", text).unwrap();
            let shown = String::from_utf8_lossy(text);
            assert_eq!(
                (loaded.cloud.positions, loaded.cloud.colors),
                (vec![p], vec![c]),
                "{shown}"
            );
        }
        let commas = read_text("a.csv", b"1,5,7\n2,6,8\n").unwrap();
        assert_eq!(commas.cloud.positions[0], Point3::new(1.0, 5.0, 7.0));
    }

    /// Brightness varies, so the channels of the color rise and fall together.
    #[test]
    fn labels_beside_the_color_are_told_from_it() {
        let row = |i: u32| {
            let light = i * 37 % 200;
            let [r, g, b] = [light + 20, light + 10, light];
            let (label, instance) = (i / 7 % 13, i * 31 % 97);
            (format!("{i} 1 2"), format!("{r} {g} {b}"), format!("{label} {instance}"), [r, g, b])
        };
        let colors = |name: &str, line: &dyn Fn(u32) -> String| {
            let text: String = (0..300).map(|i| line(i) + "\n").collect();
            let loaded = read_text(name, text.as_bytes()).unwrap();
            let [assumption] = &loaded.findings[..] else { panic!("{:?}", loaded.findings) };
            assert!(assumption.warning && assumption.confidence.unwrap() > 0.5);
            loaded.cloud.colors
        };
        let expected: Vec<[u8; 3]> = (0..300).map(|i| row(i).3.map(|v| v as u8)).collect();
        let after = |i| format!("{} {} {}", row(i).0, row(i).1, row(i).2);
        let one_after = |i: u32| format!("{} {} {}", row(i).0, row(i).1, i / 7 % 13);
        let before = |i: u32| format!("{} {} {}", row(i).0, i * 31 % 97, row(i).1);
        assert_eq!(colors("labels.txt", &after), expected);
        assert_eq!(colors("label.txt", &one_after), expected);
        assert_eq!(colors("intensity.txt", &before), expected);
        assert_eq!(colors("intensity.pts", &before), expected);
    }

    #[test]
    fn damaged_lines_and_wrong_counts_are_named() {
        let findings = |text: &str| -> Vec<String> {
            let found = read_text("a.pts", text.as_bytes()).unwrap().findings;
            found.into_iter().filter(|f| f.warning).map(|f| f.text).collect()
        };
        assert_eq!(findings("2\n1 2 3\n4 5 6\n"), [""; 0]);
        let wrong = findings("9\n1 2 3\n4 5\n7 8 9\n");
        assert_eq!(wrong.len(), 2, "{wrong:?}");
        assert!(wrong[0].contains("announces 9 points, but it has 2"), "{wrong:?}");
        assert!(wrong[1].contains("skipped: [3]"), "{wrong:?}");
    }

    #[test]
    fn map_coordinates_keep_their_precision() {
        let loaded =
            read_text("a.xyz", b"500000.123 5400000.456 101.5\n500001.123 5400001.456 102.5\n")
                .unwrap();
        assert_eq!(loaded.offset, [500_000.0, 5_400_000.0, 100.0]);
        assert!((loaded.cloud.positions[1] - Point3::new(1.123, 1.456, 2.5)).norm() < 1e-6);
    }

    #[test]
    fn text_without_rows_of_three_numbers_is_refused() {
        for text in ["Dear diary,\ntoday 1 2 3\n", "", "1 2\n3 4\n"] {
            assert!(read_text("a.txt", text.as_bytes()).is_err(), "{text}");
        }
    }

    proptest! {
        #[test]
        fn random_text_never_panics(text in "[0-9 .,;a-f\\n-]{0,200}") {
            let _ = read_text("a.txt", text.as_bytes());
        }
    }
}
