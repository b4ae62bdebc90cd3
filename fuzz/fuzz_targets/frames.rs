//! The plain layout beside honest files: one pose, one camera matrix or one picture of anybody's making. The first byte says which.
#![no_main]

use camino::Utf8Path;
use libfuzzer_sys::fuzz_target;
use uniground_core::ingest;
use uniground_core::progress::Progress;
use uniground_types::settings::ImportSettings;

fuzz_target!(|data: &[u8]| {
    let Some((which, bytes)) = data.split_first() else { return };
    let folder = tempfile::tempdir().unwrap();
    let root = Utf8Path::from_path(folder.path()).unwrap();
    for name in ["color", "depth", "pose"] {
        std::fs::create_dir(root.join(name)).unwrap();
    }
    std::fs::write(root.join("intrinsic.txt"), "2 0 1\n0 2 1\n0 0 1\n").unwrap();
    std::fs::write(root.join("pose/0.txt"), "1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n").unwrap();
    image::RgbImage::new(4, 4).save(root.join("color/0.png")).unwrap();
    image::ImageBuffer::from_pixel(4, 4, image::Luma([1000_u16])).save(root.join("depth/0.png")).unwrap();
    let file = ["intrinsic.txt", "pose/0.txt", "color/0.png", "depth/0.png", "color/0.jpg"][usize::from(*which) % 5];
    if file.ends_with("jpg") {
        std::fs::remove_file(root.join("color/0.png")).unwrap();
    }
    std::fs::write(root.join(file), bytes).unwrap();
    if let Ok(scan) = ingest::open(root) {
        if let Ok(bundle) = ingest::load(&scan, &ImportSettings::default(), &Progress::silent()) {
            assert!(bundle.cloud.positions.iter().all(|p| p.iter().all(|v| v.is_finite())));
        }
    }
});
