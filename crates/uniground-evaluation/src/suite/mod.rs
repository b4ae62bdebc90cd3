//! Suites: scenes, expressions and ground truth, in common layouts of benchmarks.
//!
//! Readers ([`queries`], [`scanrefer`], [`tables`], [`embodiedscan`], [`task_folders`]) turn files
//! into [`RawTask`]s. This module joins them with scans and annotations. Unusable records are
//! reported with file and line, the rest is scored.

mod embodiedscan;
mod label_map;
mod queries;
mod scanrefer;
mod tables;
mod task_folders;

use super::annotations::{Annotations, check_box};
use super::records::{Omission, Record};
use super::sealed::Sealed;
use anyhow::{Context, bail, ensure};
use camino::{Utf8Path, Utf8PathBuf};
use label_map::LabelMap;
use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use uniground_geometry::boxes::Aabb;
use uniground_geometry::rotated_box::RotatedBox;

/// The part of a task that a system may see.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Expression {
    pub query: String,
}

/// One expression to be grounded.
#[derive(Debug, Clone)]
pub struct Task {
    /// Unique within the suite and stable across runs.
    pub id: String,
    /// Index into [`Suite::scenes`].
    pub scene: usize,
    pub expression: Expression,
    pub truth: Sealed<Truth>,
    pub hints: Sealed<Hints>,
}

/// The correct answer, and the splits of a report in which the task counts.
#[derive(Debug, Clone, PartialEq)]
pub struct Truth {
    pub target: Target,
    /// `unique`, `multiple` or `unknown`: whether the scene has one object of the target's class.
    pub uniqueness: &'static str,
    /// Further splits: kinds of expressions, `hard`, `view-dependent`.
    pub splits: Vec<String>,
}

#[derive(Debug, Clone, PartialEq)]
pub enum Target {
    Object {
        name: Option<String>,
        aabb: Aabb,
        /// The oriented box, if the annotation has one.
        rotated: Option<RotatedBox>,
    },
    /// The scene contains no such object.
    Absent,
}

/// Data that a paper-compatible run may pass on: the annotated class and anchors of `task.json`.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Hints {
    pub target_name: Option<String>,
    pub anchors: Vec<(String, Aabb)>,
}

/// A scene of a suite.
#[derive(Debug, Clone)]
pub struct SuiteScene {
    pub id: String,
    /// Archive or folder of the scan, or a single cloud.
    pub scan: Option<Utf8PathBuf>,
    pub annotations: Option<Sealed<Annotations>>,
    /// Candidates from another stage 1, stored in a task folder. Not ground truth.
    pub recorded: Option<Annotations>,
}

/// A suite: scenes and tasks to score.
#[derive(Debug, Clone)]
pub struct Suite {
    pub name: String,
    pub scenes: Vec<SuiteScene>,
    pub tasks: Vec<Task>,
    pub omissions: Vec<Omission>,
}

/// Options for reading a suite.
#[derive(Debug, Clone, Default)]
pub struct SuiteOptions {
    /// Folder of scans and annotations. `None`: the suite's own folder.
    pub scenes: Option<Utf8PathBuf>,
    /// `ScanNet`'s `scannetv2-labels.combined.tsv`, to distinguish unique from multiple as
    /// `ScanRefer` does.
    pub label_map: Option<Utf8PathBuf>,
}

/// A task as read from its file, before its target is resolved.
#[derive(Debug, Clone)]
struct RawTask {
    file: Utf8PathBuf,
    line: u64,
    id: String,
    scene: String,
    query: String,
    target: RawTarget,
    target_name: Option<String>,
    /// The value in the file. `None`: names are counted in the annotations.
    uniqueness: Option<&'static str>,
    splits: Vec<String>,
    anchors: Vec<(String, Aabb)>,
}

#[derive(Debug, Clone)]
enum RawTarget {
    Id(u32),
    Box(Aabb),
    Absent,
}

/// The output of the readers.
#[derive(Debug, Default)]
struct Collected {
    tasks: Vec<RawTask>,
    /// Scenes that name their own files.
    scenes: BTreeMap<String, SceneFiles>,
    omissions: Vec<Omission>,
}

#[derive(Debug, Clone, Default)]
struct SceneFiles {
    scan: Option<Utf8PathBuf>,
    annotations: Option<Utf8PathBuf>,
    recorded: Option<Annotations>,
}

impl Collected {
    fn add(&mut self, task: Result<RawTask, Omission>) {
        match task {
            Ok(task) => self.tasks.push(task),
            Err(omission) => self.omissions.push(omission),
        }
    }
}

