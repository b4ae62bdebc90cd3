//! The pictures of an answer.

use super::StoredScene;
use crate::AnswerService;
use crate::error::Error;
use serde::Deserialize;
use std::collections::BTreeMap;
use uniground_geometry::scene::InstanceId;
use uniground_grounding::pipeline::SceneSource;
use uniground_render::{BoxStyle, LabeledBox, ROOM_VIEW, draw_scene, encode_jpeg};

/// The name of the picture that every answer has.
pub(super) const GLOBAL: &str = "global";
/// The fields of a stored answer that a picture needs. Answers of earlier versions may lack some of
/// them; those are not drawn.
#[derive(Deserialize)]
struct StoredAnswer {
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

/// The maximum number of candidates drawn. More would only hide the room.
const MAX_CANDIDATES: usize = 5;

impl AnswerService {
    /// Returns a picture of an answer by its name, as JPEG. This is the picture that a model was
    /// shown, if it is stored. Otherwise the room is drawn.
    ///
    /// # Errors
    /// [`Error::AnswerNotFound`], [`Error::AnswerPictureNotFound`].
    pub async fn answer_picture(&self, id: &str, name: &str) -> Result<Vec<u8>, Error> {
        let stem = name
            .strip_suffix(".jpg")
            .filter(|stem| stem.bytes().all(|b| b.is_ascii_alphanumeric() || b == b'-'));
        let not_found = || Error::AnswerPictureNotFound { id: id.into(), name: name.into() };
        match self
            .transcripts
            .read_answer_file(id, &format!("{}.jpg", stem.ok_or_else(not_found)?))
            .await
        {
            Err(Error::NoTranscript { .. }) if stem == Some(GLOBAL) => self.draw_answer(id).await,
            Err(Error::NoTranscript { .. }) => Err(not_found()),
            read => read,
        }
    }

    /// Draws the room from above: the answer's box, its anchor and the other candidates over the
    /// cloud.
    async fn draw_answer(&self, id: &str) -> Result<Vec<u8>, Error> {
        let row = self
            .answer_repository
            .answer(id)
            .await?
            .ok_or_else(|| Error::AnswerNotFound { id: id.into() })?;
        let StoredAnswer { answer, candidates } = serde_json::from_str(&row.body)?;
        let source = StoredScene::new(
            self.parsed_scenes.clone(),
            self.parsed_scenes.loaded_parse(&row.parse_id).await?,
        );
        // Later boxes cover earlier ones, hence the order: candidates, anchor, answer.
        let candidates = candidates
            .iter()
            .take(MAX_CANDIDATES)
            .map(|candidate| (candidate.id, BoxStyle::Candidate));
        let anchor = answer.anchor_id.map(|id| (id, BoxStyle::Anchor));
        let chosen = answer.predicted_id.map(|id| (id, BoxStyle::Answer));
        let marks = candidates.chain(anchor).chain(chosen).collect();
        source
            .compute(move |source| source.draw_room_with_boxes(marks, &answer.candidate_names))
            .await
    }

    /// Draws the room of a scene's current parse from above, with instances marked. JPEG.
    ///
    /// # Errors
    /// [`Error::SceneNotFound`], [`Error::SceneNotReady`], [`Error::InstanceNotFound`],
    /// [`Error::ParseDamaged`].
    pub async fn room_picture(
        &self,
        scene_id: &str,
        marked: Vec<InstanceId>,
    ) -> Result<Vec<u8>, Error> {
        let (_, parse_id) = self.scene_lookup.ready_scene(scene_id).await?;
        let source = StoredScene::new(
            self.parsed_scenes.clone(),
            self.parsed_scenes.loaded_parse(&parse_id).await?,
        );
        let instances = source.instances().len();
        if let Some(&id) = marked.iter().find(|id| !(1..=instances).contains(&(id.0 as usize))) {
            return Err(Error::InstanceNotFound { scene_id: scene_id.into(), id });
        }
        let marks = marked.into_iter().map(|id| (id, BoxStyle::Answer)).collect();
        source.compute(move |source| source.draw_room_with_boxes(marks, &BTreeMap::new())).await
    }
}

impl StoredScene {
    /// Draws the room from above with boxes, as JPEG. Later boxes lie on top. If an instance has
    /// several boxes, only the last one is drawn.
    fn draw_room_with_boxes(
        &self,
        marks: Vec<(InstanceId, BoxStyle)>,
        names: &BTreeMap<u32, String>,
    ) -> Result<Vec<u8>, Error> {
        let instances = self.instances();
        let last: BTreeMap<InstanceId, usize> =
            marks.iter().enumerate().map(|(at, (id, _))| (*id, at)).collect();
        let lasting = marks.into_iter().enumerate().filter(|(at, (id, _))| last[id] == *at);
        let labeled = |(_, (id, style)): (usize, (InstanceId, BoxStyle))| {
            let instance = instances.get((id.0 as usize).wrapping_sub(1))?;
            let name = names.get(&id.0).cloned().unwrap_or_else(|| instance.label().to_owned());
            Some(LabeledBox {
                aabb: instance.aabb,
                drawn: instance.oriented_box,
                label: format!("{id} {name}"),
                style,
            })
        };
        let boxes: Vec<LabeledBox> = lasting.filter_map(labeled).collect();
        let render_scene = self.render_scene()?;
        Ok(encode_jpeg(&draw_scene(&render_scene, &self.extent(), &ROOM_VIEW, &boxes)))
    }
}
