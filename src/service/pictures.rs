//! The pictures that go with an answer.

use super::evidence::Stored;
use super::{Answer, Service};
use crate::error::Error;
use crate::render::{BoxStyle, LabelledBox, ROOM_VIEW, jpeg, scene_picture};
use crate::scene::InstanceId;
use std::collections::BTreeMap;
use tokio::task::spawn_blocking;

/// The picture every answer has.
const GLOBAL: &str = "global.jpg";
/// More candidates than this only hide the room.
const MAX_CANDIDATES: usize = 5;

impl Service {
    /// A picture of an answer by its name: as a model was shown it, where that is kept; the room is drawn otherwise. JPEG.
    ///
    /// # Errors
    /// [`Error::AnswerNotFound`], [`Error::AnswerPictureNotFound`].
    pub async fn answer_picture(&self, id: &str, name: &str) -> Result<Vec<u8>, Error> {
        let stem = name
            .strip_suffix(".jpg")
            .filter(|stem| stem.bytes().all(|b| b.is_ascii_alphanumeric() || b == b'-'));
        let not_found = || Error::AnswerPictureNotFound { id: id.into(), name: name.into() };
        match self.kept_file(id, &format!("{}.jpg", stem.ok_or_else(not_found)?)).await {
            Err(Error::NoTranscript { .. }) if name == GLOBAL => self.drawn_picture(id).await,
            Err(Error::NoTranscript { .. }) => Err(not_found()),
            read => read,
        }
    }

    /// The room from above: the answer's box, its anchor and the other candidates over the cloud.
    async fn drawn_picture(&self, id: &str) -> Result<Vec<u8>, Error> {
        let row = self.store.answer(id).await?.ok_or_else(|| Error::AnswerNotFound { id: id.into() })?;
        let answer: Answer = serde_json::from_str(&row.body)?;
        let parse = self.loaded_parse(&row.parse_id).await?;
        let (caches, folder) = (self.caches.clone(), self.store.blobs.parse(&row.parse_id));
        let permit = self.turn().await?;
        spawn_blocking(move || {
            let _permit = permit;
            let scenery = Stored { parse_id: &row.parse_id, parse: &parse, folder, caches: &caches }.scenery()?;
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
            let picture = scene_picture(&scenery, &parse.extent, &ROOM_VIEW, &boxes.into_values().collect::<Vec<_>>());
            Ok(jpeg(&picture))
        })
        .await?
    }
}
