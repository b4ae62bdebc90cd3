//! Runs a suite through a system, cell by cell. Runs are resumable: every reply is stored
//! immediately.
//!
//! Replies are stored in `<out>/cells/<key>/<scene>.jsonl`. The key covers the system's fingerprint
//! and the configuration, the file's first line the scene's content. A run that was interrupted, or
//! is repeated with more cells or expressions, only asks what is missing. Scores are never stored:
//! they are computed from replies and the current truth.

use super::configuration::{Configuration, Names, Source};
use super::digest;
use super::pictures;
use super::reply::Reply;
use super::scoring::ScoredExpression;
use super::sealed::{PaperCompatibleRun, Ranked, Sealed};
use super::suite::{Suite, SuiteScene, Task};
use super::systems::{OpenScene, System};
use anyhow::Context;
use camino::Utf8Path;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::fs::{self, File, OpenOptions};
use std::io::Write;
use std::sync::Mutex;
use uniground_geometry::boxes::Aabb;

/// The inputs and options of a run.
pub struct RunOptions<'a> {
    /// Output folder of replies and pictures.
    pub out: &'a Utf8Path,
    pub cells: &'a [(String, Configuration)],
    /// Number of concurrent questions.
    pub concurrency: usize,
    /// Called for every finished scene of every cell.
    pub progress: &'a (dyn Fn(&Step) + Sync),
}

/// Progress: a scene of a cell is finished.
#[derive(Debug, Clone, Copy)]
pub struct Step<'a> {
    pub cell: &'a str,
    pub scene: &'a str,
    pub done: usize,
    pub of: usize,
}

/// The result of one cell.
#[derive(Debug, Clone)]
pub struct CellResult {
    pub name: String,
    pub configuration: Configuration,
    /// Outcomes in the order of the suite.
    pub outcomes: Vec<ScoredExpression>,
    /// Expressions that could not be asked, with the reason.
    pub left_out: Vec<(String, String)>,
}

#[derive(PartialEq, Eq, Serialize, Deserialize)]
struct Header {
    scene: String,
    content: String,
}

#[derive(Serialize, Deserialize)]
struct StoredScene {
    boxes: Vec<Aabb>,
    /// Token by which the system recognizes the scene.
    token: String,
}

#[derive(Serialize, Deserialize)]
struct KeptReply {
    id: String,
    query: String,
    reply: Reply,
}

/// Runs every cell over every scene.
///
/// # Errors
/// Returns an error for a configuration that the system does not support, or an output folder that
/// cannot be written. Failed scenes and questions are outcomes, not errors.
pub fn run(
    suite: &Suite,
    system: &dyn System,
    options: &RunOptions,
) -> anyhow::Result<Vec<CellResult>> {
    for (name, configuration) in options.cells {
        system.check_configuration(configuration).with_context(|| name.clone())?;
    }
    fs::create_dir_all(options.out.join(pictures::FOLDER))
        .with_context(|| options.out.to_string())?;
    let pool = rayon::ThreadPoolBuilder::new().num_threads(options.concurrency.max(1)).build()?;
    let tasks_of: Vec<Vec<&Task>> = (0..suite.scenes.len())
        .map(|i| suite.tasks.iter().filter(|t| t.scene == i).collect())
        .collect();
    let mut results: Vec<CellResult> = options
        .cells
        .iter()
        .map(|(name, configuration)| CellResult {
            name: name.clone(),
            configuration: configuration.clone(),
            outcomes: Vec::new(),
            left_out: Vec::new(),
        })
        .collect();
    let of = suite.scenes.len() * options.cells.len();
    let mut done = 0;
    for (scene, tasks) in suite.scenes.iter().zip(&tasks_of) {
        // Cells with the same instances are run one after another, so that the scene is prepared
        // once for all of them.
        let mut order: Vec<usize> = (0..results.len()).collect();
        order.sort_by_key(|&i| source_settings(&results[i].configuration));
        let mut open: Option<OpenedScene> = None;
        for i in order {
            if open
                .as_ref()
                .is_some_and(|entered| entered.setup != source_settings(&results[i].configuration))
            {
                open = None;
            }
            let cell = CellOfScene { system, scene, tasks, out: options.out, pool: &pool };
            cell.answer_tasks(&mut results[i], &mut open)?;
            done += 1;
            (options.progress)(&Step { cell: &results[i].name, scene: &scene.id, done, of });
        }
    }
    let place: BTreeMap<&str, usize> =
        suite.tasks.iter().enumerate().map(|(i, t)| (t.id.as_str(), i)).collect();
    results
        .iter_mut()
        .for_each(|cell| cell.outcomes.sort_by_key(|o| place.get(o.id.as_str()).copied()));
    Ok(results)
}

