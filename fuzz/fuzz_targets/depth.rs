//! One depth picture of anybody's making: EXR, TIFF, PNG, PGM, LZFSE.
#![no_main]

use camino::Utf8Path;
use libfuzzer_sys::fuzz_target;
use uniground_core::geometry::Isometry3;
use uniground_core::scene::{
    FrameIndex, FrameRef, Intrinsics, Optics, float_picture_size, is_float_picture,
};

fuzz_target!(|data: &[u8]| {
    let folder = tempfile::tempdir().unwrap();
    let file = Utf8Path::from_path(folder.path()).unwrap().join("depth");
    std::fs::write(&file, data).unwrap();
    let size = float_picture_size(&file).ok().flatten();
    let _ = is_float_picture(&file);
    let (width, height) = size.unwrap_or((4, 4));
    let intrinsics = Intrinsics { width, height, fx: 4.0, fy: 4.0, cx: 2.0, cy: 2.0 };
    let frame = FrameRef {
        index: FrameIndex(0),
        color: file.clone(),
        depth: file,
        color_intrinsics: intrinsics,
        depth_intrinsics: intrinsics,
        depth_scale_m: 1.0,
        camera_to_world: Isometry3::identity(),
        optics: Optics::default(),
    };
    if let Ok(depth) = frame.decode_depth() {
        assert_eq!(depth.depth_m.len() as u64, u64::from(width) * u64::from(height));
        assert!(depth.depth_m.iter().all(|z| z.is_finite() && *z >= 0.0));
    }
});
