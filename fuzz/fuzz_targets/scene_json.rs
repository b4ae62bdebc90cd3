//! Manifests beside a pose and two pictures: what `scene.json` can say.
#![no_main]

use camino::Utf8Path;
use libfuzzer_sys::fuzz_target;
use uniground_core::ingest;

fuzz_target!(|data: &[u8]| {
    let folder = tempfile::tempdir().unwrap();
    let root = Utf8Path::from_path(folder.path()).unwrap();
    std::fs::write(root.join("scene.json"), data).unwrap();
    std::fs::write(root.join("0.txt"), "1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n").unwrap();
    let _ = ingest::open(root);
});
