//! Imports point only downwards, as in ARCHITECTURE.md. The compiler checks the packages; these
//! tests check the modules within a package.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

/// The layers of a package from the top. Modules in one layer do not import each other.
type Floors = &'static [&'static [&'static str]];

const PACKAGES: [(&str, Floors); 2] = [
    (
        "src",
        &[
            &["cli"],
            &["app"],
            &["config", "telemetry"],
            &["http"],
            &["bundles"],
            &["packages", "words"],
        ],
    ),
    (
        "crates/uniground-types/src",
        &[
            &["export"],
            &[
                "approach",
                "changes",
                "graph",
                "many",
                "scenes",
                "instances",
                "service",
                "stats",
                "transcript",
                "batch",
                "keys",
                "uploads",
            ],
            &["answer", "corrections", "links", "question", "settings", "job", "models"],
            &["coverage", "labels", "placement"],
            &["numbers"],
            &["scene", "problem"],
            &["findings"],
            &["geometry"],
        ],
    ),
];

/// Allowed imports within one layer: logging is configured, and secrets in the configuration are
/// kept out of the log.
const ALLOWED: &[(&str, &str)] = &[("telemetry", "config"), ("config", "telemetry")];

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

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

/// Returns the top-level modules that a source file names, in `use` lines and inline paths. Tests
/// may import anything.
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
fn modules_import_only_lower_layers() {
    let mut wrong = Vec::new();
    for (package, floors) in PACKAGES {
        let root = root().join(package);
        let floor: BTreeMap<&str, usize> = floors
            .iter()
            .enumerate()
            .flat_map(|(i, names)| names.iter().map(move |n| (*n, i)))
            .collect();
        let mut files = Vec::new();
        sources(&root, &mut files);
        assert!(files.len() > 10, "{package}: only {} files found", files.len());
        for file in files {
            let relative = file.strip_prefix(&root).unwrap().to_str().unwrap().to_owned();
            let module = relative.split(['/', '.']).next().unwrap().to_owned();
            if matches!(module.as_str(), "lib" | "main") {
                continue;
            }
            let Some(&own) = floor.get(module.as_str()) else {
                wrong.push(format!("{package}/{relative}: the module {module} stands on no floor"));
                continue;
            };
            for name in imports(&fs::read_to_string(&file).unwrap()) {
                let downwards = floor.get(name.as_str()).is_some_and(|&other| other > own);
                if name != module
                    && !downwards
                    && !ALLOWED.contains(&(module.as_str(), name.as_str()))
                {
                    wrong.push(format!("{package}/{relative} imports {name}"));
                }
            }
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

/// A robot's own process needs no server, and a client no pipelines. `make lint` checks transitive
/// dependencies.
#[test]
fn packages_do_not_depend_on_forbidden_packages() {
    for (package, strangers) in [
        (
            "uniground-types",
            &["uniground-core", "uniground-client", "tokio", "ort", "image", "rayon"][..],
        ),
        (
            "uniground-core",
            &["uniground-client", "tokio", "reqwest", "sqlx", "axum", "clap", "utoipa", "anyhow"],
        ),
        ("uniground-client", &["uniground-core", "ort", "sqlx", "axum", "clap", "image", "rayon"]),
    ] {
        let manifest =
            fs::read_to_string(root().join("crates").join(package).join("Cargo.toml")).unwrap();
        let dependencies = manifest
            .split("[dependencies]")
            .nth(1)
            .unwrap()
            .split("\n[")
            .next()
            .unwrap()
            .to_owned();
        for stranger in strangers {
            let named = dependencies
                .lines()
                .any(|line| line.split(['=', '.', ' ']).next() == Some(stranger));
            assert!(!named, "{package} depends on {stranger}");
        }
    }
}

#[test]
fn source_files_stay_below_the_line_limit() {
    let mut files = Vec::new();
    for folder in ["src", "crates"] {
        sources(&root().join(folder), &mut files);
    }
    for file in files {
        let text = fs::read_to_string(&file).unwrap();
        let code = text.split("#[cfg(test)]\nmod tests").next().unwrap_or_default();
        let lines = code.lines().count();
        assert!(lines <= 800, "{} has {lines} lines: one idea per file", file.display());
    }
}
