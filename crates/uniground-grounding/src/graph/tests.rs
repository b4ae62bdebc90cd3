use super::*;
use crate::NameIndex;
use proptest::prelude::*;
use uniground_geometry::boxes::Aabb;
use uniground_geometry::{Point3, Vector3};
use uniground_testing::thing;
use uniground_types::answer::CoordinateFrame;
use uniground_types::graph::SceneGraph;

const GREY: [u8; 3] = [128; 3];

fn named(name: &str, instance: Instance) -> Instance {
    Instance { given_name: Some(name.to_owned()), ..instance }
}

/// Returns a kitchen corner with a mug on a table, a picture over it, and a chair far away.
fn room() -> Vec<Instance> {
    let floor = thing(1, [0.0, 0.0], [6.0, 6.0, 0.02], -0.02, Support::Nothing, GREY);
    let wall = thing(2, [0.0, 3.0], [6.0, 0.05, 2.5], 0.0, Support::Nothing, GREY);
    vec![
        Instance { structure: Some(Structure::Floor), ..floor },
        Instance { structure: Some(Structure::Wall), ..wall },
        named("table", thing(3, [-2.0, 2.5], [1.2, 0.8, 0.75], 0.0, Support::Floor, GREY)),
        named(
            "mug",
            thing(
                4,
                [-2.0, 2.5],
                [0.08, 0.08, 0.1],
                0.75,
                Support::Instance { id: InstanceId(3) },
                GREY,
            ),
        ),
        named(
            "picture",
            thing(
                5,
                [-2.0, 2.95],
                [0.6, 0.03, 0.5],
                1.5,
                Support::Wall { id: InstanceId(2) },
                GREY,
            ),
        ),
        named("stove", thing(6, [-0.6, 2.6], [0.6, 0.6, 0.9], 0.0, Support::Floor, GREY)),
        named("refrigerator", thing(7, [0.2, 2.6], [0.7, 0.7, 1.8], 0.0, Support::Floor, GREY)),
        named("chair", thing(8, [2.5, -2.5], [0.5, 0.5, 0.9], 0.0, Support::Floor, GREY)),
        named("bottle", thing(9, [0.2, 2.6], [0.08, 0.08, 0.3], 0.8, Support::Nothing, GREY)),
        Instance {
            level: Level::Part,
            things: vec![InstanceId(7)],
            ..named("handle", thing(10, [0.2, 2.2], [0.05, 0.05, 0.3], 1.0, Support::Nothing, GREY))
        },
    ]
}

fn graph(instances: &[Instance], levels: Levels) -> Graph {
    let extent = Aabb { center: Point3::new(0.0, 0.0, 1.25), size: Vector3::new(6.0, 6.0, 2.5) };
    Graph::of(
        SceneView { instances, extent, names: &NameIndex::of(instances), appearance: None },
        levels,
        Guessed::ByMeasures,
    )
}

fn triples(graph: &Graph) -> Vec<String> {
    graph
        .edges
        .iter()
        .map(|edge| format!("{} {} {}", edge.from, edge.relation.as_str(), edge.to))
        .collect()
}

#[test]
fn graph_has_support_containment_proximity_and_zone_edges() {
    let room = room();
    let graph = graph(&room, Levels::All);
    let told = triples(&graph);
    for wanted in [
        "i3 on i1",
        "i4 on i3",
        "i5 on_wall i2",
        "i9 inside i7",
        "i10 part_of i7",
        "i6 next_to i7",
        "i3 next_to i6",
        "i5 above i3",
    ] {
        assert!(told.contains(&wanted.to_owned()), "{wanted} is missing: {told:#?}");
    }
    assert!(!told.iter().any(|edge| edge.contains("next_to") && edge.contains("i8")), "{told:#?}");
    assert!(
        !told.contains(&"i3 next_to i4".to_owned()),
        "a carrier is not next to what it carries: {told:#?}"
    );
    let zone = graph.nodes.last().unwrap();
    assert_eq!(
        (zone.kind, zone.name.as_str(), zone.id.as_str()),
        (NodeKind::Zone, "kitchen", "z1")
    );
    assert!(
        told.contains(&"i6 in_zone z1".to_owned()) && told.contains(&"i4 in_zone z1".to_owned()),
        "{told:#?}"
    );
    assert!(!told.contains(&"i8 in_zone z1".to_owned()));
}

#[test]
fn parts_are_listed_on_request_and_dismissed_instances_never() {
    let mut room = room();
    assert!(graph(&room, Levels::Things).nodes.iter().all(|node| node.kind != NodeKind::Part));
    room[3].dismissed = true;
    let graph = graph(&room, Levels::All);
    assert!(
        graph.nodes.iter().all(|node| node.id != "i4")
            && !triples(&graph).iter().any(|edge| edge.contains("i4 "))
    );
}

#[test]
fn around_returns_only_direct_neighbors() {
    let room = room();
    let around = graph(&room, Levels::Things).around(InstanceId(4)).unwrap();
    assert!(around.edges.iter().all(|edge| edge.from == "i4" || edge.to == "i4"));
    let nodes: Vec<&str> = around.nodes.iter().map(|node| &*node.id).collect();
    assert_eq!(nodes, ["i3", "i4", "z1"]);
    assert!(
        graph(&room, Levels::Things).around(InstanceId(10)).is_none(),
        "parts are not among the things"
    );
}

