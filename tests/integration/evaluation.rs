//! `uniground eval` on the sample scene: figures, resuming, reports, comparison.

use crate::test_server::TestServer;
use camino::{Utf8Path, Utf8PathBuf};
use std::fs;
use std::process::{Command, Output};
use uniground_evaluation::configuration::{self, Configuration};
use uniground_evaluation::report::Report;
use uniground_evaluation::run::{RunOptions, run};
use uniground_evaluation::suite::{Suite, SuiteOptions};
use uniground_evaluation::systems::Server;

const EXAMPLES: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/examples");

fn run_eval(out: &Utf8Path, args: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_uniground"));
    command.args(["eval", EXAMPLES, "--out", out.as_str()]).args(args).output().unwrap()
}

fn to_text(output: &[u8]) -> String {
    String::from_utf8_lossy(output).into_owned()
}

/// Returns a fresh folder.
fn temp_folder() -> (tempfile::TempDir, Utf8PathBuf) {
    let temporary = tempfile::tempdir().unwrap();
    let path = Utf8PathBuf::from_path_buf(temporary.path().to_owned()).unwrap();
    (temporary, path)
}

/// Returns a report without the values that differ from run to run.
fn comparable_report(out: &Utf8Path) -> Report {
    let mut report = Report::read(out).unwrap();
    report.run.written_at.clear();
    for cell in &mut report.cells {
        let figures = cell.splits.values_mut().chain(cell.by_scene.values_mut());
        figures.chain([&mut cell.figures]).for_each(|f| f.latency_ms = None);
        cell.outcomes.iter_mut().filter_map(|o| o.reply.as_mut()).for_each(|r| r.latency_ms = 0.0);
    }
    report
}

fn list_files(folder: &Utf8Path) -> Vec<Utf8PathBuf> {
    let mut files = Vec::new();
    for entry in folder.read_dir_utf8().unwrap() {
        let path = entry.unwrap().into_path();
        if path.is_dir() { files.extend(list_files(&path)) } else { files.push(path) }
    }
    files
}

#[test]
fn a_run_scores_every_source_and_resumes() {
    let (_keep, out) = temp_folder();
    let matrix = ["--matrix", "source=parsed,oracle,oracle-boxes"];
    let first = run_eval(&out, &matrix);
    assert!(first.status.success(), "{}", to_text(&first.stderr));
    println!("{}", to_text(&first.stdout));
    let report = comparable_report(&out);
    let names: Vec<&str> = report.cells.iter().map(|c| c.name.as_str()).collect();
    assert_eq!(names, ["source=parsed", "source=oracle", "source=oracle-boxes"]);
    for cell in &report.cells {
        assert_eq!(
            (cell.figures.expressions, cell.figures.complete[0].of, cell.figures.abstention.absent),
            (19, 16, 3)
        );
        assert_eq!(cell.by_scene.keys().collect::<Vec<_>>(), ["living_room"]);
    }
    // Perfect boxes and names can only raise the figures; a target's own box is the upper bound.
    let [parsed, oracle, boxes] = &report.cells[..] else { panic!("{names:?}") };
    assert!(
        oracle.figures.complete[0].value >= parsed.figures.complete[0].value,
        "{:?} {:?}",
        oracle.figures.complete,
        parsed.figures.complete
    );
    assert_eq!((oracle.figures.any_instance, boxes.figures.any_instance), ([1.0; 2], [1.0; 2]));
    assert!(
        oracle.figures.complete[0].value >= 0.85,
        "language and space alone: {:?}",
        oracle.figures.complete
    );

    // Every wrong answer is on the page with its image, and the page needs no other file.
    let page = fs::read_to_string(out.join("index.html")).unwrap();
    for failure in report.cells.iter().flat_map(uniground_evaluation::report::CellReport::failures)
    {
        let picture = failure.picture.as_ref().unwrap();
        assert!(out.join("pictures").join(picture).is_file(), "{failure:?}");
        assert!(page.contains(&failure.query), "{}", failure.query);
    }
    assert!(page.contains("data:image/jpeg;base64,") && !page.contains("src=\"pictures/"));

    // The file ends in the middle of a reply: only the missing questions are asked again, and the
    // result is the same.
    let logs = list_files(&out.join("cells"));
    assert_eq!(logs.len(), 3);
    let before: Vec<Vec<u8>> = logs.iter().map(|log| fs::read(log).unwrap()).collect();
    fs::write(&logs[0], &before[0][..before[0].len() - 40]).unwrap();
    let second = run_eval(&out, &matrix);
    assert!(second.status.success(), "{}", to_text(&second.stderr));
    assert_eq!(comparable_report(&out), report);
    assert_eq!(fs::read(&logs[1]).unwrap(), before[1], "a stored reply was asked again");
    let lines = |bytes: &[u8]| bytes.split(|b| *b == b'\n').count();
    assert_eq!(lines(&fs::read(&logs[0]).unwrap()), lines(&before[0]));
}

