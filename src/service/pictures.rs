//! The picture that goes with an answer: the room from above with the answer's box.

use super::{Answer, Service};
use crate::error::Error;
use crate::ingest;
use crate::render::{BoxStyle, LabelledBox, ROOM_VIEW, jpeg, scene_picture};
use crate::scene::InstanceId;
use std::collections::BTreeMap;
use tokio::task::spawn_blocking;

/// More candidates than this only hide the room.
const MAX_CANDIDATES: usize = 5;

impl Service {
    /// Renders an answer's picture: its box, its anchor and the other candidates over the cloud. JPEG.
    ///
    /// # Errors
    /// [`Error::AnswerNotFound`], or the stored cloud can not be read.
    pub async fn answer_picture(&self, id: &str) -> Result<Vec<u8>, Error> {
        let row = self.store.answer(id).await?.ok_or_else(|| Error::AnswerNotFound { id: id.into() })?;
        let answer: Answer = serde_json::from_str(&row.body)?;
        let parse = self.loaded_parse(&row.parse_id).await?;
        let cloud_file = self.store.blobs.parse(&row.parse_id).join("cloud.ply");
        let permit = self.turn().await?;
        spawn_blocking(move || {
            let _permit = permit;
            let cloud = ingest::read_cloud(&cloud_file)?;
            // Later boxes lie on top: candidates, anchor, answer.
            let mut boxes: BTreeMap<(u8, u32), LabelledBox> = BTreeMap::new();
            let mut mark = |id: InstanceId, order: u8, style: BoxStyle| {
                let Some(instance) = parse.instances.get(id.0 as usize - 1) else { return };
                let name = answer.answer.candidate_names.get(&id.0).cloned().unwrap_or_else(|| instance.label().to_owned());
                boxes.retain(|(_, other), _| *other != id.0);
                boxes.insert((order, id.0), LabelledBox { aabb: instance.aabb, label: format!("{id} {name}"), style });
            };
            for candidate in answer.candidates.iter().flatten().take(MAX_CANDIDATES) {
                mark(candidate.id, 0, BoxStyle::Candidate);
            }
            if let Some(anchor) = answer.answer.anchor_id {
                mark(anchor, 1, BoxStyle::Anchor);
            }
            if let Some(chosen) = answer.answer.predicted_id {
                mark(chosen, 2, BoxStyle::Answer);
            }
            let picture = scene_picture(&cloud, &parse.extent, &ROOM_VIEW, &boxes.into_values().collect::<Vec<_>>());
            Ok(jpeg(&picture))
        })
        .await?
    }
}
