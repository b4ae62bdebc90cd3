//! Compares the files of an upload with those that its layout uses.

use super::formats::is_of_system;
use super::scan::Scan;
use super::unpacked::BESIDE_MESHES;
use camino::{Utf8DirEntry, Utf8Path, Utf8PathBuf};
use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write;
use uniground_types::findings::{Finding, FindingSubject};

/// Extensions of files that are for people. Other files are named if nothing reads them.
const DOCUMENTS: [&str; 6] = ["md", "log", "pdf", "html", "rtf", "docx"];
/// Names of text files that are for people, in lower case.
const FOR_PEOPLE: [&str; 7] =
    ["readme", "license", "licence", "attribution", "copying", "notice", "changelog"];
/// Maximum number of files that are examined, and of kinds of unused files that are named.
const MAX_FILES: usize = 500_000;
const MAX_NAMED: usize = 8;

/// Adds what the scan consists of, and which other files with data are in the upload.
pub(super) fn record(folder: &Utf8Path, scan: &mut Scan) {
    let mut findings = Vec::new();
    if let Some(first) = scan.frames.first() {
        let kind = |file: &Utf8Path| {
            let ending = file.extension().map(|ending| format!(".{ending}")).unwrap_or_default();
            file.parent().unwrap_or(Utf8Path::new("")).join(format!("*{ending}"))
        };
        // Poses of a list are written as "file, entry".
        let pose = match first.pose_file.as_str().split_once(", ") {
            Some((list, _)) => list.into(),
            None => kind(&first.pose_file),
        };
        let text = format!(
            "{} frames: color {}, depth {}, poses {pose}{}",
            scan.frames.len(),
            kind(&first.color),
            kind(&first.depth),
            other_descriptions(scan),
        );
        findings.push(Finding::read(FindingSubject::Frames, text).counting(scan.frames.len()));
    }
    if let Some(cloud) = &scan.cloud {
        let finding = Finding::read(FindingSubject::Cloud, format!("cloud: {cloud}"));
        findings.push(finding.in_file(cloud.as_str()));
    }
    let unused = unused_files(folder, scan);
    for ((kind, first), count) in unused.iter().take(MAX_NAMED) {
        let mut text = format!("{kind}: {count} files are not used");
        if *count == 1 {
            text = format!("{first} is not used");
        }
        findings.push(
            Finding::left_out(FindingSubject::Files, text)
                .without_warning()
                .in_file(first.as_str())
                .counting(*count),
        );
    }
    if unused.len() > MAX_NAMED {
        let mut text = format!("{} more kinds of files are not used:", unused.len() - MAX_NAMED);
        let rest = &unused[MAX_NAMED..];
        rest.iter().take(MAX_NAMED).for_each(|((kind, _), _)| {
            let _ = write!(text, " {kind}");
        });
        let count = rest.iter().map(|(_, count)| count).sum();
        findings
            .push(Finding::left_out(FindingSubject::Files, text).without_warning().counting(count));
    }
    findings.append(&mut scan.findings);
    scan.findings = findings;
}

/// Maximum number of bytes of pictures that are compared.
const MAX_COMPARED_BYTES: u64 = 64 << 20;

/// Returns a finding if color pictures of usable frames are copies of others, or belong to several
/// frames. Only files of the same size are read.
pub(super) fn find_copies(scan: &Scan) -> Option<Finding> {
    let mut by_size: BTreeMap<u64, Vec<&Utf8PathBuf>> = BTreeMap::new();
    for frame in &scan.frames {
        if let Ok(found) = scan.root.join(&frame.color).metadata() {
            by_size.entry(found.len()).or_default().push(&frame.color);
        }
    }
    let mut left = MAX_COMPARED_BYTES;
    let (mut copies, mut first) = (0, None);
    for (bytes, files) in by_size.into_iter().filter(|(_, files)| files.len() > 1) {
        let Some(rest) = left.checked_sub(bytes * files.len() as u64) else { break };
        left = rest;
        let mut known: BTreeMap<Vec<u8>, &Utf8PathBuf> = BTreeMap::new();
        for file in files {
            let Ok(content) = std::fs::read(scan.root.join(file)) else { continue };
            if let Some(original) = known.get(&content) {
                copies += 1;
                first.get_or_insert((file, *original));
            } else {
                known.insert(content, file);
            }
        }
    }
    let (file, original) = first?;
    let example = match file == original {
        true => format!("{file} belongs to several frames"),
        false => format!("{file} is a copy of {original}"),
    };
    let text = format!(
        "{copies} of {} frames repeat the color picture of another one: {example}",
        scan.frames.len()
    );
    Some(Finding::unusual(FindingSubject::Frames, text).in_file(file.as_str()).counting(copies))
}