#[test]
fn a_server_gives_the_same_figures_as_the_process() {
    let (_keep, out) = temp_folder();
    let local = run_eval(&out, &["--concurrency", "4"]);
    assert!(local.status.success(), "{}", to_text(&local.stderr));
    let local = comparable_report(&out);

    let runtime = tokio::runtime::Runtime::new().unwrap();
    let server = runtime.block_on(TestServer::start());
    let (_keep, remote_out) = temp_folder();
    let suite = Suite::open(Utf8Path::new(EXAMPLES), &SuiteOptions::default()).unwrap();
    let cells = configuration::expand_matrix("", &Configuration::default()).unwrap();
    let system = Server::connect(&server.url(), None).unwrap();
    let options = RunOptions { out: &remote_out, cells: &cells, concurrency: 1, progress: &|_| {} };
    let remote = Report::new(&suite, local.run.clone(), run(&suite, &system, &options).unwrap());
    for (here, there) in local.cells[0].outcomes.iter().zip(&remote.cells[0].outcomes) {
        assert_eq!(
            (&here.id, here.is_right(), here.status()),
            (&there.id, there.is_right(), there.status())
        );
        assert_eq!(
            here.target.as_ref().map(|t| &t.candidate_ious),
            there.target.as_ref().map(|t| &t.candidate_ious),
            "{}",
            here.query
        );
    }
    // The server still has the scene on the second run.
    let (_keep, again_out) = temp_folder();
    let options = RunOptions { out: &again_out, ..options };
    run(&suite, &system, &options).unwrap();
    assert_eq!(runtime.block_on(server.client.scenes(100, None)).unwrap().scenes.len(), 1);
    // If the server lost the scene, all questions are asked again although every reply is stored,
    // because the server might answer differently.
    let scenes = || runtime.block_on(server.client.scenes(100, None)).unwrap().scenes;
    let lost = scenes()[0].id.clone();
    runtime.block_on(server.client.delete_scene(&lost)).unwrap();
    let asked_again = run(&suite, &system, &options).unwrap();
    assert!(scenes().len() == 1 && scenes()[0].id != lost);
    assert_eq!(asked_again[0].outcomes.len(), suite.tasks.len());
    // Options that need an in-process run are refused before any question is asked.
    let oracle = configuration::expand_matrix("source=oracle", &Configuration::default()).unwrap();
    let refused = run(&suite, &system, &RunOptions { cells: &oracle, ..options }).unwrap_err();
    assert!(format!("{refused:#}").contains("run without --server"), "{refused:#}");
    drop(system);
    runtime.block_on(server.stop());
}

