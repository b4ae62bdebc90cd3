//! Reads `UniGround`'s task folders: `task.json`, `gt.json`, `ref.json`, `anchor*.json`,
//! `full_pcd.ply`.
//!
//! Boxes are center and full extent in a Y-up world, the cloud is Z-up: boxes are converted here,
//! once. `ref.json` has the candidates of the run that wrote the folder. `target_id: null` in
//! `gt.json` means that this run missed the target, and has no meaning for other runs.

use super::{Collected, RawTarget, RawTask, SceneFiles, entries};
use crate::annotations::{Annotations, SceneObject, check_box};
use crate::records::Omission;
use camino::Utf8Path;
use serde::Deserialize;
use serde::de::DeserializeOwned;
use std::collections::BTreeMap;
use std::fs;
use uniground_geometry::boxes::Aabb;
use uniground_geometry::{Point3, Vector3};

/// Maximum depth of a `task.json` below the suite's folder: `<root>/<scene>/<task>/task.json`.
const DEPTH: u32 = 3;

#[derive(Deserialize)]
#[serde(untagged)]
enum OneOrList<T> {
    List(Vec<T>),
    One(T),
}

#[derive(Clone, Deserialize)]
struct TaskRecord {
    scene_id: Option<String>,
    scan_id: Option<String>,
    description: Option<String>,
    caption: Option<String>,
    target_name: Option<String>,
    object_name: Option<String>,
    unique: Option<bool>,
}

#[derive(Deserialize)]
struct TruthRecord {
    gt_bbox: Vec<f32>,
}

#[derive(Deserialize)]
struct CandidateRecord {
    bbox: Vec<f32>,
}

#[derive(Deserialize)]
struct AnchorRecord {
    anchor: String,
    bbox: Vec<f32>,
}

/// Reads all task folders below `root`. Returns `false` when there is none.
pub(super) fn read_below(root: &Utf8Path, collected: &mut Collected) -> anyhow::Result<bool> {
    let mut found = false;
    let mut folders = vec![(root.to_owned(), 0)];
    while let Some((folder, depth)) = folders.pop() {
        if folder.join("task.json").is_file() {
            found = true;
            let name = folder.strip_prefix(root).unwrap_or(&folder).to_string();
            let name = if name.is_empty() { "task".to_owned() } else { name };
            match read(&folder, &name) {
                Ok((task, files)) => {
                    collected.scenes.insert(name, files);
                    collected.tasks.push(task);
                }
                Err(omission) => collected.omissions.push(omission),
            }
        } else if depth < DEPTH {
            // Popped from the end, so reversed: folders are read in order of name.
            folders.extend(
                entries(&folder)?
                    .into_iter()
                    .rev()
                    .filter(|path| path.is_dir())
                    .map(|path| (path, depth + 1)),
            );
        }
    }
    Ok(found)
}

fn read(folder: &Utf8Path, name: &str) -> Result<(RawTask, SceneFiles), Omission> {
    let file = folder.join("task.json");
    let omit = |what: &str| Omission::new(&file, None, what);
    let task: TaskRecord = match read_json(&file)? {
        OneOrList::One(task) => task,
        OneOrList::List(tasks) => {
            tasks.first().cloned().ok_or_else(|| omit("the list is empty"))?
        }
    };
    let query = task
        .description
        .or(task.caption)
        .ok_or_else(|| omit("description and caption are missing"))?;
    let scan = task.scene_id.or(task.scan_id);
    let truth_file = folder.join("gt.json");
    let truth: TruthRecord = read_json(&truth_file)?;
    let target = to_z_up(&truth.gt_bbox)
        .map_err(|what| Omission::new(&truth_file, None, format!("gt_bbox: {what}")))?;
    let cloud = folder.join("full_pcd.ply");
    let files = SceneFiles {
        scan: cloud.is_file().then_some(cloud),
        annotations: None,
        recorded: read_candidates(folder)?,
    };
    let task = RawTask {
        line: 1,
        id: name.to_owned(),
        scene: name.to_owned(),
        query,
        target: RawTarget::Box(target),
        target_name: task.target_name.or(task.object_name),
        uniqueness: Some(match task.unique {
            Some(true) => "unique",
            Some(false) => "multiple",
            None => "unknown",
        }),
        splits: scan.map(|scan| format!("scan: {scan}")).into_iter().collect(),
        anchors: read_anchors(folder)?,
        file,
    };
    Ok((task, files))
}

/// Returns the candidates of `ref.json`, without names.
fn read_candidates(folder: &Utf8Path) -> Result<Option<Annotations>, Omission> {
    let file = folder.join("ref.json");
    if !file.is_file() {
        return Ok(None);
    }
    let records: BTreeMap<String, CandidateRecord> = read_json(&file)?;
    let mut objects = Vec::new();
    for (id, candidate) in records {
        let omit = |what: String| Omission::new(&file, None, format!("candidate {id:?}: {what}"));
        let number = id.parse().map_err(|_| omit("its id is not a number".into()))?;
        let aabb = to_z_up(&candidate.bbox).map_err(omit)?;
        objects.push(SceneObject {
            id: number,
            name: String::new(),
            aabb,
            rotated: None,
            cloud_points: 0,
            mean_rgb: None,
            colors: Vec::new(),
            seen_as: None,
        });
    }
    objects.sort_by_key(|o| o.id);
    Ok(Some(Annotations { objects, of_point: None }))
}

/// Reads `anchor.json`, or else all `anchor_*.json`.
fn read_anchors(folder: &Utf8Path) -> Result<Vec<(String, Aabb)>, Omission> {
    let single = folder.join("anchor.json");
    let files = if single.is_file() {
        vec![single]
    } else {
        let listed =
            entries(folder).map_err(|error| Omission::new(folder, None, error.to_string()))?;
        let anchored = |path: &Utf8Path| {
            path.file_name().is_some_and(|n| n.starts_with("anchor_"))
                && path.extension() == Some("json")
        };
        listed.into_iter().filter(|path| anchored(path)).collect()
    };
    let read = |file: &camino::Utf8PathBuf| {
        let AnchorRecord { anchor, bbox } = read_json(file)?;
        Ok((anchor, to_z_up(&bbox).map_err(|what| Omission::new(file, None, what))?))
    };
    files.iter().map(read).collect()
}

/// Converts `[x, y, z, dx, dy, dz]` of a Y-up world to Z-up: `(x, -z, y)`, with extents swapped in
/// the same way. Further numbers are ignored.
fn to_z_up(numbers: &[f32]) -> Result<Aabb, String> {
    match *numbers {
        [x, y, z, dx, dy, dz, ..] => {
            let aabb = Aabb { center: Point3::new(x, -z, y), size: Vector3::new(dx, dz, dy) };
            check_box(&aabb).map(|()| aabb)
        }
        _ => Err(format!("the box has {} numbers, expected 6", numbers.len())),
    }
}

fn read_json<T: DeserializeOwned>(file: &Utf8Path) -> Result<T, Omission> {
    let text =
        fs::read_to_string(file).map_err(|error| Omission::new(file, None, error.to_string()))?;
    serde_json::from_str(&text)
        .map_err(|error| Omission::new(file, error.line() as u64, error.to_string()))
}