/// Returns the settings that determine which instances a cell sees.
fn source_settings(configuration: &Configuration) -> (Source, String) {
    let Configuration { source, names, preset, settings, masks, encoder, .. } = configuration;
    (*source, format!("{names:?} {preset:?} {settings:?} {masks} {encoder}"))
}

/// A prepared scene, or the reason why it could not be prepared.
struct OpenedScene {
    setup: (Source, String),
    scene: Result<Box<dyn OpenScene>, String>,
}

struct CellOfScene<'a> {
    system: &'a dyn System,
    scene: &'a SuiteScene,
    tasks: &'a [&'a Task],
    out: &'a Utf8Path,
    pool: &'a rayon::ThreadPool,
}

impl CellOfScene<'_> {
    fn answer_tasks(
        &self,
        cell: &mut CellResult,
        open: &mut Option<OpenedScene>,
    ) -> anyhow::Result<()> {
        let key = digest::short_digest(&serde_json::to_vec(&(
            self.system.fingerprint(),
            &cell.configuration,
        ))?);
        let file = self
            .out
            .join("cells")
            .join(&key)
            .join(format!("{}.jsonl", to_file_name(&self.scene.id)));
        let content = match content_digest(self.scene, self.tasks, &cell.configuration) {
            Ok(content) => content,
            Err(error) => {
                cell.left_out
                    .extend(self.tasks.iter().map(|t| (t.id.clone(), format!("{error:#}"))));
                return Ok(());
            }
        };
        let header = Header { scene: self.scene.id.clone(), content };
        let mut log = ReplyLog::open(&file, &header)?;
        if log.token.as_ref().is_some_and(|token| !self.system.has_scene(token)) {
            log.restart(&header)?;
        }
        let missing: Vec<&Task> =
            self.tasks.iter().copied().filter(|t| log.reply(t).is_none()).collect();

        let mut failures: BTreeMap<String, String> = BTreeMap::new();
        if !missing.is_empty() {
            let entered = match self.open_scene(cell, open) {
                Ok(entered) => entered,
                Err(reason) => {
                    cell.left_out.extend(self.tasks.iter().map(|t| (t.id.clone(), reason.clone())));
                    return Ok(());
                }
            };
            log.write_boxes(entered.boxes(), entered.token())?;
            let writer = Mutex::new(&mut log);
            let ask = |&task: &&Task| {
                let hints = cell
                    .configuration
                    .paper_compatible
                    .then(|| task.hints.as_hints(PaperCompatibleRun(())));
                let asked = entered.ask(&task.expression, &cell.configuration, hints);
                let reply = match asked {
                    Ok(reply) => reply,
                    Err(error) => return Ok(Some((task.id.clone(), format!("{error:#}")))),
                };
                let mut writer = writer.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
                writer.write(task, reply).map(|()| None)
            };
            let asked: anyhow::Result<Vec<_>> =
                self.pool.install(|| missing.par_iter().map(ask).collect());
            failures.extend(asked?.into_iter().flatten());
        }

        for task in self.tasks {
            let ranked = log.reply(task).cloned().map(Ranked::new);
            let failure = || failures.get(&task.id).cloned().unwrap_or_default();
            let mut outcome = ScoredExpression::score(
                task,
                &self.scene.id,
                ranked.as_ref().ok_or_else(failure),
                &log.boxes,
            );
            if !outcome.is_right() {
                outcome.picture = self.draw_wrong_answer(&key, cell, open, &outcome)?;
            }
            cell.outcomes.push(outcome);
        }
        Ok(())
    }

    /// Returns the scene for this cell, and prepares it if necessary.
    fn open_scene<'o>(
        &self,
        cell: &CellResult,
        open: &'o mut Option<OpenedScene>,
    ) -> Result<&'o dyn OpenScene, String> {
        let entered = open.get_or_insert_with(|| OpenedScene {
            setup: source_settings(&cell.configuration),
            scene: self
                .system
                .open_scene(self.scene, &cell.configuration)
                .map_err(|error| format!("{error:#}")),
        });
        entered.scene.as_ref().map(AsRef::as_ref).map_err(Clone::clone)
    }

    /// Draws a wrong answer unless its picture exists. The file name covers the drawn content.
    fn draw_wrong_answer(
        &self,
        key: &str,
        cell: &CellResult,
        open: &mut Option<OpenedScene>,
        outcome: &ScoredExpression,
    ) -> anyhow::Result<Option<String>> {
        let drawn = pictures::boxes(outcome);
        let name = format!(
            "{}.jpg",
            digest::short_digest(&serde_json::to_vec(&(
                key,
                &outcome.scene,
                &drawn.iter().map(|b| (&b.aabb, &b.label)).collect::<Vec<_>>()
            ))?)
        );
        let file = self.out.join(pictures::FOLDER).join(&name);
        if file.metadata().map_or(0, |m| m.len()) == 0 {
            let Ok(scene) = self.open_scene(cell, open) else { return Ok(None) };
            let Some(jpeg) = pictures::draw(scene.render_scene(), &drawn) else { return Ok(None) };
            fs::write(&file, jpeg).with_context(|| file.to_string())?;
        }
        Ok(Some(name))
    }
}

