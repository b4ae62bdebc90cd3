//! Two sides of one comparison, run alternately.

use std::time::Duration;
use uniground_core::geometry::statistics::median;

/// Number of runs that count, after one warm-up run of each side.
pub const ROUNDS: usize = 9;
/// Pause between runs, so that busy-waiting threads of a peer do not take a core from the next run.
const PAUSE: Duration = Duration::from_millis(50);

/// One run: milliseconds, and a short description of the result.
pub struct Run {
    pub ms: f32,
    pub gives: String,
}

/// A timed task, or the reason why there is none.
pub type Side<'a> = Box<dyn FnMut() -> anyhow::Result<Run> + 'a>;

/// What this project's side measures.
pub enum OwnSide<'a> {
    /// The same job as the peer's.
    Same(Side<'a>),
    /// The job is part of this one and cannot be timed alone, so its time is an upper bound.
    Within(Side<'a>),
}

pub struct Comparison<'a> {
    pub what: String,
    pub ours: OwnSide<'a>,
    pub peer: Side<'a>,
    /// How the two jobs differ, for readers of the ratio.
    pub differ: String,
}

/// Medians of one comparison; a failed side has an error.
pub struct DuelResult {
    pub what: String,
    pub differ: String,
    pub ours: Result<Run, String>,
    pub peer: Result<Run, String>,
    /// Whether this project's figure is an upper bound.
    pub bound: bool,
}

impl Comparison<'_> {
    pub fn run(self) -> DuelResult {
        let Self { what, ours, mut peer, differ } = self;
        let bound = matches!(ours, OwnSide::Within(_));
        let (OwnSide::Same(mut side) | OwnSide::Within(mut side)) = ours;
        let mut own_runs = Vec::new();
        let mut peer_runs = Vec::new();
        for _ in 0..=ROUNDS {
            own_runs.push(run_once(&mut side));
            peer_runs.push(run_once(&mut peer));
        }
        DuelResult { what, differ, ours: summarize(own_runs), peer: summarize(peer_runs), bound }
    }
}

fn run_once(side: &mut Side) -> anyhow::Result<Run> {
    std::thread::sleep(PAUSE);
    side()
}

/// Returns the median of all runs except the first. One failure invalidates the row, because the
/// remaining runs would be a selection.
fn summarize(runs: Vec<anyhow::Result<Run>>) -> Result<Run, String> {
    let runs =
        runs.into_iter().collect::<anyhow::Result<Vec<_>>>().map_err(|e| format!("{e:#}"))?;
    let mut ms: Vec<f32> = runs.iter().skip(1).map(|run| run.ms).collect();
    let gives = runs.last().map(|run| run.gives.clone()).unwrap_or_default();
    Ok(Run { ms: median(&mut ms).unwrap_or_default(), gives })
}
