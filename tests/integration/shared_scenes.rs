//! Scenes with ground truth from the folder next to the checkout. They are for measuring and never
//! enter the repository. If they are missing, a line says so; `UNIGROUND_REQUIRE_SHARED=1` makes
//! that a failure.

use crate::server::{TestServer, ask, parsed};
use camino::{Utf8Path, Utf8PathBuf};
use std::fs;
use uniground_core::geometry::up_axis::UpAxis;
use uniground_core::grounding::Status;

pub fn shared_scene(name: &str) -> Option<Utf8PathBuf> {
    let folder = Utf8Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/scenes");
    if folder.join(name).is_file() {
        return Some(folder);
    }
    assert!(std::env::var_os("UNIGROUND_REQUIRE_SHARED").is_none(), "{folder}/{name} is missing");
    println!("left out: {name} is not beside this checkout");
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

/// Real scans without an up axis are leveled by their cameras.
#[tokio::test]
async fn real_scans_are_turned_upright() {
    for (name, up) in [("redkitchen.zip", UpAxis::NegY), ("hololens.zip", UpAxis::Y)] {
        let Some(folder) = shared_scene(name) else { return };
        let server = TestServer::start().await;
        let scene =
            parsed(&server.client, "application/zip", fs::read(folder.join(name)).unwrap()).await;
        let import = scene.import.unwrap();
        println!(
            "{name}: up {}, agreement {:?}, {:?}",
            import.up.name(),
            import.reprojection_agreement,
            scene.counts.unwrap()
        );
        assert_eq!(import.up, up, "{name}");
        assert!(import.reprojection_agreement.unwrap() > 0.4, "{name}: {import:?}");
        // A room is a few meters high, whatever its length.
        assert!((1.0..6.0).contains(&scene.extent.unwrap().size.z), "{name}: {:?}", scene.extent);
        let answer = server.client.ground(&scene.id, &ask("the theremin")).await.unwrap();
        assert_eq!(answer.status, Status::NoMatch);
        server.stop().await;
    }
}
