//! `uniground migrate`: a store moved over to another folder, another database, or both. No server
//! may run on either.

use super::output::print_json;
use super::table;
use crate::telemetry;
use camino::Utf8PathBuf;
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use serde_json::json;
use std::io::{self, IsTerminal};
use std::sync::{Arc, Mutex};
use std::time::Instant;
use uniground_storage::{
    Location, MigrationProgress, MigrationReport, StoreLocation, migrate_data,
};

#[allow(clippy::doc_markdown)] // Help is no Markdown.
#[derive(Debug, clap::Args)]
pub struct MigrateArgs {
    /// The data folder that is moved; its server must not run. It stays as it is
    #[arg(long, value_name = "FOLDER")]
    from: Utf8PathBuf,
    /// Where its rows are: "sqlite", in a file of the folder, or postgres://USER@HOST/DATABASE
    #[arg(
        long,
        env = "UNIGROUND_FROM_DATABASE",
        hide_env_values = true,
        value_name = "DATABASE",
        default_value = "sqlite"
    )]
    from_database: Location,
    /// Where it goes: an empty folder, or one that is not there yet. The same folder: only its
    /// rows move, to the other database
    #[arg(long, value_name = "FOLDER")]
    to: Utf8PathBuf,
    /// Where its rows go: "sqlite", or postgres://USER@HOST/DATABASE, an empty database that is
    /// there
    #[arg(
        long,
        env = "UNIGROUND_TO_DATABASE",
        hide_env_values = true,
        value_name = "DATABASE",
        default_value = "sqlite"
    )]
    to_database: Location,
    /// Print what was moved as JSON
    #[arg(long)]
    json: bool,
}

pub async fn run(args: &MigrateArgs) -> anyhow::Result<()> {
    telemetry::start_quiet_about_statements();
    let MigrateArgs { from, from_database, to, to_database, json: as_json } = args;
    let (from, to) = (
        StoreLocation { data_dir: from.clone(), database: from_database.clone() },
        StoreLocation { data_dir: to.clone(), database: to_database.clone() },
    );
    let begun = Instant::now();
    let shown = Arc::new(Mutex::new(ProgressBarView::default()));
    let teller = shown.clone();
    let on_progress = move |progress| {
        if let Ok(mut shown) = teller.lock() {
            shown.show_progress(progress);
        }
    };
    let moved = migrate_data(&from, &to, Arc::new(on_progress)).await;
    if let Ok(mut shown) = shown.lock() {
        shown.clear();
    }
    let moved = moved?;
    if *as_json {
        return print_json(&to_json(&from, &to, &moved));
    }
    println!("{}", table::migration_table(&moved));
    println!(
        "moved from {} to {} in {:.1} s",
        describe_location(&from),
        describe_location(&to),
        begun.elapsed().as_secs_f32()
    );
    for (folder, what) in &moved.damaged {
        println!("damaged before, and as it was: {folder}: {what}");
    }
    if moved.texts_changed > 0 {
        println!(
            "{} texts had a character that PostgreSQL does not keep (NUL): U+FFFD stands there",
            moved.texts_changed
        );
    }
    println!("next: {}", next_steps(&from, &to, &moved));
    Ok(())
}

fn describe_location(place: &StoreLocation) -> String {
    format!("{} ({})", place.data_dir, place.database)
}

/// What is to be done now.
fn next_steps(from: &StoreLocation, to: &StoreLocation, moved: &MigrationReport) -> String {
    let database = if to.database == Location::Folder {
        "sqlite".to_owned()
    } else {
        format!("{}, as it was said here", to.database)
    };
    let start = format!("start the server with --data-dir {} --database {database}", to.data_dir);
    let (is_in_place, rows) = (moved.files.is_empty(), format!("the rows in {}", from.database));
    let old = match &moved.set_aside {
        Some(file) => file.to_string(),
        None if is_in_place => rows,
        None if from.database == Location::Folder => from.data_dir.to_string(),
        None => format!("{} and {rows}", from.data_dir),
    };
    format!("{start}; when all is well, remove {old}: nothing uses it any more")
}

fn to_json(from: &StoreLocation, to: &StoreLocation, moved: &MigrationReport) -> serde_json::Value {
    let MigrationReport { rows, texts_changed, files, damaged, set_aside } = moved;
    let place = |place: &StoreLocation| json!({"data_dir": place.data_dir, "database": place.database.to_string()});
    let rows: serde_json::Map<_, _> =
        rows.iter().map(|(table, rows)| ((*table).to_owned(), (*rows).into())).collect();
    let files: Vec<_> = files
        .iter()
        .map(|kind| json!({"kind": kind.kind, "folders": kind.folders, "bytes": kind.bytes, "copied_bytes": kind.copied_bytes}))
        .collect();
    let damaged: Vec<_> =
        damaged.iter().map(|(folder, what)| json!({"folder": folder, "what": what})).collect();
    json!({
        "from": place(from), "to": place(to), "rows": rows, "texts_changed": texts_changed, "files": files, "damaged": damaged,
        "set_aside": set_aside,
    })
}

/// A bar on a terminal, a line a part elsewhere.
#[derive(Default)]
struct ProgressBarView {
    part: Option<String>,
    bar: Option<ProgressBar>,
}

impl ProgressBarView {
    fn show_progress(&mut self, MigrationProgress { part, done, of }: MigrationProgress) {
        let name = part.to_string();
        if self.part.as_ref() != Some(&name) {
            self.clear();
            match io::stderr().is_terminal() {
                true => self.bar = Some(progress_bar(&name, of)),
                false if of > 0 => eprintln!("{name}: {of}"),
                false => {}
            }
            self.part = Some(name);
        }
        if let Some(bar) = &self.bar {
            bar.set_position(done);
        }
    }

    fn clear(&mut self) {
        if let Some(bar) = self.bar.take() {
            bar.finish_and_clear();
        }
    }
}

const TEMPLATE: &str = "{msg:<26} {bar:30} {pos} of {len}, {eta} left";

fn progress_bar(name: &str, of: u64) -> ProgressBar {
    let bar = ProgressBar::with_draw_target(Some(of), ProgressDrawTarget::stderr());
    if let Ok(style) = ProgressStyle::with_template(TEMPLATE) {
        bar.set_style(style);
    }
    bar.with_message(name.to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_progress_bar_template_is_valid() {
        assert!(ProgressStyle::with_template(TEMPLATE).is_ok());
    }
}
