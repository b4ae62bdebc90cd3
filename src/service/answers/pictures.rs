//! The pictures that go with an answer.

use super::{Service, StoredScene};
use crate::error::Error;
use serde::Deserialize;
use std::collections::BTreeMap;
use uniground_core::grounding::pipeline::SceneSource;
use uniground_core::render::{BoxStyle, LabelledBox, ROOM_VIEW, jpeg, scene_picture};
use uniground_core::scene::InstanceId;

/// The picture every answer has.
pub(super) const GLOBAL: &str = "global";
/// What a picture takes of a stored answer, of whatever version: fields that are missing are not drawn.
#[derive(Deserialize)]
struct Drawn {
    #[serde(default)]
    answer: DrawnFields,
    #[serde(default)]
    candidates: Vec<DrawnCandidate>,
}

#[derive(Default, Deserialize)]
#[serde(default)]
struct DrawnFields {
    predicted_id: Option<InstanceId>,
    anchor_id: Option<InstanceId>,
    candidate_names: BTreeMap<u32, String>,
}

#[derive(Deserialize)]
struct DrawnCandidate {
    id: InstanceId,
}

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
            Err(Error::NoTranscript { .. }) if stem == Some(GLOBAL) => self.drawn_picture(id).await,
            Err(Error::NoTranscript { .. }) => Err(not_found()),
            read => read,
        }
    }

    /// The room from above: the answer's box, its anchor and the other candidates over the cloud.
    async fn drawn_picture(&self, id: &str) -> Result<Vec<u8>, Error> {
        let row = self.store.answer(id).await?.ok_or_else(|| Error::AnswerNotFound { id: id.into() })?;
        let answer: Drawn = serde_json::from_str(&row.body)?;
        let source = StoredScene::new(self.clone(), self.loaded_parse(&row.parse_id).await?);
        let draw = move |source: &StoredScene| {
            let render_scene = source.render_scene()?;
            let instances = source.instances();
            // Later boxes lie on top: candidates, anchor, answer.
            let mut boxes: BTreeMap<(u8, u32), LabelledBox> = BTreeMap::new();
            let mut mark = |id: InstanceId, order: u8, style: BoxStyle| {
                let Some(instance) = instances.get(id.0 as usize - 1) else { return };
                let name = answer.answer.candidate_names.get(&id.0).cloned().unwrap_or_else(|| instance.label().to_owned());
                boxes.retain(|(_, other), _| *other != id.0);
                boxes.insert((order, id.0), LabelledBox { aabb: instance.aabb, label: format!("{id} {name}"), style });
            };
            for candidate in answer.candidates.iter().take(MAX_CANDIDATES) {
                mark(candidate.id, 0, BoxStyle::Candidate);
            }
            if let Some(anchor) = answer.answer.anchor_id {
                mark(anchor, 1, BoxStyle::Anchor);
            }
            if let Some(chosen) = answer.answer.predicted_id {
                mark(chosen, 2, BoxStyle::Answer);
            }
            let picture = scene_picture(&render_scene, &source.extent(), &ROOM_VIEW, &boxes.into_values().collect::<Vec<_>>());
            Ok(jpeg(&picture))
        };
        source.compute(draw).await
    }
}
