//! Data folders that earlier versions have left, opened by this one. `scripts/data-fixture.sh` makes them.

use crate::server::{TestServer, ask};
use camino::Utf8Path;
use serde_json::Value;
use std::fs;
use uniground::config::{LimitsConfig, ModelsConfig, VlmConfig};
use uniground_types::answer::{Answer, Status};
use uniground_types::geometry::up_axis::UpAxis;
use uniground_types::scenes::{Scene, SceneStatus};

/// A data folder as it was left, and what its server had told: `scene.json`, `instances.json`, `answers.jsonl`, `scan.zip`.
struct Left {
    data: tempfile::TempDir,
    told: tempfile::TempDir,
}

impl Left {
    fn unpack(name: &str) -> Self {
        let file = fs::File::open(Utf8Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures").join(name)).unwrap();
        let told = tempfile::tempdir().unwrap();
        tar::Archive::new(zstd::Decoder::new(file).unwrap()).unpack(told.path()).unwrap();
        let data = tempfile::tempdir().unwrap();
        fs::remove_dir(data.path()).unwrap();
        fs::rename(told.path().join("data"), data.path()).unwrap();
        Self { data, told }
    }

    fn told(&self, file: &str) -> Vec<u8> {
        fs::read(self.told.path().join(file)).unwrap()
    }
}

#[tokio::test]
async fn a_folder_from_before_records_had_versions_is_found_whole() {
    let left = Left::unpack("data-2026-11-20.tar.zst");
    let (scene_told, scan): (Value, Vec<u8>) = (serde_json::from_slice(&left.told("scene.json")).unwrap(), left.told("scan.zip"));
    let mut instances_told: Value = serde_json::from_slice(&left.told("instances.json")).unwrap();
    for instance in instances_told["instances"].as_array_mut().unwrap() {
        instance["level"] = "thing".into();
        instance["things"] = Value::Array(Vec::new());
    }
    let answers_told = String::from_utf8(left.told("answers.jsonl")).unwrap();
    let Left { data, told: _told } = left;
    let server = TestServer::start_on(data, LimitsConfig::default(), VlmConfig::default(), ModelsConfig::default()).await;
    let get = async |path: &str| server.client.bytes(path).await.unwrap();

    let scenes = server.client.scenes(10, None).await.unwrap().scenes;
    let [scene]: [Scene; 1] = scenes.try_into().unwrap();
    assert_eq!((scene.name.as_str(), scene.status, scene.parse_version), ("A block", SceneStatus::Ready, 1));
    // Everything it was told to be, under the names settings have today.
    let mut expected = scene_told.clone();
    uniground_types::settings::with_names_of_today(&mut expected["settings"]);
    // Steps of today were not taken then.
    expected["settings"]["parsing"]["merging"]["keep_planes_apart"] = false.into();
    expected["settings"]["parsing"]["refine_borders"] = false.into();
    expected["settings"]["parsing"]["sam_masks"]["prompts"] = "grid".into();
    expected["settings"]["parsing"]["sam_masks"]["wholes"] = false.into();
    expected["settings"]["parsing"]["correction"]["known_agreement"] = Value::Null;
    expected["settings"]["parsing"]["instances"]["min_agreement"] = 0.0.into();
    expected["settings"]["parsing"]["instances"]["min_points"] = 0.into();
    expected["settings"]["parsing"]["instances"]["parts_and_wholes"] = 0.0.into();
    expected["report"]["dropped"] = 0.into();
    expected["report"]["specks"] = 0.into();
    expected["report"]["parts_and_wholes"] = 0.into();
    expected["settings"]["import"]["fusion"]["truncation_voxels"] = 5.0.into();
    let path = format!("v1/scenes/{}", scene.id);
    assert_eq!(serde_json::from_slice::<Value>(&get(&path).await).unwrap(), expected);
    assert_eq!(serde_json::from_slice::<Value>(&get(&format!("{path}/instances")).await).unwrap(), instances_told);
    for answer in answers_told.lines() {
        let told: Answer = serde_json::from_str(answer).unwrap();
        let stored = get(&format!("v1/answers/{}", told.id)).await;
        assert_eq!(String::from_utf8(stored).unwrap(), answer, "an answer is given out again byte for byte");
        let picture = get(&format!("v1/answers/{}/evidence/global.jpg", told.id)).await;
        assert!(image::load_from_memory(&picture).is_ok());
        // The same question comes to the same, but for ids and times, the version of the parts, and what was not told then.
        let again = server.client.ground(&scene.id, &ask(&told.query)).await.unwrap();
        let (id, timings_ms, evidence, models) = (told.id.clone(), told.timings_ms, told.evidence.clone(), told.models.clone());
        assert_eq!(again.targets.first().map(|target| target.id), told.answer.predicted_id);
        assert_eq!(again.no_match_reason.is_some(), told.status == Status::NoMatch);
        let ranks = |answer: &Answer| answer.candidates.iter().flatten().map(|c| (c.rank, c.id)).collect::<Vec<_>>();
        assert_eq!(ranks(&again), ranks(&told));
        // How sure it is, is a matter of version too.
        let (confidence, candidates) = (told.confidence, told.candidates.clone());
        let again =
            Answer { id, timings_ms, evidence, models, confidence, candidates, targets: Vec::new(), no_match_reason: None, ..again };
        assert_eq!(again, told);
    }
    for file in ["cloud.ply", "instances.ply", "report", "report/superpoints.jpg", "instances/1/views/0.jpg"] {
        assert!(!get(&format!("{path}/{file}")).await.is_empty(), "{file}");
    }
    let job = server.client.job(scene.job_id.as_deref().unwrap()).await.unwrap();
    assert_eq!((job.kind.as_str(), job.error), ("parse", None));
    // A key is remembered, what was up stays up, and a scene can go.
    let created = server.client.create_scene_once("x", "application/zip", scan, "block").await.unwrap();
    assert_eq!(created.scene.id, scene.id);
    let reparse = server.client.parse(&scene.id, &serde_json::json!({"preset": "paper"})).await.unwrap();
    let reparse = server.client.follow_job(&reparse.id, |_| {}).await.unwrap();
    assert_eq!(reparse.error, None);
    let parsed = server.client.scene(&scene.id).await.unwrap();
    assert_eq!((parsed.parse_version, parsed.settings.unwrap().import.up.map(UpAxis::name)), (2, Some("z")));
    server.client.delete_scene(&scene.id).await.unwrap();
    assert_eq!(server.stored("blobs/contents"), Vec::<String>::new());
    server.stop().await;
}
