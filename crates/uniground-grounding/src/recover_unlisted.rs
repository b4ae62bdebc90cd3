//! Looks up an object that a model sees in a photograph and that is not listed, or that the chosen
//! instance does not fit: its place becomes an instance (docs/METHOD.md, section 4, "Not listed").

use super::Seen;
use super::scene_source::SceneSource;
use super::vlm::{PictureSettings, PromptContext, VisualEvidence};
use uniground_geometry::scene::{Instance, InstanceId};
use uniground_parsing::pointed::find_identical;

/// The result of a lookup at the position where a model saw an object.
pub(super) enum Found {
    /// An instance of the scene that was not offered.
    Known(InstanceId),
    /// A thing that stage 1 has not segmented.
    New(Box<Instance>),
}

/// Segments the object that a model saw; `None` where it did not point into a photograph, or
/// nothing can be segmented there.
///
/// # Errors
/// Those of the source.
pub(super) fn look_up<S: SceneSource>(
    source: &S,
    context: &PromptContext,
    seen: &Seen,
    evidence: &VisualEvidence,
    settings: &PictureSettings,
) -> Result<Option<Found>, S::Error> {
    let Some(place) = evidence.place(source, seen, settings)? else { return Ok(None) };
    // The model says that no listed instance is meant.
    let listed: Vec<InstanceId> = context.shown().collect();
    let Some(found) = source.cut_out(place, &listed)? else { return Ok(None) };
    if let Some(known) = find_identical(source.instances(), &found) {
        let may_be =
            known.structure.is_none() && !known.dismissed && !context.is_candidate(known.id.0);
        return Ok(may_be.then_some(Found::Known(known.id)));
    }
    Ok(Some(Found::new_for(context, seen, found)))
}

/// Looks up what fits an object better than the instance that the model chose, given the object's
/// area in a photograph; `None` where nothing does.
///
/// # Errors
/// Those of the source.
pub(super) fn find_better<S: SceneSource>(
    source: &S,
    context: &PromptContext,
    (chosen, seen): (InstanceId, &Seen),
    evidence: &VisualEvidence,
    settings: &PictureSettings,
) -> Result<Option<Found>, S::Error> {
    let Some(place) = evidence.place(source, seen, settings)? else { return Ok(None) };
    let Some(found) = source.find_better(place, chosen)? else { return Ok(None) };
    Ok(Some(match source.instances().iter().any(|known| known.id == found.id) {
        true => Found::Known(found.id),
        false => Found::new_for(context, seen, found),
    }))
}

impl Found {
    /// Returns a new thing with the name that the model gave it.
    fn new_for(context: &PromptContext, seen: &Seen, found: Instance) -> Self {
        let given_name = Some(seen.name.clone()).filter(|name| !name.is_empty());
        let found_for = Some(context.query.clone());
        Self::New(Box::new(Instance { given_name, found_for, ..found }))
    }
}
