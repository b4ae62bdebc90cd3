//! Looks up an object that a model sees in a photograph and that is not listed: its place becomes
//! an instance (docs/METHOD.md, section 4, "Not listed").

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
    let given_name = Some(seen.name.clone()).filter(|name| !name.is_empty());
    Ok(Some(Found::New(Box::new(Instance {
        given_name,
        found_for: Some(context.query.clone()),
        ..found
    }))))
}
