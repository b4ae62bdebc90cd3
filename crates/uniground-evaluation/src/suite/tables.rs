//! Reads tables: `nr3d.csv` and `sr3d.csv` of `ReferIt3D`, and the 250-task lists of VLM-Grounder,
//! which have the same core.
//!
//! Columns used: `scan_id`, `target_id`, `utterance`, `instance_type`; if present `stimulus_id`,
//! `is_unique_scanrefer`, `is_easy_referit3d`, `is_vd_referit3d`, `reference_type`. Targets are
//! `ScanNet` `objectId`s. Boxes come from the annotations.

use super::{Collected, RawTarget, RawTask};
use crate::records::Omission;
use anyhow::{Context, ensure};
use camino::Utf8Path;
use csv::StringRecord;
use std::collections::HashMap;

/// Words that make an expression depend on the viewer (`ReferIt3D`).
const VIEW_WORDS: [&str; 10] = [
    "front",
    "behind",
    "back",
    "right",
    "left",
    "facing",
    "leftmost",
    "rightmost",
    "looking",
    "across",
];

/// Maximum number of objects of the target's class, including the target, for an easy expression
/// (`ReferIt3D`).
const EASY_UP_TO: u32 = 2;

struct Row<'a> {
    columns: &'a HashMap<String, usize>,
    cells: &'a StringRecord,
}

impl Row<'_> {
    fn get(&self, column: &str) -> Option<&str> {
        let cell = self.cells.get(*self.columns.get(column)?)?.trim();
        (!cell.is_empty()).then_some(cell)
    }

    fn require(&self, column: &str) -> Result<&str, String> {
        self.get(column).ok_or_else(|| format!("{column} is empty"))
    }

    fn parse_flag(&self, column: &str) -> Option<bool> {
        match self.get(column)?.to_ascii_lowercase().as_str() {
            "true" | "1" => Some(true),
            "false" | "0" => Some(false),
            _ => None,
        }
    }
}

pub(super) fn read(file: &Utf8Path, text: &str, collected: &mut Collected) -> anyhow::Result<()> {
    let mut reader = csv::ReaderBuilder::new().flexible(true).from_reader(text.as_bytes());
    let headers = reader.headers().with_context(|| file.to_string())?.clone();
    let columns: HashMap<String, usize> =
        headers.iter().enumerate().map(|(i, name)| (name.trim().to_owned(), i)).collect();
    let needed = ["scan_id", "target_id", "utterance"];
    let missing: Vec<_> = needed.into_iter().filter(|name| !columns.contains_key(*name)).collect();
    ensure!(missing.is_empty(), "{file}: no column {}", missing.join(", "));
    for (i, cells) in reader.records().enumerate() {
        let task = match cells {
            Ok(cells) => {
                let line = cells.position().map_or(0, csv::Position::line);
                let task = to_task(&Row { columns: &columns, cells: &cells }, i);
                task.map(|task| RawTask { file: file.to_owned(), line, ..task })
                    .map_err(|what| Omission::new(file, line, what))
            }
            Err(error) => Err(Omission::new(
                file,
                error.position().map(csv::Position::line),
                error.to_string(),
            )),
        };
        collected.add(task);
    }
    Ok(())
}

fn to_task(row: &Row, index: usize) -> Result<RawTask, String> {
    let target = row.require("target_id")?;
    let target: u32 =
        target.parse().map_err(|_| format!("target_id {target:?} is not an object's number"))?;
    let (scene, query) = (row.require("scan_id")?, row.require("utterance")?);
    let alike = row.get("stimulus_id").and_then(class_size);
    let mut splits = Vec::new();
    if let Some(easy) =
        row.parse_flag("is_easy_referit3d").or_else(|| alike.map(|n| n <= EASY_UP_TO))
    {
        splits.push(if easy { "easy" } else { "hard" }.to_owned());
    }
    let depends = row.parse_flag("is_vd_referit3d").unwrap_or_else(|| depends_on_view(query));
    splits.push(if depends { "view-dependent" } else { "view-independent" }.to_owned());
    if let Some(kind) = row.get("reference_type").or_else(|| row.get("coarse_reference_type")) {
        splits.push(format!("kind: {kind}"));
    }
    let unique = row.parse_flag("is_unique_scanrefer").or_else(|| alike.map(|n| n == 1));
    Ok(RawTask {
        file: "".into(),
        line: 0,
        id: match row.get("assignmentid") {
            Some(id) => format!("{scene}-{target}-{id}"),
            None => format!("{scene}-{target}-row{}", index + 1),
        },
        scene: scene.to_owned(),
        query: query.to_owned(),
        target: RawTarget::Id(target),
        target_name: row.get("instance_type").map(str::to_owned),
        uniqueness: unique.map(|unique| if unique { "unique" } else { "multiple" }),
        splits,
        anchors: Vec::new(),
    })
}

/// Returns the number of objects of the class from `scan-label-N-target-distractors…`. N includes
/// the target.
fn class_size(stimulus: &str) -> Option<u32> {
    stimulus.split('-').nth(2)?.parse().ok()
}

pub(super) fn depends_on_view(query: &str) -> bool {
    let lower = query.to_lowercase();
    lower.split(|c: char| !c.is_alphanumeric()).any(|word| VIEW_WORDS.contains(&word))
}
