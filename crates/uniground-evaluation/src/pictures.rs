//! Draws pictures of wrong answers: the room with the truth in green, the answer in red, the other
//! candidates in blue.

use super::scoring::ScoredExpression;
use uniground_geometry::boxes::Aabb;
use uniground_render::{
    BoxStyle, LabeledBox, Orbit, ROOM_VIEW, RenderScene, draw_scene, encode_jpeg,
};

/// Folder of the pictures below the output folder.
pub const FOLDER: &str = "pictures";

/// A smaller view of the room than in answers, because there are many of these pictures.
const VIEW: Orbit = Orbit { width: 800, height: 600, ..ROOM_VIEW };
/// Maximum number of drawn candidates. More would hide the room.
const MAX_CANDIDATES: usize = 5;

/// Returns the boxes to draw. Later boxes are drawn on top.
#[must_use]
pub fn boxes(outcome: &ScoredExpression) -> Vec<LabeledBox> {
    let mut boxes = Vec::new();
    if let Some(reply) = &outcome.reply {
        let name = |id: u32| {
            reply.answer.candidate_names.get(&id).map_or(String::new(), |name| format!(" {name}"))
        };
        for candidate in reply
            .candidates
            .iter()
            .take(MAX_CANDIDATES)
            .filter(|c| reply.answer.predicted_id != Some(c.id))
        {
            let label = format!("{}{}", candidate.id, name(candidate.id.0));
            boxes.push(LabeledBox::axis_aligned(candidate.aabb, label, BoxStyle::Candidate));
        }
        if let (Some(aabb), Some(id)) = (reply.aabb, reply.answer.predicted_id) {
            let label = format!("answer {id}{}", name(id.0));
            boxes.push(LabeledBox::axis_aligned(aabb, label, BoxStyle::Anchor));
        }
    }
    if let Some(target) = &outcome.target {
        let label = format!("truth: {}", target.name.as_deref().unwrap_or("target"));
        boxes.push(LabeledBox::axis_aligned(target.aabb, label, BoxStyle::Answer));
    }
    boxes
}

/// Draws a room. Returns `None` for one without points and boxes.
#[must_use]
pub fn draw(render_scene: &RenderScene, boxes: &[LabeledBox]) -> Option<Vec<u8>> {
    let corners: Vec<_> = boxes.iter().flat_map(|b| b.aabb.corners()).collect();
    let extent = Aabb::around(if render_scene.cloud.is_empty() {
        &corners
    } else {
        &render_scene.cloud.positions
    })?;
    Some(encode_jpeg(&draw_scene(render_scene, &extent, &VIEW, boxes)))
}
