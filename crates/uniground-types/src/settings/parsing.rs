//! Settings of stage 1 with two presets: `default` (best accuracy) and `paper` (the paper's
//! values).

use super::{
    AppearanceSettings, CorrectionSettings, FrameSamplingSettings, InstanceSettings, MergeSettings,
    PartMergingSettings, RgbdSettings, SamSettings, SuperpointSettings, ViewSettings,
};
use serde::{Deserialize, Serialize};

/// Settings of stage 1. Omitted fields use their default.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields, default)]
pub struct ParsingSettings {
    /// Approximate time for masks, names and pictures, minutes, 0.1 to 1440. Fewer frames are used
    /// if all would take longer, at least 4. The time per frame is measured on the first frames, so
    /// the number depends on the speed of the machine. A scan that has grown gets the time again
    /// for each addition. `null`: no limit. Default: `null`. Not in the paper.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_minutes: Option<f32>,
    /// Selection of the frames to process.
    pub frame_sampling: FrameSamplingSettings,
    /// Segmentation of the cloud into superpoints.
    pub superpoints: SuperpointSettings,
    /// Built-in masks.
    pub rgbd_masks: RgbdSettings,
    /// Masks of a segmentation model, if the server has one.
    pub sam_masks: SamSettings,
    /// Relative depth tolerance: a point fits the measured depth if `|z - d| <= this * d`. Default:
    /// 0.02. Paper: 0.15.
    pub depth_tolerance: f32,
    /// Merging of superpoints into regions.
    pub merging: MergeSettings,
    /// Merging of parts with their furniture.
    pub part_merging: PartMergingSettings,
    /// Whether points at the border of a region are reassigned by the masks of most frames.
    /// Default: `true`. Not in the paper.
    pub refine_borders: bool,
    /// Filtering of regions and computation of boxes.
    pub instances: InstanceSettings,
    /// Selection of the views stored as pictures.
    pub views: ViewSettings,
    /// Correction of instance outlines by a segmentation model.
    pub correction: CorrectionSettings,
    /// Pictures for the encoder, if the server has one.
    pub appearance: AppearanceSettings,
}

impl Default for ParsingSettings {
    fn default() -> Self {
        Self {
            max_minutes: None,
            frame_sampling: FrameSamplingSettings::default(),
            superpoints: SuperpointSettings::default(),
            rgbd_masks: RgbdSettings::default(),
            sam_masks: SamSettings::default(),
            depth_tolerance: 0.02,
            merging: MergeSettings::default(),
            part_merging: PartMergingSettings::default(),
            refine_borders: true,
            instances: InstanceSettings::default(),
            views: ViewSettings::default(),
            correction: CorrectionSettings::default(),
            appearance: AppearanceSettings::default(),
        }
    }
}

impl ParsingSettings {
    /// Returns the paper's values and only the paper's steps. Uses the defaults for values that the
    /// paper omits.
    #[must_use]
    pub fn paper() -> Self {
        Self {
            frame_sampling: FrameSamplingSettings {
                max_frames: None,
                views_per_part: None,
                ..FrameSamplingSettings::default()
            },
            superpoints: SuperpointSettings {
                voxel_m: 0.05,
                seed_m: 0.2,
                ..SuperpointSettings::default()
            },
            depth_tolerance: 0.15,
            merging: MergeSettings {
                keep_planes_apart: false,
                split_at_depth_edges: false,
                ..MergeSettings::default()
            },
            part_merging: PartMergingSettings { enabled: false, ..PartMergingSettings::default() },
            refine_borders: false,
            instances: InstanceSettings {
                stray_share: 0.0,
                thin_sigmas: 0.0,
                stray_neighbours: 0,
                min_agreement: 0.0,
                min_points: 0,
                parts_and_wholes: 0.0,
                ..InstanceSettings::default()
            },
            sam_masks: SamSettings::paper(),
            correction: CorrectionSettings::paper(),
            appearance: AppearanceSettings::paper(),
            ..Self::default()
        }
    }

