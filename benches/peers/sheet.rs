//! The table of all comparisons, for the terminal and for `benches/PEERS.md`.

use crate::duel::{DuelResult, ROUNDS, Run};
use comfy_table::{Table, presets};
use std::fmt::Write;
use std::thread::available_parallelism;

/// Formats the whole report: machine, versions, figures, and how to read them.
pub fn format_report(
    input: &str,
    load: &str,
    versions: &[Option<String>],
    outcomes: &[DuelResult],
) -> String {
    let mut table = Table::new();
    table.load_preset(presets::ASCII_MARKDOWN).set_header([
        "",
        "uniground, ms",
        "peer, ms",
        "ratio",
        "uniground returns",
        "peer returns",
    ]);
    table.add_rows(outcomes.iter().map(row));
    let mut notes = String::new();
    for DuelResult { what, differ, .. } in outcomes {
        let _ = writeln!(notes, "- {what}: {differ}");
    }
    let versions: String = versions.iter().flatten().map(|v| format!("- {v}\n")).collect();
    let date = jiff::Timestamp::now().strftime("%Y-%m-%d");
    format!(
        "# Comparison with other libraries\n\n\
         Written by `make bench-peers` on {date}, {machine}, load {load} before. Input: {input}. Medians of {ROUNDS} rounds \
         after a warm-up, alternating, with a short pause between runs so that busy-waiting threads do not affect the next \
         run. Each side times itself, from data in memory to the result in memory unless a file is read. Absolute times \
         differ between machines; compare the ratios.\n\n\
         {versions}\n{table}\n\n\
         How the two sides differ:\n\n{notes}",
        machine = machine()
    )
}

fn row(outcome: &DuelResult) -> [String; 6] {
    let DuelResult { what, ours, peer, bound, .. } = outcome;
    let sign = if *bound { "< " } else { "" };
    let left_out = |why: &str| ("-".to_owned(), format!("skipped: {}", why.replace('|', "/")));
    let told = |side: &Result<Run, String>, sign: &str| match side {
        Ok(Run { ms, gives }) => (format!("{sign}{}", figure(*ms)), gives.clone()),
        Err(why) => left_out(why),
    };
    let (own_ms, own_gives) = told(ours, sign);
    let (peer_ms, peer_gives) = told(peer, "");
    let ratio = match (ours, peer) {
        (Ok(own), Ok(peer)) => format!("{sign}{:.2}", own.ms / peer.ms),
        _ => "-".into(),
    };
    [what.clone(), own_ms, peer_ms, ratio, own_gives, peer_gives]
}

/// Rounds milliseconds to what a median of nine runs can distinguish.
fn figure(ms: f32) -> String {
    match ms {
        ..1.0 => format!("{ms:.3}"),
        1.0..100.0 => format!("{ms:.1}"),
        _ => format!("{ms:.0}"),
    }
}

fn machine() -> String {
    let info = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let model = info
        .lines()
        .find_map(|l| l.strip_prefix("model name")?.split_once(": ").map(|(_, m)| m.trim()));
    let cores = available_parallelism().map_or_else(|_| "?".into(), |n| n.to_string());
    format!(
        "{}, {cores} cores, {} threads for uniground",
        model.unwrap_or("unknown processor"),
        rayon::current_num_threads()
    )
}

/// Returns the machine's load in the minute before: on a loaded machine the side that uses more
/// cores loses more.
pub fn load() -> String {
    let averages = std::fs::read_to_string("/proc/loadavg").unwrap_or_default();
    averages.split(' ').next().filter(|load| !load.is_empty()).unwrap_or("unknown").to_owned()
}
