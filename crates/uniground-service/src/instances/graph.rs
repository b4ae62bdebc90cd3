//! The graph of a scene: its instances and the relations between them.

use crate::InstanceService;
use crate::error::Error;
use crate::parses::LoadedParse;
use std::sync::Arc;
use uniground_grounding::SceneView;
use uniground_grounding::graph::{Graph, Guessed, graphml, text};
use uniground_types::answer::CoordinateFrame;
use uniground_types::graph::{GraphFormat, SceneGraph};
use uniground_types::instances::Levels;
use uniground_types::scene::InstanceId;

impl InstanceService {
    /// Returns the graph of a scene's current parse. With `around`, returns only that instance, of
    /// any level, and the instances related to it.
    ///
    /// # Errors
    /// [`Error::SceneNotFound`], [`Error::SceneNotReady`], [`Error::InstanceNotFound`].
    pub async fn graph(
        &self,
        scene_id: &str,
        levels: Levels,
        around: Option<InstanceId>,
    ) -> Result<SceneGraph, Error> {
        let (row, parse_id) = self.scene_lookup.ready_scene(scene_id).await?;
        let parse: Arc<LoadedParse> = self.parsed_scenes.loaded_parse(&parse_id).await?;
        let levels = if around.is_some() { Levels::All } else { levels };
        let graph = self.question_permits.compute(move || Ok(to_graph(&parse, levels))).await?;
        let Graph { nodes, edges } = match around {
            Some(id) => graph
                .around(id)
                .ok_or_else(|| Error::InstanceNotFound { scene_id: row.id.clone(), id })?,
            None => graph,
        };
        Ok(SceneGraph {
            scene_id: row.id,
            parse_version: u32::try_from(row.parse_version).unwrap_or(0),
            frame: CoordinateFrame::default(),
            nodes,
            edges,
        })
    }
}

fn to_graph(parse: &LoadedParse, levels: Levels) -> Graph {
    let LoadedParse { instances, extent, names, .. } = parse;
    let guessed = if parse.embeddings.is_some() { Guessed::ByLooks } else { Guessed::ByMeasures };
    Graph::of(SceneView { instances, extent: *extent, names, appearance: None }, levels, guessed)
}

/// Writes a graph in a format. Returns the media type and the text.
///
/// # Errors
/// JSON that cannot be written. This never happens for these graphs.
pub fn write_graph(
    graph: &SceneGraph,
    format: GraphFormat,
) -> Result<(&'static str, String), Error> {
    Ok(match format {
        GraphFormat::Json => ("application/json", serde_json::to_string(graph)?),
        GraphFormat::Graphml => ("application/graphml+xml", graphml(graph)),
        GraphFormat::Text => ("text/plain; charset=utf-8", text(graph)),
    })
}