    /// Checks all values. The error contains the JSON pointer of the first invalid field and the
    /// expected value.
    ///
    /// # Errors
    /// Returns the pointer and the expected value.
    pub fn check(&self) -> Result<(), (&'static str, &'static str)> {
        let Self {
            max_minutes,
            frame_sampling,
            superpoints,
            rgbd_masks,
            sam_masks,
            depth_tolerance,
            merging,
            part_merging,
            refine_borders: _,
            instances,
            views,
            correction,
            appearance,
        } = self;
        let positive = |v: f32| v.is_finite() && v > 0.0;
        let share = |v: f32| (0.0..=1.0).contains(&v);
        let weight = |v: f32| v.is_finite() && v >= 0.0;
        let rules: [(&str, bool, &str); 56] = [
            (
                "/max_minutes",
                max_minutes.is_none_or(|minutes| (0.1..=1440.0).contains(&minutes)),
                "0.1 to 1440 minutes, or null",
            ),
            ("/frame_sampling/stride_frames", frame_sampling.stride_frames > 0, "at least 1"),
            (
                "/frame_sampling/max_frames",
                frame_sampling.max_frames != Some(0),
                "at least 1, or null",
            ),
            (
                "/frame_sampling/views_per_part",
                frame_sampling.views_per_part != Some(0),
                "at least 1, or null",
            ),
            (
                "/superpoints/voxel_m",
                (0.001..=10.0).contains(&superpoints.voxel_m),
                "0.001 to 10 meters",
            ),
            (
                "/superpoints/seed_m",
                superpoints.seed_m.is_finite() && superpoints.seed_m >= superpoints.voxel_m,
                "at least voxel_m",
            ),
            (
                "/superpoints/seed_m",
                superpoints.seed_m <= 100.0 * superpoints.voxel_m,
                "at most 100 voxels",
            ),
            ("/superpoints/spatial_weight", weight(superpoints.spatial_weight), "0 or more"),
            ("/superpoints/normal_weight", weight(superpoints.normal_weight), "0 or more"),
            ("/superpoints/colour_weight", weight(superpoints.colour_weight), "0 or more"),
            (
                "/superpoints/smoothness_deg",
                (0.0..=90.0).contains(&superpoints.smoothness_deg),
                "0 to 90 degrees",
            ),
            ("/superpoints/curvature", weight(superpoints.curvature), "0 or more"),
            ("/superpoints/colour_tolerance", weight(superpoints.colour_tolerance), "0 or more"),
            ("/rgbd_masks/stride", (1..=16).contains(&rgbd_masks.stride), "1 to 16 pixels"),
            ("/rgbd_masks/colour_edge", positive(rgbd_masks.colour_edge), "above 0"),
            ("/rgbd_masks/concave_edge_deg", positive(rgbd_masks.concave_edge_deg), "above 0"),
            ("/rgbd_masks/convex_edge_deg", positive(rgbd_masks.convex_edge_deg), "above 0"),
            ("/rgbd_masks/patch_scale", weight(rgbd_masks.patch_scale), "0 or more"),
            ("/rgbd_masks/join_cost", weight(rgbd_masks.join_cost), "0 or more"),
            ("/rgbd_masks/join_colour", positive(rgbd_masks.join_colour), "above 0"),
            ("/rgbd_masks/join_concave_deg", positive(rgbd_masks.join_concave_deg), "above 0"),
            ("/rgbd_masks/plane_area_m2", weight(rgbd_masks.plane_area_m2), "0 or more"),
            (
                "/sam_masks/points_per_side",
                (1..=128).contains(&sam_masks.points_per_side),
                "1 to 128",
            ),
            ("/sam_masks/min_predicted_iou", sam_masks.min_predicted_iou.is_finite(), "a number"),
            ("/sam_masks/min_stability", share(sam_masks.min_stability), "0 to 1"),
            ("/sam_masks/stability_margin", weight(sam_masks.stability_margin), "0 or more"),
            ("/sam_masks/max_overlap", share(sam_masks.max_overlap), "0 to 1"),
            ("/sam_masks/min_area", share(sam_masks.min_area), "0 to 1"),
            ("/sam_masks/max_area", share(sam_masks.max_area), "0 to 1"),
            ("/sam_masks/max_masks", (1..=65_535).contains(&sam_masks.max_masks), "1 to 65535"),
            ("/depth_tolerance", (0.0..1.0).contains(depth_tolerance), "0 to 1"),
            (
                "/merging/thresholds",
                !merging.thresholds.is_empty() && merging.thresholds.iter().all(|&t| share(t)),
                "one or more values from 0 to 1",
            ),
            ("/merging/thresholds", merging.thresholds.len() <= 20, "at most 20 stages"),
            ("/merging/max_hop", (1..=4).contains(&merging.max_hop), "1 to 4"),
            (
                "/merging/hop_decay",
                share(merging.hop_decay) && merging.hop_decay > 0.0,
                "above 0, at most 1",
            ),
            ("/part_merging/leg_thickness_m", weight(part_merging.leg_thickness_m), "0 or more"),
            (
                "/part_merging/plate_thickness_m",
                weight(part_merging.plate_thickness_m),
                "0 or more",
            ),
            (
                "/part_merging/back_width",
                share(part_merging.back_width) && part_merging.back_width > 0.0,
                "above 0, at most 1",
            ),
            ("/part_merging/longest_m", weight(part_merging.longest_m), "0 or more"),
            ("/instances/stray_share", (0.0..0.5).contains(&instances.stray_share), "0 to 0.5"),
            ("/instances/thin_sigmas", weight(instances.thin_sigmas), "0 or more"),
            ("/instances/noise_sigmas", weight(instances.noise_sigmas), "0 or more"),
            ("/instances/trim", (0.0..0.5).contains(&instances.trim), "0 to 0.5"),
            (
                "/instances/stray_voxel_m",
                (0.001..=10.0).contains(&instances.stray_voxel_m),
                "0.001 to 10 meters",
            ),
            ("/instances/min_agreement", share(instances.min_agreement), "0 to 1"),
            (
                "/instances/parts_and_wholes",
                (0.0..=10.0).contains(&instances.parts_and_wholes),
                "0 to 10",
            ),
            ("/views/min_share_of_best", share(views.min_share_of_best), "0 to 1"),
            ("/views/count", (1..=16).contains(&views.count), "1 to 16"),
            ("/correction/rounds", correction.rounds <= 100, "at most 100"),
            ("/correction/points", (1..=100).contains(&correction.points), "1 to 100"),
            ("/correction/min_agreement", share(correction.min_agreement), "0 to 1"),
            (
                "/correction/known_agreement",
                correction.known_agreement.is_none_or(share),
                "0 to 1, or null",
            ),
            ("/appearance/views", (1..=100).contains(&appearance.views), "1 to 100"),
            ("/appearance/min_visible", share(appearance.min_visible), "0 to 1"),
            (
                "/appearance/levels",
                (1..=16).contains(&appearance.levels) && share(appearance.level_step),
                "1 to 16, steps of 0 to 1",
            ),
            ("/appearance/frames", appearance.frames <= 1000, "at most 1000"),
        ];
        rules
            .into_iter()
            .find(|(_, fine, _)| !fine)
            .map_or(Ok(()), |(pointer, _, expected)| Err((pointer, expected)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn both_presets_are_valid_and_round_trip_through_json() {
        for settings in [ParsingSettings::default(), ParsingSettings::paper()] {
            assert_eq!(settings.check(), Ok(()));
            let json = serde_json::to_string(&settings).unwrap();
            assert_eq!(serde_json::from_str::<ParsingSettings>(&json).unwrap(), settings);
        }
        assert!(
            serde_json::from_str::<ParsingSettings>(r#"{"superpoints":{"voxels":1}}"#).is_err()
        );
    }

    #[test]
    fn errors_of_invalid_values_name_the_setting() {
        let mut settings = ParsingSettings::default();
        settings.superpoints.voxel_m = f32::NAN;
        assert_eq!(settings.check().unwrap_err().0, "/superpoints/voxel_m");
    }
}
