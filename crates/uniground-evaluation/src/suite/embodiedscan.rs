//! Reads `EmbodiedScan` visual grounding lists (`{scan_id, target_id, distractor_ids, text, target,
//! anchors}`) and `UniGround`'s query lists of `ScanNet` and `ARKitScenes` (`{scan_id, target_id,
//! target_name, caption}`).
//!
//! `scan_id` may include its data set (`arkitscenes/Training/47333462`): its last part identifies
//! scans and annotations. Targets are resolved by `bbox_id`. An expression with several targets has
//! no single correct box and is left out.

use super::scanrefer::Number;
use super::tables::depends_on_view;
use super::{Collected, RawTarget, RawTask};
use crate::records::{Omission, Record};
use camino::Utf8Path;
use serde::Deserialize;

/// Maximum number of other objects of the target's class for an easy expression (`EmbodiedScan`).
const EASY_DISTRACTORS: usize = 3;

#[derive(Deserialize)]
#[serde(untagged)]
enum Targets {
    One(Number),
    Many(Vec<Number>),
}

#[derive(Deserialize)]
struct VisualGroundingRecord {
    #[serde(alias = "scene_id")]
    scan_id: String,
    target_id: Option<Targets>,
    distractor_ids: Option<Vec<Number>>,
    #[serde(alias = "caption")]
    text: String,
    #[serde(alias = "target_name")]
    target: Option<String>,
    unique: Option<bool>,
}

pub(super) fn read(file: &Utf8Path, records: &[Record], collected: &mut Collected) {
    for (i, record) in records.iter().enumerate() {
        let task = record
            .decode::<VisualGroundingRecord>(file)
            .and_then(|found| {
                to_task(found, i).map_err(|what| Omission::new(file, record.line, what))
            })
            .map(|task| RawTask { file: file.to_owned(), line: record.line, ..task });
        collected.add(task);
    }
}

fn to_task(record: VisualGroundingRecord, index: usize) -> Result<RawTask, String> {
    let target = match record.target_id {
        None => return Err("there is no target_id: the test split has no ground truth".into()),
        Some(Targets::One(id)) => id.get()?,
        Some(Targets::Many(ids)) => match ids.as_slice() {
            [id] => id.get()?,
            ids => {
                return Err(format!("{} targets: only expressions with one are scored", ids.len()));
            }
        },
    };
    let scene = record.scan_id.rsplit('/').next().unwrap_or_default().to_owned();
    let mut splits = vec![
        if depends_on_view(&record.text) { "view-dependent" } else { "view-independent" }
            .to_owned(),
    ];
    let distractors = record.distractor_ids.as_ref().map(Vec::len);
    splits
        .extend(distractors.map(|n| if n > EASY_DISTRACTORS { "hard" } else { "easy" }.to_owned()));
    // The paper's converter writes `false` for every expression of ARKitScenes. Only `true` is
    // reliable.
    let uniqueness = match (distractors, record.unique) {
        (Some(0), _) | (None, Some(true)) => Some("unique"),
        (Some(_), _) => Some("multiple"),
        (None, _) => None,
    };
    Ok(RawTask {
        file: "".into(),
        line: 0,
        id: format!("{scene}-{target}-{}", index + 1),
        scene,
        query: record.text,
        target: RawTarget::Id(target),
        target_name: record.target,
        uniqueness,
        splits,
        anchors: Vec::new(),
    })
}
