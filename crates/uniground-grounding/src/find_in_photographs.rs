//! Photographs first: the model finds the object among numbered things in photographs, or points at
//! it, before it decides (docs/METHOD.md, section 4, "Photographs first").

use super::Seen;
use super::found_anchors::ByGeometry;
use super::recover_unlisted::{Found, look_up};
use super::scene_source::SceneSource;
use super::vlm::{
    self, Finding, MarkedPhotographs, Options, PictureSettings, PromptContext, VisualEvidence,
    is_building,
};
use std::sync::Arc;
use std::time::{Duration, Instant};
use uniground_geometry::scene::InstanceId;
use uniground_models::chat::{AskError, Session};
use uniground_types::answer::LeftOut;

/// Number of the geometry's best candidates that are shown beside what the model found.
const BY_GEOMETRY: usize = 2;

/// The scene and the context after the model has looked for the object.
pub(super) struct Searched<S> {
    /// The scene, with an instance of what the model pointed at.
    pub source: Arc<S>,
    /// What the model found, then the geometry's best candidates.
    pub context: PromptContext,
    /// What became of a place that the model pointed at.
    pub notes: Vec<String>,
    /// Time for the photographs.
    pub drawing: Duration,
    /// The geometry's choice, if the model sees nothing else that may be meant.
    pub agreed: Option<InstanceId>,
    /// Things that had no number; `None` if no photograph was searched.
    pub left_out: Option<LeftOut>,
}

/// Asks the model where the object is, in photographs whose things are numbered. Returns why it
/// could not be asked, where the geometry has no candidates either. A scan without photographs is
/// not searched. The geometry decides again if the model found anchors of the question.
///
/// # Errors
/// Those of the source.
pub(super) async fn find_in_photographs<S: SceneSource>(
    source: &Arc<S>,
    context: PromptContext,
    mut by_geometry: ByGeometry<'_>,
    options: Options,
    session: &mut Session<'_>,
) -> Result<Result<Searched<S>, AskError>, S::Error> {
    let begun = Instant::now();
    let (context, marked) = source
        .compute(move |source| {
            let marked = vlm::marked_photographs(source, &context)?;
            Ok((context, marked))
        })
        .await?;
    let drawing = begun.elapsed();
    let mut searched = Searched { drawing, ..Searched::without_looking(source.clone(), context) };
    if marked.photographs.is_empty() {
        return Ok(Ok(searched));
    }
    let (found, marked) = match searched.find(marked, options, session).await? {
        Ok(found) => found,
        // The model may still be able to look at the geometry's candidates.
        Err(_) if !searched.context.candidates.is_empty() => return Ok(Ok(searched)),
        Err(error) => return Ok(Err(error)),
    };
    searched.left_out = Some(marked.left_out);
    searched.context = by_geometry.decide_with(source, &found.anchors, searched.context).await?;
    let mut ids = found.ids;
    searched.agreed =
        by_geometry.choice(&**source).filter(|choice| ids == [*choice] && found.seen.is_none());
    if searched.agreed.is_some() {
        return Ok(Ok(searched));
    }
    if let Some(seen) = found.seen
        && let Some(id) = searched.resolve(seen, marked, options).await?
    {
        // What was pointed at has no number of its own, so it is none of the numbered things.
        ids.retain(|other| *other != id);
        ids.insert(ids.len().min(1), id);
    }
    let of_geometry = searched.context.candidates.iter().map(|c| c.id);
    let others: Vec<InstanceId> = of_geometry.filter(|id| !ids.contains(id)).collect();
    let most = if ids.is_empty() { others.len() } else { BY_GEOMETRY };
    ids.extend(others.into_iter().take(most));
    let mut anchors = found.anchors;
    // Left and right come from a wall, but a picture of it tells little.
    anchors.retain(|(id, _)| !is_building(searched.source.instances(), *id));
    searched.context = searched.context.with_found_in_photographs(&ids, &anchors);
    Ok(Ok(searched))
}

impl<S: SceneSource> Searched<S> {
    /// Returns what the model was going to be shown without looking first.
    pub fn without_looking(source: Arc<S>, context: PromptContext) -> Self {
        Self {
            source,
            context,
            notes: Vec::new(),
            drawing: Duration::ZERO,
            agreed: None,
            left_out: None,
        }
    }

    /// Asks where the object is. If the model sees nothing that may be it, it is asked once more with
    /// the photographs that were not shown. Returns what it found, and in which photographs.
    async fn find(
        &mut self,
        marked: MarkedPhotographs,
        options: Options,
        session: &mut Session<'_>,
    ) -> Result<Result<(Finding, MarkedPhotographs), AskError>, S::Error> {
        session.allow_one_more();
        let found = match vlm::find(&self.context, &marked, options, session).await {
            Ok(found) => found,
            Err(error) => return Ok(Err(error)),
        };
        if !found.ids.is_empty() || found.seen.is_some() {
            return Ok(Ok((found, marked)));
        }
        let begun = Instant::now();
        let (context, shown) = (self.context.clone(), marked.clone());
        let further = self
            .source
            .compute(move |source| vlm::further_photographs(source, &context, &shown))
            .await?;
        self.drawing += begun.elapsed();
        if further.photographs.is_empty() {
            return Ok(Ok((found, marked)));
        }
        session.allow_one_more();
        match vlm::find(&self.context, &further, options, session).await {
            Ok(mut again) => {
                let is_new =
                    |(id, _): &(InstanceId, String)| !again.anchors.iter().any(|a| a.0 == *id);
                let before: Vec<_> = found.anchors.into_iter().filter(is_new).collect();
                again.anchors.extend(before);
                Ok(Ok((again, further)))
            }
            Err(_) => Ok(Ok((found, marked))),
        }
    }

    /// Turns a place in a photograph into an instance; `None` where nothing can be segmented.
    async fn resolve(
        &mut self,
        seen: Seen,
        marked: MarkedPhotographs,
        options: Options,
    ) -> Result<Option<InstanceId>, S::Error> {
        let place = format!("the model saw \"{}\" in {}", seen.name, seen.picture);
        let photographs = marked.photographs;
        let evidence = VisualEvidence { photographs, ..VisualEvidence::default() };
        let settings = PictureSettings::of(options);
        // No candidate was excluded by the model.
        let context = self.context.narrowed_to(&[]);
        let found = self
            .source
            .compute(move |source| look_up(source, &context, &seen, &evidence, &settings))
            .await?;
        let (id, note) = match found {
            None => return Ok(None),
            Some(Found::Known(id)) => (id, format!("{place}: it is instance {id}")),
            Some(Found::New(found)) => {
                let (source, id) = self.source.keep_found(*found).await?;
                self.source = source;
                self.context.update_boxes(self.source.instances());
                (id, format!("{place}: instance {id} was made of it"))
            }
        };
        self.notes.push(note);
        Ok(Some(id))
    }
}
