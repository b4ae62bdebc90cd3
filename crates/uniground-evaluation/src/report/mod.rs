//! Reports: JSON for machines, Markdown for pull requests, one HTML page for people.

mod charts;
mod html;
mod markdown;

use super::configuration::Configuration;
use super::measures::Figures;
use super::records::Omission;
use super::run::CellResult;
use super::scoring::ScoredExpression;
use super::suite::Suite;
use anyhow::{Context, ensure};
use camino::Utf8Path;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::fs;
use uniground_grounding::reasoner::builtin;
use uniground_types::answer::Models;

const FORMAT: &str = "uniground-report/1";

/// All results of a run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Report {
    pub format: String,
    pub suite: String,
    pub run: RunFacts,
    pub scenes: usize,
    /// Number of expressions that could be scored.
    pub expressions: usize,
    /// Parts of the suite that could not be used.
    pub omissions: Vec<Omission>,
    pub cells: Vec<CellReport>,
}

/// The origin of the figures.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RunFacts {
    /// `in process`, or the server's address.
    pub system: String,
    pub version: String,
    /// The caller's label for this run, e.g. a commit.
    pub label: Option<String>,
    pub machine: String,
    /// RFC 3339, UTC.
    pub written_at: String,
    /// Whether annotated classes and anchors were given to the system. Such a run is not leak-free.
    pub paper_compatible: bool,
    /// Seed of the bootstrap.
    pub seed: u64,
}

/// One cell of the table.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CellReport {
    pub name: String,
    pub configuration: Configuration,
    /// Models as named in the replies. `None` when the replies name none.
    pub models: Option<Models>,
    /// Notes that are needed to interpret the figures.
    pub notes: Vec<String>,
    pub figures: Figures,
    pub splits: BTreeMap<String, Figures>,
    pub by_scene: BTreeMap<String, Figures>,
    /// Expressions whose scene could not be used by this cell, with the reason.
    pub left_out: Vec<LeftOut>,
    pub outcomes: Vec<ScoredExpression>,
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct LeftOut {
    pub id: String,
    pub reason: String,
}

impl Report {
    #[must_use]
    pub fn new(suite: &Suite, run: RunFacts, cells: Vec<CellResult>) -> Self {
        let seed = run.seed;
        Self {
            format: FORMAT.into(),
            suite: suite.name.clone(),
            scenes: suite.scenes.len(),
            expressions: suite.tasks.len(),
            omissions: suite.omissions.clone(),
            cells: cells.into_iter().map(|cell| CellReport::new(cell, seed)).collect(),
            run,
        }
    }

    /// Reads a `report.json`, from its path or its folder.
    ///
    /// # Errors
    /// Returns an error for an unreadable file, or one that is not a report.
    pub fn read(path: &Utf8Path) -> anyhow::Result<Self> {
        let file = if path.is_dir() { path.join("report.json") } else { path.to_owned() };
        let text = fs::read_to_string(&file).with_context(|| file.to_string())?;
        let report: Self = serde_json::from_str(&text).with_context(|| file.to_string())?;
        ensure!(
            report.format == FORMAT,
            "{file}: the format is {:?}, expected {FORMAT:?}",
            report.format
        );
        Ok(report)
    }

    /// Writes `report.json`, `report.md` and `index.html`. Pictures are taken from the folder. The
    /// first `embedded` of them per cell are embedded in the page, the others are linked.
    ///
    /// # Errors
    /// Returns an error when the folder cannot be written.
    pub fn write(&self, folder: &Utf8Path, embedded: usize) -> anyhow::Result<()> {
        let write = |name: &str, content: Vec<u8>| {
            fs::write(folder.join(name), content).with_context(|| folder.join(name).to_string())
        };
        write("report.json", serde_json::to_vec(self)?)?;
        write("report.md", self.markdown().into_bytes())?;
        write("index.html", html::render_page(self, folder, embedded).into_bytes())
    }

    /// Returns the Markdown tables.
    #[must_use]
    pub fn markdown(&self) -> String {
        markdown::render_page(self)
    }
}

impl CellReport {
    fn new(CellResult { name, configuration, outcomes, left_out }: CellResult, seed: u64) -> Self {
        let mut splits: BTreeMap<&str, Vec<&ScoredExpression>> = BTreeMap::new();
        let mut by_scene: BTreeMap<&str, Vec<&ScoredExpression>> = BTreeMap::new();
        for outcome in &outcomes {
            outcome.splits.iter().for_each(|split| splits.entry(split).or_default().push(outcome));
            by_scene.entry(&outcome.scene).or_default().push(outcome);
        }
        let figures = |groups: BTreeMap<&str, Vec<&ScoredExpression>>| {
            groups
                .into_iter()
                .map(|(name, group)| (name.to_owned(), Figures::from_outcomes(&group, seed)))
                .collect()
        };
        // If the built-in reasoner was the fallback for some questions, the cell is still
        // attributed to the model.
        let replies =
            || outcomes.iter().filter_map(|o| o.reply.as_ref()).map(|reply| &reply.models);
        let models = replies()
            .find(|models| models.reasoner != builtin::NAME)
            .or_else(|| replies().next())
            .cloned();
        Self {
            notes: notes(&configuration, models.as_ref()),
            figures: Figures::from_outcomes(&outcomes.iter().collect::<Vec<_>>(), seed),
            splits: figures(splits),
            by_scene: figures(by_scene),
            left_out: left_out.into_iter().map(|(id, reason)| LeftOut { id, reason }).collect(),
            name,
            configuration,
            models,
            outcomes,
        }
    }

    /// Returns wrong answers, in the order of the suite.
    pub fn failures(&self) -> impl Iterator<Item = &ScoredExpression> {
        self.outcomes.iter().filter(|o| !o.is_right())
    }
}

/// Escapes text for HTML.
#[must_use]
pub fn escape_html(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

fn notes(configuration: &Configuration, models: Option<&Models>) -> Vec<String> {
    use uniground_types::question::Ablation;
    let builtin = models.is_some_and(|m| m.reasoner == builtin::NAME);
    let mut notes = Vec::new();
    if builtin && configuration.ablation != Ablation::Full {
        notes.push("the built-in reasoner has no prompt: ablations change nothing".into());
    }
    if configuration.paper_compatible {
        notes
            .push("paper-compatible: annotated target classes and anchors were handed over".into());
    }
    notes
}