#[test]
fn a_drop_against_the_baseline_fails_and_lists_the_lost_answers() {
    let (_keep, out) = temp_folder();
    let baseline = out.join("baseline.json");
    let matrix = ["--matrix", "source=oracle"];
    let written = run_eval(&out, &[&matrix[..], &["--write-baseline", baseline.as_str()]].concat());
    assert!(written.status.success(), "{}", to_text(&written.stderr));
    let held = run_eval(&out, &[&matrix[..], &["--baseline", baseline.as_str()]].concat());
    assert!(held.status.success(), "{}", to_text(&held.stderr));

    // The same expressions with most of the targets exchanged, so that correct answers become
    // wrong.
    let worse = out.join("worse");
    fs::create_dir(&worse).unwrap();
    for name in ["living_room.zip", "living_room.scene.json"] {
        fs::copy(Utf8Path::new(EXAMPLES).join(name), worse.join(name)).unwrap();
    }
    let queries =
        fs::read_to_string(Utf8Path::new(EXAMPLES).join("living_room.queries.json")).unwrap();
    let lines =
        queries.lines().enumerate().map(|(i, line)| match line.split_once("\"target_id\": ") {
            Some((head, tail)) if i < 13 => {
                format!("{head}\"target_id\": 1{}", &tail[tail.find(',').unwrap()..])
            }
            _ => line.to_owned(),
        });
    fs::write(worse.join("living_room.queries.json"), lines.collect::<Vec<_>>().join("\n"))
        .unwrap();
    let mut command = Command::new(env!("CARGO_BIN_EXE_uniground"));
    let fallen = command
        .args(["eval", worse.as_str(), "--out", out.join("worse-out").as_str()])
        .args(matrix);
    let fallen = fallen.args(["--baseline", baseline.as_str()]).output().unwrap();
    assert_eq!(fallen.status.code(), Some(1));
    assert!(
        to_text(&fallen.stderr).contains("significantly worse than the baseline: source=oracle"),
        "{}",
        to_text(&fallen.stderr)
    );
    assert!(
        to_text(&fallen.stdout).contains(": the dining table")
            && to_text(&fallen.stdout).contains("lost in source=oracle: living_room#1~"),
        "{}",
        to_text(&fallen.stdout)
    );

    let mut command = Command::new(env!("CARGO_BIN_EXE_uniground"));
    let difference = command
        .args(["eval", "diff", out.as_str(), out.join("worse-out").as_str()])
        .output()
        .unwrap();
    assert!(difference.status.success(), "{}", to_text(&difference.stderr));
    assert!(to_text(&difference.stdout).contains("**drop**"), "{}", to_text(&difference.stdout));
}

#[test]
fn unusable_scenes_are_skipped_and_reported() {
    let (_keep, root) = temp_folder();
    fs::copy(
        Utf8Path::new(EXAMPLES).join("living_room.scene.json"),
        root.join("broken.scene.json"),
    )
    .unwrap();
    fs::copy(Utf8Path::new(EXAMPLES).join("living_room.scene.json"), root.join("bare.scene.json"))
        .unwrap();
    fs::write(root.join("broken.zip"), "this is no archive").unwrap();
    let query = r#"[{"query": "the dining table", "target_id": 19}, {"query": "the hat", "target_id": 99}]"#;
    fs::write(root.join("broken.queries.json"), query).unwrap();
    fs::write(root.join("bare.queries.json"), query).unwrap();
    let out = root.join("out");
    let mut command = Command::new(env!("CARGO_BIN_EXE_uniground"));
    let output = command
        .args(["eval", root.as_str(), "--out", out.as_str(), "--matrix", "source=parsed,oracle"])
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", to_text(&output.stderr));
    let told = to_text(&output.stderr);
    assert!(
        told.contains("bare.queries.json:1: target 99 is not in the annotations of bare"),
        "{told}"
    );
    let report = Report::read(&out).unwrap();
    assert_eq!((report.expressions, report.omissions.len()), (2, 2));
    let [parsed, oracle] = &report.cells[..] else { panic!() };
    assert_eq!((parsed.outcomes.len(), parsed.left_out.len()), (0, 2));
    assert!(
        parsed.left_out.iter().any(|l| l.reason.contains("has no scan")),
        "{:?}",
        parsed.left_out
    );
    // Annotations alone are enough for the oracle source. A broken scan next to them is still
    // reported.
    assert_eq!(
        oracle.outcomes.iter().map(|o| (o.id.as_str(), o.is_right())).collect::<Vec<_>>(),
        [("bare#1", true)]
    );
    assert_eq!(oracle.left_out.len(), 1);
}

