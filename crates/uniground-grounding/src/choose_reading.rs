//! Chooses among several readings of a question: the first that the scene supports.
//!
//! "Scrape the plate into the red bin" may ask for a plate or for a bin, and "my back hurts, I'll
//! take the wooden chair" names a back before the chair. Words alone cannot decide; the contents of
//! the room can.

use super::SceneView;
use super::assess::Assessor;
use super::direction::DirectionConvention;
use uniground_language::{ParsedQuery, Phrase};

/// An instance has the requested name when its name fits this well.
const CALLED: f32 = 0.35;
/// The instance is meant when its attributes and its place leave at least this share of that fit.
const BORNE_OUT: f32 = 0.2;

/// Returns the reading to answer: the first of a question's likeliest one and its
/// [later](ParsedQuery::later) ones that the scene supports. Returns the likeliest where none is
/// supported.
#[must_use]
pub fn choose_reading(scene: SceneView, parsed: ParsedQuery) -> ParsedQuery {
    if parsed.later.is_empty() || parsed.foreign {
        return parsed;
    }
    // Names and measures decide, because an encoder has embedded the words of one reading only.
    let assessor = Assessor::new(
        SceneView { appearance: None, ..scene },
        DirectionConvention::default().into(),
    );
    // Words without any noun fit something in every scene.
    let is_named = !(parsed.target.head.is_empty() && parsed.target.uses.is_empty());
    if is_named && is_supported(&assessor, &parsed.target) {
        return parsed;
    }
    match parsed.later.iter().position(|later| is_supported(&assessor, &later.target)) {
        None => parsed,
        Some(later) => ParsedQuery { later: Vec::new(), ..parsed.later[later].clone() },
    }
}

fn is_supported(assessor: &Assessor, target: &Phrase) -> bool {
    let assessment = assessor.assess(target);
    let meant = |(noun, total): (&f32, &f32)| *noun >= CALLED && *total >= BORNE_OUT * noun;
    assessment.nouns.iter().zip(&assessment.total).any(meant)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::NameIndex;
    use uniground_geometry::boxes::Aabb;
    use uniground_geometry::scene::{Instance, Support};
    use uniground_geometry::{Point3, Vector3};
    use uniground_language::parse;
    use uniground_testing::thing;

    #[test]
    fn scene_contents_decide_the_reading() {
        let named = |(id, name): (u32, &str)| {
            let instance = thing(id, [id as f32, 0.0], [0.4; 3], 0.0, Support::Floor, [90; 3]);
            Instance { given_name: Some(name.to_owned()), ..instance }
        };
        let head = |names: &[&str], query: &str| {
            let instances: Vec<Instance> = (1..).zip(names.iter().copied()).map(named).collect();
            let extent = Aabb { center: Point3::origin(), size: Vector3::repeat(9.0) };
            let names = NameIndex::of(&instances);
            choose_reading(
                SceneView { instances: &instances, extent, names: &names, appearance: None },
                parse(query),
            )
            .target
            .head
        };
        let put = "put the towel in the basket";
        assert_eq!(head(&["chair", "basket"], put), "basket");
        // A towel outside of the basket is to be put there.
        assert_eq!(head(&["towel", "basket"], put), "basket");
        // Neither is in the scene: the answer says that the likeliest reading is not there.
        assert_eq!(head(&["chair", "lamp"], put), "towel");
        assert_eq!(
            head(&["chair", "desk"], "fetch the towel off the desk"),
            "towel",
            "the anchor is not the target"
        );
    }
}