impl Suite {
    /// Opens a folder, a JSON list, a `suite.json` or a CSV table.
    ///
    /// # Errors
    /// Returns an error when there is nothing to score: an unreadable path, an unknown layout, or
    /// no usable expression (the reasons are in the message).
    pub fn open(path: &Utf8Path, options: &SuiteOptions) -> anyhow::Result<Self> {
        ensure!(path.exists(), "{path}: there is no such file or folder");
        if let Some(file) = &options.label_map {
            ensure!(file.is_file(), "{file}: there is no such label map");
        }
        let mut collected = Collected::default();
        if path.is_dir() {
            read_folder(path, &mut collected)?;
        } else {
            read_file(path, options, &mut collected)?;
        }
        let own_folder =
            if path.is_dir() { path } else { path.parent().unwrap_or(Utf8Path::new(".")) };
        let folder = options.scenes.as_deref().unwrap_or(own_folder);
        ensure!(folder.is_dir(), "{folder}: there is no such folder of scenes");
        let full = path.canonicalize_utf8().unwrap_or_else(|_| path.to_owned());
        let suite = assemble(full.file_stem().unwrap_or("suite").to_owned(), folder, collected);
        if suite.tasks.is_empty() {
            let reasons: String =
                suite.omissions.iter().take(10).map(|o| format!("\n  {o}")).collect();
            bail!("{path}: no expression to score ({} left out){reasons}", suite.omissions.len());
        }
        Ok(suite)
    }

    /// Returns the first `count` tasks in an order that depends only on ids and `seed`.
    #[must_use]
    pub fn sample(mut self, count: usize, seed: u64) -> Self {
        let mut keyed: Vec<(u64, usize)> =
            self.tasks.iter().enumerate().map(|(i, task)| (hash(&task.id, seed), i)).collect();
        keyed.sort_unstable();
        let mut kept: Vec<usize> = keyed.into_iter().take(count).map(|(_, i)| i).collect();
        kept.sort_unstable();
        self.tasks = kept.into_iter().map(|i| self.tasks[i].clone()).collect();
        self
    }
}

impl Suite {
    /// Returns the tasks of the first `count` scenes in an order that depends only on ids and
    /// `seed`.
    #[must_use]
    pub fn sample_by_scene(mut self, count: usize, seed: u64) -> Self {
        let answer_query: BTreeSet<usize> = self.tasks.iter().map(|task| task.scene).collect();
        let mut keyed: Vec<(u64, usize)> = answer_query
            .into_iter()
            .map(|scene| (hash(&self.scenes[scene].id, seed), scene))
            .collect();
        keyed.sort_unstable();
        let kept: BTreeSet<usize> = keyed.into_iter().take(count).map(|(_, scene)| scene).collect();
        self.tasks.retain(|task| kept.contains(&task.scene));
        self
    }
}

/// FNV-1a. Stable over platforms and versions, unlike the standard hasher.
fn hash(text: &str, seed: u64) -> u64 {
    let start = 0xcbf2_9ce4_8422_2325 ^ seed.wrapping_mul(0x9e37_79b9_7f4a_7c15);
    let mixed =
        text.bytes().fold(start, |h, byte| (h ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3));
    (mixed ^ (mixed >> 29)).wrapping_mul(0xbf58_476d_1ce4_e5b9)
}

/// Reads a folder with `*.queries.json`, a `suite.json`, or `task.json` folders up to three levels
/// down.
fn read_folder(folder: &Utf8Path, collected: &mut Collected) -> anyhow::Result<()> {
    let mut found = false;
    for file in entries(folder)? {
        let name = file.file_name().unwrap_or_default();
        if name.ends_with(".queries.json") || name == "suite.json" {
            found = true;
            // One unreadable file must not prevent reading the others.
            if let Err(error) = read_file(&file, &SuiteOptions::default(), collected) {
                collected.omissions.push(Omission::new(&file, None, format!("{error:#}")));
            }
        }
    }
    found |= task_folders::read_below(folder, collected)?;
    ensure!(
        found,
        "{folder}: no *.queries.json, suite.json or task.json folders; give a list or table as a file"
    );
    Ok(())
}

/// Returns files and folders directly below, sorted by name.
fn entries(folder: &Utf8Path) -> anyhow::Result<Vec<Utf8PathBuf>> {
    let listed = folder.read_dir_utf8().with_context(|| folder.to_string())?;
    let mut paths =
        listed.map(|entry| Ok(entry?.into_path())).collect::<std::io::Result<Vec<_>>>()?;
    paths.sort();
    Ok(paths)
}

