//! LAS records: headers, scales and counts of anybody's making. (LAZ is unpacked by a crate: its panics are caught.)
#![no_main]

use camino::Utf8Path;
use libfuzzer_sys::fuzz_target;
use uniground_core::ingest::{self, ScanFolder};
use uniground_core::progress::Progress;
use uniground_types::settings::ImportSettings;

fuzz_target!(|data: &[u8]| {
    // LAZ is the crate's: its panics are caught, which a fuzzer does not wait for.
    if data.get(104).is_some_and(|format| format & 0xc0 != 0) {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let file = Utf8Path::from_path(folder.path()).unwrap().join("scan.las");
    std::fs::write(&file, data).unwrap();
    let Ok(unpacked) = ScanFolder::open(&file) else { return };
    let Ok(scan) = ingest::open(&unpacked.path) else { return };
    if let Ok(found) = ingest::inspect(&scan, &ImportSettings::default(), &Progress::silent()) {
        let cloud = found.cloud.unwrap_or_default();
        assert_eq!(cloud.positions.len(), cloud.colors.len());
        assert!(cloud.positions.iter().all(|p| p.iter().all(|v| v.is_finite())));
    }
});
