//! Export of a scene with its instances as files.

use crate::test_scans::Scan;
use crate::test_server::{TestServer, expect_problem};
use reqwest::{Method, StatusCode};
use serde_json::Value;
use std::collections::BTreeMap;
use std::io::Cursor;
use uniground_core::scene::{InstanceId, Level, read_instance_of_point};
use uniground_types::corrections::Change;
use uniground_types::export::ExportFormat;
use uniground_types::instances::Levels;

/// Returns the JSON document of a GLB.
fn glb_document(glb: &[u8]) -> Value {
    let length = u32::from_le_bytes(glb[12..16].try_into().unwrap()) as usize;
    serde_json::from_slice(&glb[20..20 + length]).unwrap()
}

/// Returns the number of points per instance id in `extras`; 0 stands for the rest of the scan.
fn count_points_by_id(document: &Value) -> BTreeMap<u64, u64> {
    let nodes = document["nodes"].as_array().unwrap();
    let children = nodes[0]["children"].as_array().unwrap().iter();
    let points = |node: &Value| {
        let mesh = node["mesh"].as_u64()?;
        let position = document["meshes"][mesh as usize]["primitives"][0]["attributes"]["POSITION"]
            .as_u64()?;
        document["accessors"][position as usize]["count"].as_u64()
    };
    children
        .map(|at| &nodes[at.as_u64().unwrap() as usize])
        .map(|node| (node["extras"]["id"].as_u64().unwrap_or(0), points(node).unwrap_or(0)))
        .collect()
}

#[tokio::test]
async fn a_scene_exports_to_glb_ply_and_usdz() {
    let server = TestServer::start().await;
    let scene = server.upload_and_parse(uniground_service::sample::LIVING_ROOM.to_vec()).await;
    let client = &server.client;
    client.rename_scene(&scene.id, "Grandma's room").await.unwrap();
    let get = async |query: &str, mark: Option<&str>| {
        let request =
            client.request(Method::GET, &format!("v1/scenes/{}/export?{query}", scene.id));
        mark.into_iter()
            .fold(request, |request, mark| request.header("if-none-match", mark))
            .send()
            .await
            .unwrap()
    };
    for (format, media_type) in [
        ("glb", "model/gltf-binary"),
        ("ply", "application/octet-stream"),
        ("usdz", "model/vnd.usdz+zip"),
        ("json", "application/json"),
    ] {
        let query = format!("format={format}&points=20000");
        let first = get(&query, None).await;
        assert_eq!(first.status(), StatusCode::OK, "{format}");
        let header = |name: &str| first.headers()[name].to_str().unwrap().to_owned();
        assert_eq!(
            (&*header("content-type"), &*header("cache-control")),
            (media_type, "private, no-cache")
        );
        assert_eq!(
            header("content-disposition"),
            format!("attachment; filename=\"Grandma_s_room.{format}\"")
        );
        let mark = header("etag");
        let bytes = first.bytes().await.unwrap();
        assert_eq!(
            get(&query, None).await.bytes().await.unwrap(),
            bytes,
            "{format}: two exports of the same scene differ"
        );
        let again = get(&query, Some(&mark)).await;
        assert_eq!(
            (again.status(), again.headers()["etag"].to_str().unwrap()),
            (StatusCode::NOT_MODIFIED, &*mark)
        );
        assert!(again.bytes().await.unwrap().is_empty());
    }

    // All points of instances are in their nodes, and every format lists the same instances.
    let things = client.all_instances(&scene.id, Levels::Things).await.unwrap();
    let whole = glb_document(&client.export(&scene.id, ExportFormat::Glb, None).await.unwrap());
    let points = count_points_by_id(&whole);
    let total = scene.counts.unwrap().points;
    assert_eq!(points.values().sum::<u64>(), total);
    assert!(
        things.iter().all(|thing| points[&u64::from(thing.id.0)] == u64::from(thing.point_count)),
        "{points:?}"
    );
    let ply = client.export(&scene.id, ExportFormat::Ply, Some(1000)).await.unwrap();
    let ids = read_instance_of_point(&*ply).unwrap();
    assert!(ids.len() == 1000 && ids.iter().all(|id| points.contains_key(&u64::from(id.0))));
    let listed = client.exported_scene(&scene.id).await.unwrap();
    assert_eq!(
        (listed.name.as_str(), listed.parse_version, listed.frame.up.as_str()),
        ("Grandma's room", 1, "z")
    );
    assert_eq!(listed.instances, client.all_instances(&scene.id, Levels::All).await.unwrap());
    let usdz = client.export(&scene.id, ExportFormat::Usdz, Some(1000)).await.unwrap();
    let mut archive = zip::ZipArchive::new(Cursor::new(usdz)).unwrap();
    let layer = archive.by_index(0).unwrap();
    assert_eq!(
        (layer.name().unwrap(), layer.compression()),
        ("scene.usda".into(), zip::CompressionMethod::Stored)
    );

    // Corrections are applied.
    let of = |name: &str| {
        things
            .iter()
            .find(|thing| thing.label == name)
            .unwrap_or_else(|| panic!("no {name}: {things:?}"))
    };
    let (mug, sofa) = (of("mug"), of("sofa"));
    let rename = Change::Rename { instance_id: sofa.id, name: "Grandma's bench".into() };
    client.correct(&scene.id, &rename).await.unwrap();
    client.correct(&scene.id, &Change::Dismiss { instance_ids: vec![mug.id] }).await.unwrap();
    let corrected = glb_document(&client.export(&scene.id, ExportFormat::Glb, None).await.unwrap());
    let names: Vec<&str> = corrected["nodes"]
        .as_array()
        .unwrap()
        .iter()
        .map(|node| node["name"].as_str().unwrap())
        .collect();
    assert!(names.contains(&"Grandma's bench") && names.contains(&"rest of the scan"), "{names:?}");
    let after = count_points_by_id(&corrected);
    assert!(!after.contains_key(&u64::from(mug.id.0)), "{after:?}");
    assert_eq!(after[&0], points.get(&0).unwrap_or(&0) + u64::from(mug.point_count));
    assert!(
        client
            .exported_scene(&scene.id)
            .await
            .unwrap()
            .instances
            .iter()
            .all(|instance| instance.id != mug.id)
    );
    server.stop().await;
}