/// Writes a task folder with a room of three boxes. Its stage 1 result is in `ref.json`, with Y up.
fn write_task_folder(root: &Utf8Path, target_name: &str) {
    let folder = root.join("scene0001_00/1");
    fs::create_dir_all(&folder).unwrap();
    let write = |name: &str, text: &str| fs::write(folder.join(name), text).unwrap();
    let target = "[1.5, 0.4, -2.0, 2.0, 0.8, 0.9]";
    write(
        "task.json",
        &format!(
            r#"{{"scan_id": "scene0001_00", "target_id": "3", "target_name": "{target_name}", "caption": "the zorgle"}}"#
        ),
    );
    write("gt.json", &format!(r#"{{"target_id": 3, "gt_bbox": {target}}}"#));
    write(
        "ref.json",
        &format!(
            r#"{{"3": {{"bbox": {target}}}, "4": {{"bbox": [-1.0, 0.78, 0.0, 0.1, 0.1, 0.1]}}}}"#
        ),
    );
    write("anchor.json", r#"{"anchor": "door", "bbox": [0, 1, -3, 0.9, 2, 0.1]}"#);
    let points: Vec<String> = (0..2000_u16)
        .map(|i| {
            format!("{} {} {} 120 60 60", f32::from(i % 50) * 0.1, f32::from(i / 50) * 0.1, 0.0)
        })
        .collect();
    let names = ["float x", "float y", "float z", "uchar red", "uchar green", "uchar blue"]
        .map(|p| format!("property {p}\n"))
        .concat();
    write(
        "full_pcd.ply",
        &format!(
            "ply\nformat ascii 1.0\nelement vertex {}\n{names}end_header\n{}\n",
            points.len(),
            points.join("\n")
        ),
    );
}

#[test]
fn hints_are_used_only_in_paper_compatible_runs() {
    let (_keep, root) = temp_folder();
    let run_with = |args: &[&str]| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_uniground"));
        let out = root.join("out");
        let output = command
            .args([
                "eval",
                root.join("tasks").as_str(),
                "--out",
                out.as_str(),
                "--matrix",
                "source=recorded",
            ])
            .args(args)
            .output()
            .unwrap();
        assert!(output.status.success(), "{}", to_text(&output.stderr));
        Report::read(&out).unwrap()
    };
    write_task_folder(&root.join("tasks"), "sofa");
    // "Zorgle" is an unknown word, and a run without hints gets no explanation of it.
    let plain = run_with(&[]);
    assert_eq!(
        (plain.cells[0].figures.expressions, plain.cells[0].figures.complete[0].value),
        (1, 0.0)
    );
    assert!(!plain.run.paper_compatible && plain.cells[0].notes.is_empty());
    let told = run_with(&["--paper-compatible"]);
    assert_eq!(told.cells[0].figures.complete[0].value, 1.0, "{:?}", told.cells[0].outcomes);
    assert!(told.run.paper_compatible && told.cells[0].notes[0].contains("paper-compatible"));
    // Other hints make another question: stored replies do not answer it.
    write_task_folder(&root.join("tasks"), "mug");
    assert_eq!(run_with(&["--paper-compatible"]).cells[0].figures.complete[0].value, 0.0);
}

#[test]
fn a_run_without_scores_fails_with_a_reason() {
    let (_keep, root) = temp_folder();
    fs::copy(
        Utf8Path::new(EXAMPLES).join("living_room.scene.json"),
        root.join("broken.scene.json"),
    )
    .unwrap();
    fs::write(root.join("broken.zip"), "this is no archive").unwrap();
    fs::write(
        root.join("broken.queries.json"),
        r#"[{"query": "the dining table", "target_id": 19}]"#,
    )
    .unwrap();
    let mut command = Command::new(env!("CARGO_BIN_EXE_uniground"));
    let output =
        command.args(["eval", root.as_str(), "--out", root.join("out").as_str()]).output().unwrap();
    assert_eq!(output.status.code(), Some(1));
    let told = to_text(&output.stderr);
    assert!(
        told.contains("1 of 1 expressions skipped") && told.contains("nothing was scored"),
        "{told}"
    );
}

#[test]
fn usage_errors_are_reported_before_the_run() {
    let (_keep, out) = temp_folder();
    for (args, expected) in [
        (&["--matrix", "colour=red"][..], "the axes are source"),
        (&["--concurrency", "0"], "0 is not in 1..=256"),
        (&["--matrix", "top_k=5,1000"], "expected 1 to 100"),
    ] {
        let output = run_eval(&out, args);
        assert_eq!(output.status.code(), Some(2), "{args:?}");
        assert!(to_text(&output.stderr).contains(expected), "{}", to_text(&output.stderr));
    }
    for (args, expected) in [
        (&["--matrix", "reasoner=vlm"][..], "no vision-language model is configured"),
        (&["--matrix", "encoder=no-such-bundle"], "no-such-bundle/model.json"),
        (&["--server", "http://127.0.0.1:1"], "cannot connect to the server at http://127.0.0.1:1"),
        (&["--baseline", "no-such.json"], "no-such.json"),
    ] {
        let output = run_eval(&out, args);
        assert_eq!(output.status.code(), Some(1), "{args:?}");
        assert!(to_text(&output.stderr).contains(expected), "{}", to_text(&output.stderr));
    }
}
