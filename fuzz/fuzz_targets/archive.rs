//! Archives of every kind: the walk over their entries. The first byte says which kind the rest is.
#![no_main]

use camino::Utf8Path;
use libfuzzer_sys::fuzz_target;
use uniground_core::ingest::archive::{ArchiveKind, UnpackLimits, unpack};

fuzz_target!(|data: &[u8]| {
    let Some((kind, bytes)) = data.split_first() else { return };
    let kind = [ArchiveKind::Zip, ArchiveKind::Tar, ArchiveKind::TarZst][usize::from(*kind) % 3];
    let folder = tempfile::tempdir().unwrap();
    let root = Utf8Path::from_path(folder.path()).unwrap();
    let (archive, out) = (root.join("archive"), root.join("out"));
    std::fs::write(&archive, bytes).unwrap();
    std::fs::create_dir(&out).unwrap();
    let limits = UnpackLimits { max_bytes: 1 << 20, ..UnpackLimits::default() };
    let _ = unpack(&archive, kind, &out, &limits);
    // Nothing may lie outside of the folder it was unpacked to.
    assert_eq!(std::fs::read_dir(root).unwrap().count(), 2);
});
