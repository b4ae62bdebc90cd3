//! The scene graph: instances and their relations.

use crate::test_server::{TestServer, assert_contains, expect_problem};
use std::collections::BTreeSet;
use uniground_types::corrections::Change;
use uniground_types::graph::{GraphRelation, NodeKind};
use uniground_types::instances::Levels;

#[tokio::test]
async fn the_scene_graph_is_served_in_three_formats() {
    let server = TestServer::start().await;
    let scene = server.upload_and_parse(uniground_service::sample::LIVING_ROOM.to_vec()).await;
    let client = &server.client;
    let graph = client.graph(&scene.id, Levels::All).await.unwrap();
    assert_eq!((graph.scene_id.as_str(), graph.parse_version), (scene.id.as_str(), 1));
    let ids: BTreeSet<&str> = graph.nodes.iter().map(|node| &*node.id).collect();
    assert!(graph.edges.iter().all(|edge| ids.contains(&*edge.from) && ids.contains(&*edge.to)));
    let instances = client.all_instances(&scene.id, Levels::All).await.unwrap();
    assert_eq!(
        graph.nodes.iter().filter(|node| node.instance_id.is_some()).count(),
        instances.len()
    );
    let things = client.graph(&scene.id, Levels::Things).await.unwrap().nodes;
    assert_eq!(
        things.iter().filter(|node| node.instance_id.is_some()).count() as u32,
        scene.counts.unwrap().instances
    );
    // The graph has the same support relations as answers.
    let answer = client
        .ground(&scene.id, &crate::test_server::ask("the mug on the coffee table"))
        .await
        .unwrap();
    let mug = format!("i{}", answer.answer.predicted_id.unwrap());
    let on = graph
        .edges
        .iter()
        .find(|edge| edge.from == mug && edge.relation == GraphRelation::On)
        .unwrap();
    let carrier = graph.nodes.iter().find(|node| node.id == on.to).unwrap();
    assert!(carrier.name.contains("table") && carrier.kind == NodeKind::Thing, "{carrier:?}");

    let text = |query: &str| {
        let path = format!("v1/scenes/{}/graph?{query}", scene.id);
        async move { String::from_utf8(client.bytes(&path).await.unwrap()).unwrap() }
    };
    let lines = text("format=text").await;
    let of_mug = lines.lines().find(|line| line.starts_with(&format!("[{mug}]"))).unwrap();
    assert!(of_mug.contains(&format!("on [{}]", on.to)), "{of_mug}");
    let xml = text("format=graphml&level=all").await;
    assert!(
        xml.starts_with("<?xml") && xml.matches("<node ").count() == graph.nodes.len(),
        "{xml}"
    );

    // The graph around the mug contains only the mug's relations.
    let around = text(&format!("around={}", &mug[1..])).await;
    let around: uniground_types::graph::SceneGraph = serde_json::from_str(&around).unwrap();
    assert!(
        around.edges.iter().all(|edge| edge.from == mug || edge.to == mug)
            && around.nodes.len() < graph.nodes.len()
    );
    // Parts are included on request.
    let part = instances
        .iter()
        .find(|instance| instance.level == uniground_types::scene::Level::Part)
        .unwrap();
    let of_part: uniground_types::graph::SceneGraph =
        serde_json::from_str(&text(&format!("around={}", part.id)).await).unwrap();
    assert!(of_part.edges.iter().any(|edge| edge.relation == GraphRelation::PartOf), "{of_part:?}");
    let refused =
        expect_problem(client.bytes(&format!("v1/scenes/{}/graph?around=9999", scene.id)).await);
    assert_eq!((refused.status, refused.code.as_str()), (404, "instance_not_found"));
    let refused =
        expect_problem(client.bytes(&format!("v1/scenes/{}/graph?format=dot", scene.id)).await);
    assert_eq!((refused.status, refused.code.as_str()), (422, "invalid_request"));

    // Corrections are applied.
    let id = answer.answer.predicted_id.unwrap();
    client
        .correct(&scene.id, &Change::Rename { instance_id: id, name: "Grandma's <cup>".into() })
        .await
        .unwrap();
    assert_contains(text("format=graphml").await, "Grandma's &lt;cup&gt;");
    client.correct(&scene.id, &Change::Dismiss { instance_ids: vec![id] }).await.unwrap();
    assert!(
        client.graph(&scene.id, Levels::All).await.unwrap().nodes.iter().all(|node| node.id != mug)
    );
    server.stop().await;
}