#[tokio::test]
async fn merged_instances_are_one_node() {
    let server = TestServer::start().await;
    let scene = server.upload_and_parse(Scan::neutral().zip()).await;
    let client = &server.client;
    let things = client.all_instances(&scene.id, Levels::Things).await.unwrap();
    let pair: Vec<_> = things.iter().filter(|thing| thing.structure.is_none()).take(2).collect();
    let ids: Vec<InstanceId> = pair.iter().map(|thing| thing.id).collect();
    let merge = Change::Merge { instance_ids: ids.clone(), name: Some("pair".into()) };
    let made = client.correct(&scene.id, &merge).await.unwrap().made.unwrap();
    let points = count_points_by_id(&glb_document(
        &client.export(&scene.id, ExportFormat::Glb, None).await.unwrap(),
    ));
    assert_eq!(
        points[&u64::from(made.0)],
        pair.iter().map(|thing| u64::from(thing.point_count)).sum::<u64>()
    );
    assert!(ids.iter().all(|id| !points.contains_key(&u64::from(id.0))), "{points:?}");
    let listed = client.exported_scene(&scene.id).await.unwrap().instances;
    let member = listed.iter().find(|instance| instance.id == ids[0]).unwrap();
    assert_eq!((member.level, member.things.as_slice()), (Level::Part, [made].as_slice()));
    server.stop().await;
}

#[tokio::test]
async fn invalid_export_requests_are_refused() {
    let server = TestServer::start().await;
    let scene = server.upload_and_parse(Scan::neutral().zip()).await;
    let client = &server.client;
    for (query, pointer, told) in [
        ("format=rrd", "format", "`glb`, `ply`, `usdz`, `json`"),
        ("", "query", "format"),
        ("format=glb&points=0", "points", "1 to 2000000"),
        ("format=json&points=2000001", "points", "1 to 2000000"),
        ("format=glb&point=5", "query", "point"),
    ] {
        let refused =
            expect_problem(client.bytes(&format!("v1/scenes/{}/export?{query}", scene.id)).await);
        assert_eq!(
            (refused.status, refused.code.as_str()),
            (422, "invalid_request"),
            "{query}: {}",
            refused.detail
        );
        assert!(refused.errors[0].detail.contains(told), "{query}: {}", refused.detail);
        assert!(
            pointer == "query" || refused.errors[0].pointer == pointer,
            "{query}: {}",
            refused.errors[0].pointer
        );
    }
    let nobody = "018f0000-0000-7000-8000-000000000000";
    assert_eq!(
        expect_problem(client.export(nobody, ExportFormat::Glb, None).await).code,
        "scene_not_found"
    );
    server.stop().await;
}