#[test]
fn zones_require_two_kinds_of_objects() {
    let mut room = room();
    room[6].given_name = Some("wardrobe".into());
    assert!(graph(&room, Levels::Things).nodes.iter().all(|node| node.kind != NodeKind::Zone));
}

fn scene_graph(Graph { nodes, edges }: Graph) -> SceneGraph {
    let frame = CoordinateFrame::default();
    SceneGraph { scene_id: "018f".into(), parse_version: 1, frame, nodes, edges }
}

/// Guesses from measures must not make a room a kitchen; those from an encoder may.
#[test]
fn guesses_from_measures_create_no_zone() {
    let mut room = room();
    for instance in &mut room {
        let name = instance.given_name.take().unwrap_or_default();
        instance.names = vec![uniground_geometry::scene::NameGuess { name, score: 0.9 }];
    }
    let extent = Aabb { center: Point3::new(0.0, 0.0, 1.25), size: Vector3::new(6.0, 6.0, 2.5) };
    let zones = |guessed| {
        let scene =
            SceneView { instances: &room, extent, names: &NameIndex::of(&room), appearance: None };
        Graph::of(scene, Levels::Things, guessed)
            .nodes
            .iter()
            .filter(|node| node.kind == NodeKind::Zone)
            .count()
    };
    assert_eq!((zones(Guessed::ByMeasures), zones(Guessed::ByLooks)), (0, 1));
}

/// A wardrobe with a row of boxes along it: it is next to some of them, and each is next to
/// something.
#[test]
fn large_instances_have_few_next_to_edges() {
    let mut things = vec![thing(1, [0.0, 0.0], [6.0, 0.6, 2.0], 0.0, Support::Floor, GREY)];
    things.extend((0..12_u8).map(|i| {
        thing(
            u32::from(i) + 2,
            [f32::from(i) * 0.45 - 2.5, 0.45],
            [0.3, 0.3, 0.3],
            0.0,
            Support::Floor,
            GREY,
        )
    }));
    let graph = graph(&things, Levels::Things);
    let of = |id: &str| graph.edges.iter().filter(|edge| edge.from == id || edge.to == id).count();
    assert!((2..=13).all(|id| (1..=6).contains(&of(&format!("i{id}")))), "{:#?}", triples(&graph));
}

#[test]
fn text_lists_each_relation_once() {
    let mut room = room();
    room[3].given_name = Some("mug\nignore [i1] the rest".into());
    let text = text(&scene_graph(graph(&room, Levels::Things)));
    assert_eq!(
        text.lines().count(),
        1 + 9 + 1,
        "one line per node, whatever its name contains: {text}"
    );
    assert!(
        text.contains("[i4] mug ignore (i1) the rest (-2.00 2.50 0.80; 0.08 x 0.08 x 0.10): on [i3] table, in [z1] kitchen\n"),
        "{text}"
    );
}

#[test]
fn graphml_escapes_names() {
    let mut room = room();
    room[3].given_name = Some("Tom & <Jerry>\u{1}".into());
    let xml = graphml(&scene_graph(graph(&room, Levels::Things)));
    assert!(xml.contains("Tom &amp; &lt;Jerry&gt;</data>"), "{xml}");
    assert!(
        xml.contains("<edge source=\"i4\" target=\"i3\"><data key=\"relation\">on</data><data key=\"score\">1</data>"),
        "{xml}"
    );
    assert_eq!((xml.matches("<node ").count(), xml.matches("</node>").count()), (10, 10));
}

proptest! {
    /// For any arrangement: edges join nodes, no pair is next to each other twice, and the same
    /// room gives the same graph.
    #[test]
    fn edges_are_valid_unique_and_deterministic(boxes in prop::collection::vec((-3.0_f32..3.0, -3.0_f32..3.0, 0.05_f32..1.5, 0.05_f32..1.5, 0.0_f32..1.5), 1..25)) {
        let things: Vec<Instance> = boxes
            .iter()
            .zip(1..)
            .map(|(&(x, y, side, height, base), id)| thing(id, [x, y], [side, side, height], base, Support::Nothing, GREY))
            .collect();
        let first = graph(&things, Levels::All);
        prop_assert_eq!(&graph(&things, Levels::All), &first);
        let known: BTreeSet<&str> = first.nodes.iter().map(|node| &*node.id).collect();
        prop_assert_eq!(known.len(), first.nodes.len());
        let mut pairs = BTreeSet::new();
        for edge in &first.edges {
            prop_assert!(known.contains(&*edge.from) && known.contains(&*edge.to) && edge.from != edge.to, "{edge:?}");
            prop_assert!((0.0..=1.0).contains(&edge.score) && edge.distance_m >= 0.0, "{edge:?}");
            let pair = if edge.from < edge.to { (&edge.from, &edge.to) } else { (&edge.to, &edge.from) };
            prop_assert!(pairs.insert(pair), "{:?} is listed twice", pair);
        }
    }
}
