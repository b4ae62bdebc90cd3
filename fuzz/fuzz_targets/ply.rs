//! Clouds: headers, ASCII and binary bodies, layouts nobody has seen.
#![no_main]

use camino::Utf8Path;
use libfuzzer_sys::fuzz_target;
use uniground_core::ingest::read_cloud;

fuzz_target!(|data: &[u8]| {
    let folder = tempfile::tempdir().unwrap();
    let file = Utf8Path::from_path(folder.path()).unwrap().join("cloud.ply");
    std::fs::write(&file, data).unwrap();
    if let Ok(cloud) = read_cloud(&file) {
        assert_eq!(cloud.positions.len(), cloud.colors.len());
        assert!(cloud.positions.iter().all(|p| p.iter().all(|v| v.is_finite())));
    }
});
