//! `uniground migrate`: moves a store to another folder, another database, or both. No server may
//! use either.

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

#[allow(clippy::doc_markdown)] // Help is plain text.
#[derive(Debug, clap::Args)]
pub struct MigrateArgs {
    /// Data folder to move. Its server must be stopped. The folder is not changed
    #[arg(long, value_name = "FOLDER")]
    from: Utf8PathBuf,
    /// Source database: "sqlite" (a file in the folder) or postgres://USER@HOST/DATABASE
    #[arg(
        long,
        env = "UNIGROUND_FROM_DATABASE",
        hide_env_values = true,
        value_name = "DATABASE",
        default_value = "sqlite"
    )]
    from_database: Location,
    /// Destination folder, empty or not existing yet. Give the same folder as --from to move only
    /// the database
    #[arg(long, value_name = "FOLDER")]
    to: Utf8PathBuf,
    /// Destination database: "sqlite", or postgres://USER@HOST/DATABASE (an existing, empty
    /// database)
    #[arg(
        long,
        env = "UNIGROUND_TO_DATABASE",
        hide_env_values = true,
        value_name = "DATABASE",
        default_value = "sqlite"
    )]
    to_database: Location,
    /// Print the result as JSON
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
        println!("already damaged, copied unchanged: {folder}: {what}");
    }
    if moved.texts_changed > 0 {
        println!(
            "in {} texts, NUL characters were replaced by U+FFFD because PostgreSQL cannot store \
             them",
            moved.texts_changed
        );
    }
    println!("next: {}", next_steps(&from, &to, &moved));
    Ok(())
}

fn describe_location(place: &StoreLocation) -> String {
    format!("{} ({})", place.data_dir, place.database)
}

/// Returns the next steps for the user.
fn next_steps(from: &StoreLocation, to: &StoreLocation, moved: &MigrationReport) -> String {
    let database = if to.database == Location::Folder {
        "sqlite".to_owned()
    } else {
        format!("{} (as given to this command)", to.database)
    };
    let start = format!("start the server with --data-dir {} --database {database}", to.data_dir);
    let (is_in_place, rows) = (moved.files.is_empty(), format!("the rows in {}", from.database));
    let old = match &moved.set_aside {
        Some(file) => file.to_string(),
        None if is_in_place => rows,
        None if from.database == Location::Folder => from.data_dir.to_string(),
        None => format!("{} and {rows}", from.data_dir),
    };
    format!("{start}. After you have checked it, remove {old}, which is no longer used.")
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

/// Shows progress: a bar on a terminal, otherwise one line per part.
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
