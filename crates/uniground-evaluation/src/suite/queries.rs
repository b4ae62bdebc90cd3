//! Reads `<scene>.queries.json`, a list of expressions about one scene, and `suite.json`, which
//! lists its own scenes.

use super::{Collected, RawTarget, RawTask, SceneFiles};
use crate::records::{Omission, Record};
use anyhow::Context;
use camino::{Utf8Path, Utf8PathBuf};
use serde::Deserialize;
use serde_json::Value;
use serde_json::value::RawValue;
use uniground_geometry::boxes::Aabb;

#[derive(Deserialize)]
struct QueryRecord {
    id: Option<String>,
    scene: Option<String>,
    query: String,
    /// `null`: no such object exists. If missing, there must be a box.
    #[serde(default = "left_out")]
    target_id: Value,
    target_box: Option<Aabb>,
    target_name: Option<String>,
    kind: Option<String>,
    unique: Option<bool>,
}

/// A suite in one file. Paths are relative to it.
#[derive(Deserialize)]
struct SuiteFile<'a> {
    format: String,
    #[serde(default)]
    scenes: Vec<SceneEntry>,
    #[serde(borrow)]
    expressions: Vec<&'a RawValue>,
}

#[derive(Deserialize)]
struct SceneEntry {
    id: String,
    scan: Option<Utf8PathBuf>,
    annotations: Option<Utf8PathBuf>,
}

/// Marks a missing `target_id`, which differs from `null`.
fn left_out() -> Value {
    Value::Bool(false)
}

fn parse_target(id: &Value, aabb: Option<Aabb>) -> Result<RawTarget, String> {
    match (id, aabb) {
        (Value::Number(id), _) => {
            let id = id.as_u64().and_then(|id| u32::try_from(id).ok());
            id.map(RawTarget::Id).ok_or_else(|| "target_id is not an object's number".into())
        }
        (Value::Null | Value::Bool(false), Some(aabb)) => Ok(RawTarget::Box(aabb)),
        (Value::Null, None) => Ok(RawTarget::Absent),
        (Value::Bool(false), None) => {
            Err("target_id and target_box are missing; if there is no such object, set \"target_id\": null".into())
        }
        _ => Err("target_id is not an object's number".into()),
    }
}

const SUITE_FORMAT: &str = "uniground-suite/1";

pub(super) fn read_list(file: &Utf8Path, records: &[Record], collected: &mut Collected) {
    let name = file.file_name().unwrap_or_default();
    let scene = name.strip_suffix(".queries.json").or(file.file_stem()).unwrap_or_default();
    read(file, records, Some(scene), collected);
}

pub(super) fn read_suite(
    file: &Utf8Path,
    text: &str,
    collected: &mut Collected,
) -> anyhow::Result<()> {
    let SuiteFile { format, scenes, expressions } =
        serde_json::from_str(text).with_context(|| file.to_string())?;
    anyhow::ensure!(
        format == SUITE_FORMAT,
        "{file}: the format is {format:?}, expected {SUITE_FORMAT:?}"
    );
    let folder = file.parent().unwrap_or(Utf8Path::new("."));
    for SceneEntry { id, scan, annotations } in scenes {
        for path in scan
            .iter()
            .chain(&annotations)
            .map(|path| folder.join(path))
            .filter(|path| !path.exists())
        {
            collected.omissions.push(Omission::new(
                file,
                None,
                format!("scene {id}: {path} does not exist"),
            ));
        }
        let found = |path: Option<Utf8PathBuf>| {
            path.map(|path| folder.join(path)).filter(|path| path.exists())
        };
        let files =
            SceneFiles { scan: found(scan), annotations: found(annotations), recorded: None };
        collected.scenes.insert(id, files);
    }
    read(file, &Record::with_locations(text, &expressions), None, collected);
    Ok(())
}

fn read(file: &Utf8Path, records: &[Record], scene: Option<&str>, collected: &mut Collected) {
    for (i, record) in records.iter().enumerate() {
        let task = record.decode::<QueryRecord>(file).and_then(|query| {
            let no_scene = || Omission::new(file, record.line, "the expression has no scene");
            let scene = query.scene.as_deref().or(scene).ok_or_else(no_scene)?.to_owned();
            Ok(RawTask {
                file: file.to_owned(),
                line: record.line,
                id: query.id.unwrap_or_else(|| format!("{scene}#{}", i + 1)),
                scene,
                query: query.query,
                target: parse_target(&query.target_id, query.target_box)
                    .map_err(|what| Omission::new(file, record.line, what))?,
                target_name: query.target_name,
                uniqueness: query.unique.map(|unique| if unique { "unique" } else { "multiple" }),
                splits: query.kind.map(|kind| format!("kind: {kind}")).into_iter().collect(),
                anchors: Vec::new(),
            })
        });
        collected.add(task);
    }
}
