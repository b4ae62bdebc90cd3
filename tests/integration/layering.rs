//! Imports run downwards only, as ARCHITECTURE.md draws the house.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

/// Floors from the top; modules on one floor do not know each other.
const FLOORS: &[&[&str]] = &[
    &["cli"],
    &["evaluation"],
    &["app", "client"],
    &["config", "telemetry"],
    &["http"],
    &["service"],
    &["error"],
    &["jobs"],
    &["store", "ingest", "scene_parsing", "grounding"],
    &["models", "render"],
    &["scene"],
    &["geometry", "progress"],
];

/// What leans on its own floor by design.
const ALLOWED: &[(&str, &str)] = &[("telemetry", "config")];

fn sources(folder: &Path, found: &mut Vec<PathBuf>) {
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            sources(&path, found);
        } else if path.extension().is_some_and(|e| e == "rs") {
            found.push(path);
        }
    }
}

/// The top-level modules a source file names, `use` lines and inline paths alike; tests may look anywhere.
fn imports(text: &str) -> Vec<String> {
    let code: String = text
        .split("#[cfg(test)]")
        .next()
        .unwrap_or_default()
        .lines()
        .filter(|l| !l.trim_start().starts_with("//"))
        .collect();
    let mut names = Vec::new();
    for rest in code.split("crate::").skip(1) {
        let name: String = rest.chars().take_while(|c| c.is_alphanumeric() || *c == '_').collect();
        if !name.is_empty() {
            names.push(name);
        }
    }
    names
}

#[test]
fn imports_run_downwards_only() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let floor: BTreeMap<&str, usize> = FLOORS.iter().enumerate().flat_map(|(i, names)| names.iter().map(move |n| (*n, i))).collect();
    let mut files = Vec::new();
    sources(&root, &mut files);
    assert!(files.len() > 50, "only {} files found", files.len());
    let mut wrong = Vec::new();
    for file in files {
        let relative = file.strip_prefix(&root).unwrap().to_str().unwrap().to_owned();
        let module = relative.split(['/', '.']).next().unwrap().to_owned();
        if matches!(module.as_str(), "lib" | "main") {
            continue;
        }
        let Some(&own) = floor.get(module.as_str()) else {
            wrong.push(format!("{relative}: the module {module} stands on no floor"));
            continue;
        };
        for name in imports(&fs::read_to_string(&file).unwrap()) {
            let downwards = floor.get(name.as_str()).is_some_and(|&other| other > own);
            if name != module && !downwards && !ALLOWED.contains(&(module.as_str(), name.as_str())) {
                wrong.push(format!("{relative} imports {name}"));
            }
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn files_stay_small() {
    let mut files = Vec::new();
    sources(&Path::new(env!("CARGO_MANIFEST_DIR")).join("src"), &mut files);
    for file in files {
        let lines = fs::read_to_string(&file).unwrap().lines().count();
        assert!(lines <= 500, "{} has {lines} lines: one idea per file", file.display());
    }
}