fn read_file(
    file: &Utf8Path,
    options: &SuiteOptions,
    collected: &mut Collected,
) -> anyhow::Result<()> {
    let text = fs::read_to_string(file)
        .with_context(|| file.to_string())?
        .trim_start_matches('\u{feff}')
        .to_owned();
    let labels = options.label_map.as_deref().map(LabelMap::read).transpose()?;
    if file.extension().is_some_and(|e| e.eq_ignore_ascii_case("csv")) {
        return tables::read(file, &text, collected);
    }
    if text.trim_start().starts_with('{') {
        return queries::read_suite(file, &text, collected);
    }
    let records = match Record::parse_list(&text) {
        Ok(records) => records,
        Err(error) => {
            collected.omissions.push(Omission::new(file, error.line() as u64, error.to_string()));
            return Ok(());
        }
    };
    // The first record that is an object determines the kind of list.
    let keys: Option<BTreeMap<String, serde_json::Value>> =
        records.iter().find_map(|record| record.decode(file).ok());
    let has = |key: &str| keys.as_ref().is_some_and(|keys| keys.contains_key(key));
    if has("query") || file.as_str().ends_with(".queries.json") {
        queries::read_list(file, &records, collected);
    } else if has("description") && has("object_id") {
        scanrefer::read(file, &records, labels.as_ref(), collected);
    } else if has("text") || has("caption") {
        embodiedscan::read(file, &records, collected);
    } else if !records.is_empty() {
        bail!(
            "{file}: unknown kind of list: its records need query, or description and object_id, or text or caption"
        );
    }
    Ok(())
}

fn assemble(name: String, folder: &Utf8Path, collected: Collected) -> Suite {
    let Collected { tasks: raw, scenes: known, mut omissions } = collected;
    let mut scenes: Vec<SuiteScene> = Vec::new();
    let mut index_of: BTreeMap<String, usize> = BTreeMap::new();
    let mut tasks = Vec::new();
    let mut first_of: BTreeMap<String, (Utf8PathBuf, u64)> = BTreeMap::new();
    for task in raw {
        let scene = *index_of.entry(task.scene.clone()).or_insert_with(|| {
            scenes.push(build_scene(&task.scene, folder, known.get(&task.scene), &mut omissions));
            scenes.len() - 1
        });
        let omit = |reason: String| Omission::new(&task.file, task.line, reason);
        if let Some((file, line)) = first_of.get(&task.id) {
            omissions.push(omit(format!("the id {} is already used in {file}:{line}", task.id)));
            continue;
        }
        first_of.insert(task.id.clone(), (task.file.clone(), task.line));
        match resolve(&task, scene, &scenes[scene]) {
            Ok(task) => tasks.push(task),
            Err(reason) => omissions.push(omit(reason)),
        }
    }
    Suite { name, scenes, tasks, omissions }
}

fn build_scene(
    id: &str,
    folder: &Utf8Path,
    known: Option<&SceneFiles>,
    omissions: &mut Vec<Omission>,
) -> SuiteScene {
    let SceneFiles { scan, annotations, recorded } = known.cloned().unwrap_or_default();
    let scan = scan.or_else(|| {
        let candidates =
            [".zip", ".tar", ".tar.zst", ""].map(|ending| folder.join(format!("{id}{ending}")));
        candidates.into_iter().find(|path| path.exists())
    });
    let annotations = annotations.or_else(|| Annotations::find_file(folder, id)).map(|file| {
        let (annotations, reported) = Annotations::read(&file);
        omissions.extend(reported);
        Sealed::new(annotations)
    });
    SuiteScene { id: id.to_owned(), scan, annotations, recorded }
}

/// Resolves the target of a task. The error is the reason why it cannot be scored.
fn resolve(task: &RawTask, scene: usize, suite_scene: &SuiteScene) -> Result<Task, String> {
    if task.query.trim().is_empty() {
        return Err("the query is empty".into());
    }
    if suite_scene.scan.is_none() && suite_scene.annotations.is_none() {
        return Err(format!(
            "the scene {} is missing: neither scan nor annotations were found",
            task.scene
        ));
    }
    let annotations = suite_scene.annotations.as_ref().map(Sealed::for_reader);
    let (target, name) = match &task.target {
        RawTarget::Absent => (Target::Absent, None),
        RawTarget::Box(aabb) => {
            check_box(aabb)?;
            (
                Target::Object { name: task.target_name.clone(), aabb: *aabb, rotated: None },
                task.target_name.clone(),
            )
        }
        RawTarget::Id(id) => {
            let annotations = annotations.ok_or_else(|| {
                format!("the scene {} has no annotations to look up target {id} in", task.scene)
            })?;
            let object = annotations.object(*id).ok_or_else(|| {
                format!("target {id} is not in the annotations of {}", task.scene)
            })?;
            let target = Target::Object {
                name: Some(object.name.clone()),
                aabb: object.aabb,
                rotated: object.rotated,
            };
            (target, Some(object.name.clone()))
        }
    };
    let counted = || match (annotations, &name) {
        (Some(annotations), Some(name)) if annotations.is_unique(name) => "unique",
        (Some(_), Some(_)) => "multiple",
        _ => "unknown",
    };
    let uniqueness =
        if target == Target::Absent { "absent" } else { task.uniqueness.unwrap_or_else(counted) };
    let hints = Hints { target_name: task.target_name.clone(), anchors: task.anchors.clone() };
    Ok(Task {
        id: task.id.clone(),
        scene,
        expression: Expression { query: task.query.clone() },
        truth: Sealed::new(Truth { target, uniqueness, splits: task.splits.clone() }),
        hints: Sealed::new(hints),
    })
}

#[cfg(test)]
mod tests;
