//! The views a question may be asked from. "Facing the desk" has as many views as there are desks
//! to face.

use crate::assess::Assessor;
use crate::direction::Directions;
use uniground_language::{Look, ParsedQuery, Phrase, Viewpoint};

/// A possible view.
pub(super) struct View {
    /// Left, right, front and back of this view.
    pub directions: Directions,
    /// Index of the instance that the viewer looks at, looks from or has behind; `None` where the
    /// question gives no viewpoint, or nothing matches it.
    pub by: Option<usize>,
    /// Whether the viewer looks at that instance.
    is_looked_at: bool,
    /// How likely this view is relative to the likeliest, `0..=1`.
    pub sure: f32,
}

/// Maximum number of instances tried as the viewpoint.
const MOST_VIEWS: usize = 3;
/// Maximum weight of a view relative to the likeliest, however alike the instances are.
const LATER_VIEW: f32 = 0.9;
/// Headings closer than this, by the cosine, are one view: "facing the two desks".
const SAME_HEADING: f32 = 0.85;
/// A seat this near to a table is at the table, meters.
const SEAT_REACH_M: f32 = 1.0;

impl View {
    fn of_nobody(directions: Directions) -> Self {
        Self { directions, by: None, is_looked_at: false, sure: 1.0 }
    }

    /// Sets the assessor's directions to this view's.
    pub fn take(&self, assessor: &mut Assessor) {
        assessor.directions = self.directions;
        assessor.looked_at = self.by.filter(|_| self.is_looked_at);
    }
}

/// Returns the views a question may be asked from, the likeliest first; never empty.
pub(super) fn views(assessor: &Assessor, parsed: &ParsedQuery) -> Vec<View> {
    let Some(viewpoint) = &parsed.viewpoint else {
        return vec![View::of_nobody(assessor.directions)];
    };
    let may_be_meant = assessor.likely(&viewpoint.anchor, MOST_VIEWS);
    if may_be_meant.is_empty() {
        let towards =
            towards_the_target(assessor, viewpoint, parsed.standpoint.as_ref(), &parsed.target);
        return vec![View::of_nobody(towards.unwrap_or(assessor.directions))];
    }
    let mut views: Vec<View> = Vec::new();
    for (anchor, share) in may_be_meant {
        let Some(directions) = look(assessor, viewpoint, parsed.standpoint.as_ref(), anchor) else {
            continue;
        };
        if views.iter().all(|view| view.directions.front.dot(&directions.front) < SAME_HEADING) {
            let sure = if views.is_empty() { 1.0 } else { LATER_VIEW * share };
            views.push(View {
                directions,
                by: Some(anchor),
                is_looked_at: viewpoint.look == Look::Facing,
                sure,
            });
        }
    }
    if views.is_empty() { vec![View::of_nobody(assessor.directions)] } else { views }
}

/// Returns the directions of a viewer who looks at, from or away from an instance.
fn look(
    assessor: &Assessor,
    viewpoint: &Viewpoint,
    standpoint: Option<&Phrase>,
    anchor: usize,
) -> Option<Directions> {
    // A viewer who stands at one object and looks at another looks along the line between the two.
    let at_hand = |phrase: &Phrase, s: usize| {
        phrase.uses.is_empty() || assessor.solids[s].gap(&assessor.solids[anchor]) < SEAT_REACH_M
    };
    let stands = standpoint
        .filter(|_| viewpoint.look == Look::Facing)
        .and_then(|phrase| assessor.best(phrase).filter(|&s| at_hand(phrase, s)))
        .filter(|s| *s != anchor);
    let from = stands.map_or(assessor.room().outline.center, |s| assessor.solids[s].center);
    Directions::of_look(viewpoint.look, &assessor.solids[anchor], &from)
}

/// Returns the directions where the object that the viewer faces was not found: the viewer is
/// assumed to look towards the requested objects.
fn towards_the_target(
    assessor: &Assessor,
    viewpoint: &Viewpoint,
    standpoint: Option<&Phrase>,
    target: &Phrase,
) -> Option<Directions> {
    let center = assessor.room().outline.center;
    let stands = standpoint
        .and_then(|phrase| assessor.best(phrase))
        .map_or(center, |s| assessor.solids[s].center);
    let middle = assessor.mean_position(target).filter(|_| viewpoint.look == Look::Facing)?;
    Directions::looking_along(middle - stands)
}

#[cfg(test)]
mod tests {
    use crate::{NameIndex, Question, SceneView, ground};
    use uniground_geometry::boxes::Aabb;
    use uniground_geometry::scene::{Instance, InstanceId, Support};
    use uniground_geometry::{Point3, Vector3};
    use uniground_testing::thing;

    #[test]
    fn explanation_lists_other_possible_viewpoints() {
        // Two desks at opposite ends, two mugs between them: which mug is left depends on the desk
        // that is faced.
        let named = |id: u32, at: [f32; 2], size: [f32; 3], name: &str| {
            let bottom = if name == "mug" { 0.5 } else { 0.0 };
            Instance {
                given_name: Some(name.into()),
                ..thing(id, at, size, bottom, Support::Floor, [90, 60, 40])
            }
        };
        let desk = [1.4, 0.7, 0.75];
        let mug = [0.1; 3];
        let instances = [
            named(1, [0.0, 2.0], desk, "desk"),
            named(2, [0.0, -2.0], desk, "desk"),
            named(3, [-0.5, 0.0], mug, "mug"),
            named(4, [0.5, 0.0], mug, "mug"),
        ];
        let extent = Aabb { center: Point3::new(0.0, 0.0, 1.3), size: Vector3::new(7.0, 5.0, 2.6) };
        let names = NameIndex::of(&instances);
        let ask = |query: &str| {
            ground(
                SceneView { instances: &instances, extent, names: &names, appearance: None },
                &Question::of(query),
            )
        };
        let either = ask("facing the desk, the mug on the left");
        assert_eq!(either.answer.predicted_id, Some(InstanceId(3)));
        assert!(
            either.answer.explanation.contains("instance 1 (brown desk), though 2 may be meant"),
            "{}",
            either.answer.explanation
        );
        // A window at one end leaves no doubt.
        let mut with_window = instances.to_vec();
        with_window.push(named(5, [0.0, 2.4], [1.5, 0.1, 1.2], "window"));
        let names = NameIndex::of(&with_window);
        let sure = ground(
            SceneView { instances: &with_window, extent, names: &names, appearance: None },
            &Question::of("facing the window, the mug on the left"),
        );
        assert_eq!(sure.answer.predicted_id, Some(InstanceId(3)));
        assert!(
            sure.confidence > 1.2 * either.confidence,
            "{} {}",
            sure.confidence,
            either.confidence
        );
    }
}
