//! An instance as stored.

use serde::{Deserialize, Serialize};
use uniground_geometry::boxes::{Aabb, OrientedBox};
use uniground_geometry::color::ColorHistogram;
use uniground_geometry::scene::{Instance, InstanceId, Level, NameGuess, Structure, Support, View};

/// One object candidate. Lengths in meters, world frame (Z up). Only the id and the box are
/// required.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct InstanceRecord {
    id: InstanceId,
    #[serde(default)]
    level: Level,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    things: Vec<InstanceId>,
    aabb: Aabb,
    #[serde(default)]
    raw_box: Option<Aabb>,
    #[serde(default)]
    oriented_box: Option<OrientedBox>,
    #[serde(default)]
    point_count: u32,
    #[serde(default)]
    mean_rgb: [u8; 3],
    #[serde(default, rename = "colours")]
    colors: ColorHistogram,
    #[serde(default)]
    planarity: f32,
    #[serde(default)]
    structure: Option<Structure>,
    #[serde(default)]
    support: Option<Support>,
    #[serde(default)]
    height_above_floor_m: f32,
    #[serde(default)]
    views: Vec<View>,
    #[serde(default)]
    names: Vec<NameGuess>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    given_name: Option<String>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    found_for: Option<String>,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    merged_from: Vec<InstanceId>,
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    gone: bool,
}

impl From<&Instance> for InstanceRecord {
    fn from(instance: &Instance) -> Self {
        // List every field: a new one does not compile until it is decided whether it is stored.
        let Instance {
            id,
            level,
            things,
            aabb,
            raw_box,
            oriented_box,
            point_count,
            mean_rgb,
            colors,
            planarity,
            structure,
            support,
            height_above_floor_m,
            views,
            names,
            given_name,
            found_for,
            merged_from,
            dismissed: _, // stored as corrections
            gone,
        } = instance.clone();
        Self {
            id,
            level,
            things,
            aabb,
            raw_box: Some(raw_box),
            oriented_box: Some(oriented_box),
            point_count,
            mean_rgb,
            colors,
            planarity,
            structure,
            support: Some(support),
            height_above_floor_m,
            views,
            names,
            given_name,
            found_for,
            merged_from,
            gone,
        }
    }
}

impl From<InstanceRecord> for Instance {
    fn from(record: InstanceRecord) -> Self {
        let InstanceRecord {
            id,
            level,
            things,
            aabb,
            raw_box,
            oriented_box,
            point_count,
            mean_rgb,
            colors,
            planarity,
            structure,
            support,
            height_above_floor_m,
            views,
            names,
            given_name,
            found_for,
            merged_from,
            gone,
        } = record;
        Self {
            id,
            level,
            things,
            aabb,
            raw_box: raw_box.unwrap_or(aabb),
            oriented_box: oriented_box.unwrap_or(aabb.into()),
            point_count,
            mean_rgb,
            colors,
            planarity,
            structure,
            support: support.unwrap_or(Support::Nothing),
            height_above_floor_m,
            views,
            names,
            given_name,
            found_for,
            merged_from,
            dismissed: gone,
            gone,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn known_fields_of_other_versions_are_read() {
        let stored = r#"{"id": 7, "aabb": {"center": [1, 2, 3], "size": [1, 1, 1]}, "names": [{"name": "mug", "score": 0.5}], "mood": "blue",
                "views": [{"frame": 3, "visible_points": 9, "box_px": [1, 2, 3, 4]}]}"#;
        let instance: Instance = serde_json::from_str::<InstanceRecord>(stored).unwrap().into();
        assert_eq!(
            (instance.id.0, instance.label(), instance.support),
            (7, "mug", Support::Nothing)
        );
        assert_eq!(
            (instance.views[0].box_px, &instance.views[0].mask),
            ([1, 2, 3, 4], &None),
            "records of earlier versions have no mask"
        );
        let again = InstanceRecord::from(&instance);
        let read: InstanceRecord =
            serde_json::from_str(&serde_json::to_string(&again).unwrap()).unwrap();
        assert_eq!(Instance::from(read), instance);
    }
}
