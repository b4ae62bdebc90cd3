//! Scenes with ground truth from the folder next to the checkout. They are for measuring and never
//! enter the repository. If they are missing, a line says so; `UNIGROUND_REQUIRE_SHARED=1` makes
//! that a failure.

use camino::{Utf8Path, Utf8PathBuf};

pub fn shared_scene(name: &str) -> Option<Utf8PathBuf> {
    let folder = Utf8Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/scenes");
    if folder.join(name).is_file() {
        return Some(folder);
    }
    assert!(std::env::var_os("UNIGROUND_REQUIRE_SHARED").is_none(), "{folder}/{name} is missing");
    println!("skipped: {name} is not in ../shared/scenes");
    None
}

/// Returns the annotated rooms that this project was developed with. Tests check only these; `make
/// quality` prints the figures of the others.
pub fn development_rooms(names: &[&str]) -> Option<tempfile::TempDir> {
    let folder = shared_scene("room1.zip")?.canonicalize_utf8().unwrap();
    let rooms = tempfile::tempdir().unwrap();
    for room in names {
        for file in ["zip", "scene.json", "queries.json"] {
            let name = format!("{room}.{file}");
            std::os::unix::fs::symlink(folder.join(&name), rooms.path().join(&name)).unwrap();
        }
    }
    Some(rooms)
}