/// Replies of one cell about one scene, in memory and on disk.
struct ReplyLog {
    file: File,
    boxes: Vec<Aabb>,
    token: Option<String>,
    replies: BTreeMap<String, (String, Reply)>,
}

impl ReplyLog {
    /// Opens the existing log, or starts a new one if its content differs. Reading stops at a
    /// truncated line.
    fn open(path: &Utf8Path, header: &Header) -> anyhow::Result<Self> {
        let told = || path.to_string();
        fs::create_dir_all(path.parent().unwrap_or(Utf8Path::new("."))).with_context(told)?;
        let bytes = if path.is_file() { fs::read(path).with_context(told)? } else { Vec::new() };
        let mut lines =
            bytes.split_inclusive(|byte| *byte == b'\n').filter(|line| line.ends_with(b"\n"));
        let (mut boxes, mut token, mut replies) = (Vec::new(), None, BTreeMap::new());
        let mut valid = 0;
        if let Some(line) = lines.next()
            && serde_json::from_slice::<Header>(line).is_ok_and(|found| found == *header)
        {
            valid += line.len();
            for line in lines {
                if let Ok(KeptReply { id, query, reply }) = serde_json::from_slice(line) {
                    replies.insert(id, (query, reply));
                } else if let Ok(kept) = serde_json::from_slice::<StoredScene>(line) {
                    (boxes, token) = (kept.boxes, Some(kept.token));
                } else {
                    break;
                }
                valid += line.len();
            }
        }
        let file = OpenOptions::new().create(true).append(true).open(path).with_context(told)?;
        file.set_len(valid as u64).with_context(told)?;
        let mut log = Self { file, boxes, token, replies };
        if valid == 0 {
            log.append(header)?;
        }
        Ok(log)
    }

    fn append(&mut self, line: &impl Serialize) -> anyhow::Result<()> {
        let mut text = serde_json::to_vec(line)?;
        text.push(b'\n');
        Ok(self.file.write_all(&text)?)
    }

    /// Discards all replies, because the system no longer has the scene.
    fn restart(&mut self, header: &Header) -> anyhow::Result<()> {
        self.file.set_len(0)?;
        (self.boxes, self.token, self.replies) = (Vec::new(), None, BTreeMap::new());
        self.append(header)
    }

    fn write_boxes(&mut self, boxes: &[Aabb], token: &str) -> anyhow::Result<()> {
        if self.boxes != boxes || self.token.as_deref() != Some(token) {
            self.append(&StoredScene { boxes: boxes.to_vec(), token: token.to_owned() })?;
            (self.boxes, self.token) = (boxes.to_vec(), Some(token.to_owned()));
        }
        Ok(())
    }

    fn write(&mut self, task: &Task, reply: Reply) -> anyhow::Result<()> {
        let kept = KeptReply { id: task.id.clone(), query: task.expression.query.clone(), reply };
        self.append(&kept)?;
        self.replies.insert(kept.id, (kept.query, kept.reply));
        Ok(())
    }

    fn reply(&self, task: &Task) -> Option<&Reply> {
        self.replies
            .get(&task.id)
            .filter(|(query, _)| *query == task.expression.query)
            .map(|(_, reply)| reply)
    }
}

/// Returns the data that replies depend on: the scan, the annotations if they are the source, and
/// the hints if they are passed on.
fn content_digest(
    scene: &SuiteScene,
    tasks: &[&Task],
    configuration: &Configuration,
) -> anyhow::Result<String> {
    let mut hasher = Sha256::new();
    if let Some(scan) = &scene.scan {
        digest::add_path(scan, &mut hasher).with_context(|| scan.to_string())?;
    }
    if configuration.source != Source::Parsed || configuration.names != Names::Own {
        let annotations = scene.annotations.as_ref().map(Sealed::for_reader);
        hasher.update(format!("{annotations:?} {:?}", scene.recorded));
    }
    if configuration.paper_compatible {
        tasks.iter().for_each(|task| hasher.update(format!("{:?}", task.hints.for_reader())));
    }
    Ok(digest::short_hex(hasher))
}

/// Returns a scene's id as a file name: readable, short, and unique to this id.
fn to_file_name(id: &str) -> String {
    const READABLE_CHARS: usize = 60;
    let readable: String = id
        .chars()
        .take(READABLE_CHARS)
        .map(|c| if c.is_ascii_alphanumeric() || "-_.".contains(c) { c } else { '_' })
        .collect();
    format!("{readable}-{}", digest::short_digest(id.as_bytes()))
}
