//! Zones of a room, recognized by the objects in them: a kitchen has a stove, a sink and a
//! refrigerator.

/// Names of each zone, and nouns of the lexicon that make one.
const ZONES: &[(&[&str], &[&str])] = &[
    (
        &["kitchen", "kitchenette", "kitchen area", "kitchen corner", "cooking area", "pantry"],
        &[
            "stove",
            "oven",
            "refrigerator",
            "sink",
            "kitchen cabinet",
            "counter",
            "dishwasher",
            "microwave",
            "range hood",
        ],
    ),
    (
        &["bathroom", "washroom", "restroom", "shower room"],
        &["toilet", "bathtub", "shower", "urinal", "bidet"],
    ),
    (
        &["bedroom", "sleeping area", "sleeping corner", "bed area", "bedside"],
        &["bed", "nightstand", "bunk bed", "crib"],
    ),
    (
        &[
            "living room",
            "lounge",
            "sitting area",
            "living area",
            "seating area",
            "tv corner",
            "tv area",
            "sofa corner",
        ],
        &["sofa", "coffee table", "tv", "tv stand"],
    ),
    (&["dining room", "dining area", "dining corner", "eating area"], &["dining table"]),
    (
        &[
            "study",
            "workspace",
            "work area",
            "working area",
            "office area",
            "workplace",
            "desk area",
            "work corner",
            "home office",
        ],
        &["desk", "monitor", "office chair", "computer"],
    ),
    (
        &["hallway", "hall", "entrance", "entryway", "entry", "doorway", "entrance area", "foyer"],
        &["door", "doormat", "coat rack", "shoe rack"],
    ),
    (&["laundry room", "laundry corner", "laundry area", "laundry"], &["washing machine", "dryer"]),
    (
        &["meeting area", "meeting room", "conference area", "meeting corner"],
        &["conference table", "meeting table", "whiteboard"],
    ),
    (&["workshop", "tool corner", "tool area"], &["workbench", "toolbox", "tool cabinet"]),
    (&["play area", "play corner", "playroom"], &["toy", "dollhouse", "toy box"]),
];

/// Number of words of the longest zone name.
pub(super) const LONGEST: usize = 2;

/// Returns the nouns that make a zone of this name.
#[must_use]
pub fn nouns_of_zone(name: &str) -> Option<&'static [&'static str]> {
    ZONES.iter().find(|(names, _)| names.contains(&name)).map(|(_, nouns)| *nouns)
}

/// Returns every zone by its first name, with the nouns that make it.
pub fn all() -> impl Iterator<Item = (&'static str, &'static [&'static str])> {
    ZONES.iter().filter_map(|(names, nouns)| Some((*names.first()?, *nouns)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn zone_names_are_unique_and_short() {
        let all: Vec<&str> = ZONES.iter().flat_map(|(names, _)| *names).copied().collect();
        let mut once = all.clone();
        once.sort_unstable();
        once.dedup();
        assert_eq!(once.len(), all.len());
        assert!(all.iter().all(|name| name.split(' ').count() <= LONGEST));
        assert!(
            nouns_of_zone("kitchen").is_some_and(|nouns| nouns.contains(&"stove"))
                && nouns_of_zone("table").is_none()
        );
    }
}
