//! Reads `ScanRefer_filtered_val.json`: a list of `{scene_id, object_id, object_name, ann_id,
//! description}`.
//!
//! Targets are resolved in the scene's annotations by `object_id` (`ScanNet`'s `objectId`, from 0).

use super::label_map::LabelMap;
use super::{Collected, RawTarget, RawTask};
use crate::records::{Omission, Record};
use camino::Utf8Path;
use serde::Deserialize;
use std::collections::{BTreeMap, BTreeSet};

/// A number that may be written as a string.
#[derive(Debug, Clone, Deserialize)]
#[serde(untagged)]
pub(super) enum Number {
    Number(u32),
    Text(String),
}

impl Number {
    pub(super) fn get(&self) -> Result<u32, String> {
        match self {
            Self::Number(n) => Ok(*n),
            Self::Text(text) => {
                text.trim().parse().map_err(|_| format!("{text:?} is not an object's number"))
            }
        }
    }
}

#[derive(Deserialize)]
struct ScanReferRecord {
    scene_id: String,
    object_id: Number,
    object_name: String,
    ann_id: Number,
    description: String,
}

pub(super) fn read(
    file: &Utf8Path,
    records: &[Record],
    labels: Option<&LabelMap>,
    collected: &mut Collected,
) {
    let decoded: Vec<(u64, Result<ScanReferRecord, Omission>)> =
        records.iter().map(|r| (r.line, r.decode(file))).collect();
    // Unique: the only annotated object of its class in its scene, among the objects of this list.
    let class = |name: &str| {
        labels.map_or_else(
            || name.to_owned(),
            |labels| labels.class(&name.replace('_', " ")).to_owned(),
        )
    };
    let mut objects_of: BTreeMap<(String, String), BTreeSet<u32>> = BTreeMap::new();
    for record in decoded.iter().filter_map(|(_, record)| record.as_ref().ok()) {
        if let Ok(id) = record.object_id.get() {
            objects_of
                .entry((record.scene_id.clone(), class(&record.object_name)))
                .or_default()
                .insert(id);
        }
    }
    for (line, record) in decoded {
        let task = record.and_then(|record| {
            let omit = |what| Omission::new(file, line, what);
            let (object, annotation) =
                (record.object_id.get().map_err(omit)?, record.ann_id.get().map_err(omit)?);
            let alike = objects_of
                .get(&(record.scene_id.clone(), class(&record.object_name)))
                .map_or(0, BTreeSet::len);
            Ok(RawTask {
                file: file.to_owned(),
                line,
                id: format!("{}-{object}-{annotation}", record.scene_id),
                scene: record.scene_id,
                query: record.description,
                target: RawTarget::Id(object),
                target_name: Some(record.object_name.replace('_', " ")),
                uniqueness: Some(if alike == 1 { "unique" } else { "multiple" }),
                splits: Vec::new(),
                anchors: Vec::new(),
            })
        });
        collected.add(task);
    }
}
