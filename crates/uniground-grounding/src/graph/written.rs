//! Writes a scene graph as `GraphML`, and as lines for a language model.

use std::collections::BTreeMap;
use std::fmt::Write;
use uniground_types::geometry::boxes::Aabb;
use uniground_types::graph::{GraphEdge, GraphNode, GraphRelation, NodeKind, SceneGraph};

/// Returns `GraphML` (graphml.graphdrawing.org): nodes with kind, name, center and size, edges with
/// relation, score and distance.
#[must_use]
pub fn graphml(graph: &SceneGraph) -> String {
    let mut xml = String::from(
        "<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n\
         <graphml xmlns=\"http://graphml.graphdrawing.org/xmlns\">\n",
    );
    let strings = [("node", "kind"), ("node", "name"), ("edge", "relation")];
    let numbers = ["x", "y", "z", "size_x", "size_y", "size_z"].map(|name| ("node", name));
    let numbers = numbers.into_iter().chain([("edge", "score"), ("edge", "distance_m")]);
    let keys =
        strings.into_iter().map(|key| (key, "string")).chain(numbers.map(|key| (key, "double")));
    for ((of, name), kind) in keys {
        let _ = writeln!(
            xml,
            "  <key id=\"{name}\" for=\"{of}\" attr.name=\"{name}\" attr.type=\"{kind}\"/>"
        );
    }
    let _ = writeln!(xml, "  <graph id=\"{}\" edgedefault=\"directed\">", escaped(&graph.scene_id));
    for GraphNode { id, kind, name, aabb: Aabb { center, size }, .. } in &graph.nodes {
        let _ = write!(
            xml,
            "    <node id=\"{id}\"><data key=\"kind\">{}</data><data key=\"name\">{}</data>",
            kind.as_str(),
            escaped(name)
        );
        let values = [
            ("x", center.x),
            ("y", center.y),
            ("z", center.z),
            ("size_x", size.x),
            ("size_y", size.y),
            ("size_z", size.z),
        ];
        for (key, value) in values {
            let _ = write!(xml, "<data key=\"{key}\">{value}</data>");
        }
        xml.push_str("</node>\n");
    }
    for edge in &graph.edges {
        let (from, to, relation) = (&edge.from, &edge.to, edge.relation.as_str());
        let _ = writeln!(
            xml,
            "    <edge source=\"{from}\" target=\"{to}\"><data key=\"relation\">{relation}</data><data key=\"score\">{}</data>\
             <data key=\"distance_m\">{}</data></edge>",
            edge.score, edge.distance_m
        );
    }
    xml.push_str("  </graph>\n</graphml>\n");
    xml
}

/// Escapes text for XML. Leaves out characters that XML does not allow.
fn escaped(text: &str) -> String {
    let mut safe = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '<' => safe.push_str("&lt;"),
            '>' => safe.push_str("&gt;"),
            '&' => safe.push_str("&amp;"),
            '"' => safe.push_str("&quot;"),
            '\t' | '\n' | '\r' | ' '..='\u{d7ff}' | '\u{e000}'..='\u{fffd}' | '\u{10000}'.. => {
                safe.push(c);
            }
            _ => {}
        }
    }
    safe
}

/// Returns a line for each node, with its relations. Each relation is written once, at the node
/// where it begins.
#[must_use]
pub fn text(graph: &SceneGraph) -> String {
    let mut lines = String::from("metres, z up; [id] name (middle; size): relations\n");
    let names: BTreeMap<&str, &str> =
        graph.nodes.iter().map(|node| (&*node.id, &*node.name)).collect();
    let mut related: BTreeMap<&str, Vec<&GraphEdge>> = BTreeMap::new();
    graph.edges.iter().for_each(|edge| related.entry(&edge.from).or_default().push(edge));
    for node in &graph.nodes {
        let Aabb { center, size } = node.aabb;
        let kind = match node.kind {
            NodeKind::Thing => "",
            NodeKind::Part => "part: ",
            NodeKind::Whole => "whole: ",
            NodeKind::Structure => "building: ",
            NodeKind::Zone => "zone: ",
        };
        let _ = write!(
            lines,
            "[{}] {kind}{} ({:.2} {:.2} {:.2}; {:.2} x {:.2} x {:.2})",
            node.id,
            one_line(&node.name),
            center.x,
            center.y,
            center.z,
            size.x,
            size.y,
            size.z
        );
        for (at, edge) in related.remove(&*node.id).into_iter().flatten().enumerate() {
            let word = match edge.relation {
                GraphRelation::PartOf => "part of",
                GraphRelation::On => "on",
                GraphRelation::OnWall => "hangs on",
                GraphRelation::Inside => "inside",
                GraphRelation::Above => "above",
                GraphRelation::NextTo => "next to",
                GraphRelation::InZone => "in",
            };
            let _ = write!(
                lines,
                "{} {word} [{}] {}",
                if at == 0 { ":" } else { "," },
                edge.to,
                one_line(names.get(&*edge.to).unwrap_or(&""))
            );
        }
        lines.push('\n');
    }
    lines
}

/// Makes a name safe for one line: names that people give may contain anything, and only ids may be
/// in square brackets.
fn one_line(name: &str) -> String {
    let words: Vec<&str> = name.split_whitespace().collect();
    words.join(" ").replace('[', "(").replace(']', ")")
}