/// Returns ", described by " and the text files that were read besides poses, or nothing.
fn other_descriptions(scan: &Scan) -> String {
    let of_poses: BTreeSet<&str> = scan
        .frames
        .iter()
        .map(|frame| frame.pose_file.as_str())
        .map(|file| file.split_once(", ").map_or(file, |(list, _)| list))
        .collect();
    let others: Vec<&str> = scan
        .described_by
        .iter()
        .map(|file| file.as_str())
        .filter(|file| !of_poses.contains(file))
        .collect();
    match others.len() {
        0 => String::new(),
        n if n > MAX_NAMED => format!(", described by {} and {} more", others[0], n - 1),
        _ => format!(", described by {}", others.join(", ")),
    }
}

/// Returns whether a text file is for people, by its name.
fn is_for_people(file: &Utf8Path) -> bool {
    let name = file.file_name().unwrap_or_default().to_ascii_lowercase();
    FOR_PEOPLE.iter().any(|known| name.starts_with(known))
}

/// Returns the kinds of unused files with data (folder and extension), the first of each and their
/// number, the most frequent kinds first.
fn unused_files(folder: &Utf8Path, scan: &Scan) -> Vec<((String, Utf8PathBuf), usize)> {
    let mut used: BTreeSet<Utf8PathBuf> = BTreeSet::new();
    for frame in &scan.frames {
        used.extend(
            [&frame.color, &frame.depth, &frame.pose_file].map(|file| scan.root.join(file)),
        );
        used.extend(frame.optics.confidence.as_ref().map(|own| scan.root.join(&own.file)));
    }
    used.extend(scan.cloud.as_ref().map(|cloud| scan.root.join(cloud)));
    used.extend(scan.described_by.iter().map(|file| scan.root.join(file)));
    let has_parts = scan
        .cloud
        .as_ref()
        .and_then(|cloud| cloud.extension())
        .is_some_and(|ending| ["obj", "gltf"].contains(&ending.to_ascii_lowercase().as_str()));
    let mut kinds: BTreeMap<String, (Utf8PathBuf, usize)> = BTreeMap::new();
    for file in files_below(folder) {
        let ending = file.extension().unwrap_or_default().to_ascii_lowercase();
        let is_part = has_parts && BESIDE_MESHES.contains(&ending.as_str());
        if ending.is_empty()
            || DOCUMENTS.contains(&ending.as_str())
            || is_for_people(&file)
            || is_part
            || used.contains(&file)
        {
            continue;
        }
        let Ok(name) = file.strip_prefix(folder) else { continue };
        let kind = name.parent().unwrap_or(Utf8Path::new("")).join(format!("*.{ending}"));
        kinds.entry(kind.into_string()).or_insert_with(|| (name.to_owned(), 0)).1 += 1;
    }
    let mut kinds: Vec<_> =
        kinds.into_iter().map(|(kind, (first, count))| ((kind, first), count)).collect();
    kinds.sort_by(|a, b| b.1.cmp(&a.1).then_with(|| a.0.cmp(&b.0)));
    kinds
}

/// Returns the files below a folder, without those of operating systems. Unreadable folders are
/// skipped: reading their files would have failed.
fn files_below(folder: &Utf8Path) -> Vec<Utf8PathBuf> {
    let (mut files, mut folders) = (Vec::new(), vec![folder.to_owned()]);
    while let Some(next) = folders.pop() {
        let Ok(entries) = next.read_dir_utf8() else { continue };
        let mut entries: Vec<Utf8DirEntry> = entries.filter_map(Result::ok).collect();
        entries.sort_by(|a, b| a.file_name().cmp(b.file_name()));
        for entry in entries {
            match entry.file_type() {
                _ if is_of_system(entry.file_name()) => {}
                Ok(kind) if kind.is_dir() => folders.push(entry.into_path()),
                Ok(kind) if kind.is_file() => files.push(entry.into_path()),
                _ => {}
            }
        }
        if files.len() > MAX_FILES {
            break;
        }
    }
    files
}
