//! Parts of a parsed scan: ids, supports, views and reports.

use crate::findings::Finding;
use crate::geometry::up_axis::UpAxis;
use serde::{Deserialize, Serialize};

/// Index of a frame in the scan's own list. Skipped frames keep their index.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(transparent)]
pub struct FrameIndex(pub u32);

impl std::fmt::Display for FrameIndex {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        self.0.fmt(f)
    }
}

/// Id of an instance within its scene, from 1: objects by descending number of points, then parts
/// and wholes, best visible first.
#[derive(
    Debug, Clone, Copy, Default, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize,
)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(transparent)]
pub struct InstanceId(pub u32);

impl std::fmt::Display for InstanceId {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        self.0.fmt(f)
    }
}

/// Level of an instance. Each point belongs to at most one object. Parts and wholes overlap
/// objects.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum Level {
    /// An object: one segment of the scene.
    #[default]
    Thing,
    /// A part of an object that masks show separately: a drawer, a seat.
    Part,
    /// A group of objects that masks show as one: blanket and headboard of a bed.
    Whole,
}

impl Level {
    /// Returns the name in the API: `thing`, `part`, `whole`.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Thing => "thing",
            Self::Part => "part",
            Self::Whole => "whole",
        }
    }
}

/// Kind of building element.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum Structure {
    /// A horizontal plane at the bottom of the room.
    Floor,
    /// A horizontal plane at the top of the room.
    Ceiling,
    /// A vertical plane at the boundary of the room.
    Wall,
}

impl Structure {
    /// Returns the name in the API: `floor`, `ceiling`, `wall`.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Floor => "floor",
            Self::Ceiling => "ceiling",
            Self::Wall => "wall",
        }
    }
}

/// Support of an instance.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(tag = "on", rename_all = "snake_case")]
pub enum Support {
    /// It stands on the floor.
    Floor,
    /// It stands on or in another instance.
    Instance {
        /// Id of the supporting instance.
        id: InstanceId,
    },
    /// It hangs on a wall.
    Wall {
        /// Id of the wall instance.
        id: InstanceId,
    },
    /// No support was found below or behind it.
    Nothing,
}

impl std::fmt::Display for Support {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Floor => f.write_str("floor"),
            Self::Instance { id } => write!(f, "instance {id}"),
            Self::Wall { id } => write!(f, "wall {id}"),
            Self::Nothing => f.write_str("nothing found"),
        }
    }
}

/// A frame with a good view of an instance.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct View {
    /// Index of the frame in the scan's own list, from 0.
    pub frame: FrameIndex,
    /// Number of the instance's points that are visible in this frame.
    pub visible_points: u32,
    /// Tight box of the visible points in the color picture: left, top, right, bottom, pixels.
    pub box_px: [u32; 4],
    /// Mask of the instance within the box. Absent in parses from older versions.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mask: Option<ViewMask>,
}

/// The photographs of a scan, in their own order.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct FrameList {
    /// Photographs. Empty for a scan without frames, and for parses from older versions.
    pub frames: Vec<FrameView>,
}

/// A photograph with its pinhole camera and pose.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct FrameView {
    /// Index in the scan's own list, from 0, as used by views. Skipped frames leave gaps.
    pub index: FrameIndex,
    /// Width of the photograph, pixels.
    pub width: u32,
    /// Height of the photograph, pixels.
    pub height: u32,
    /// Focal length along x, pixels.
    pub fx: f32,
    /// Focal length along y, pixels.
    pub fy: f32,
    /// Column of the principal point, pixels. 0 is the center of the first pixel.
    pub cx: f32,
    /// Row of the principal point, pixels. 0 is the center of the first pixel.
    pub cy: f32,
    /// Transform from camera (x right, y down, z forward) to world coordinates (Z up), meters. Rows
    /// of a 4 x 4 matrix.
    pub camera_to_world: [[f32; 4]; 4],
}

/// A mask over a box with cells of equal size, in COCO's run-length encoding.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct ViewMask {
    /// Rows and columns of cells, at most 64 each.
    pub size: [u32; 2],
    /// Run lengths down the columns, alternating outside and inside, in COCO's compressed format.
    pub counts: String,
}

/// A name guess of the encoder, independent of any question.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct NameGuess {
    /// An English noun from the built-in lexicon.
    pub name: String,
    /// Fit of the name combined with its frequency, `0..=1`.
    pub score: f32,
}

/// Direction of the poses in the files.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum PoseConvention {
    /// A pose transforms camera coordinates to world coordinates.
    CameraToWorld,
    /// A pose transforms world coordinates to camera coordinates.
    WorldToCamera,
}

/// Transform from the uploaded files to the scene (meters, Z up): `scene = rotation *
/// (metres_per_unit * source) + translation_m`. Double precision, so that large map coordinates
/// keep their precision.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct SourceToScene {
    /// Rows of a 3x3 rotation matrix.
    pub rotation: [[f64; 3]; 3],
    /// Translation in the scene's axes, meters.
    pub translation_m: [f64; 3],
    /// Length of one unit of the files, meters.
    pub metres_per_unit: f64,
}

impl SourceToScene {
    /// Transform of files that use the scene's coordinates.
    pub const IDENTITY: Self = Self {
        rotation: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
        translation_m: [0.0; 3],
        metres_per_unit: 1.0,
    };

    /// Transforms a point from the files, in their units, to the scene: meters, Z up.
    #[must_use]
    pub fn apply(&self, source: [f64; 3]) -> [f64; 3] {
        let m = source.map(|c| c * self.metres_per_unit);
        std::array::from_fn(|i| {
            self.rotation[i].iter().zip(m).map(|(r, c)| r * c).sum::<f64>() + self.translation_m[i]
        })
    }

    /// Transforms a point from the scene (meters, Z up) to the files' coordinates and units.
    #[must_use]
    pub fn invert(&self, scene: [f64; 3]) -> [f64; 3] {
        let d: [f64; 3] = std::array::from_fn(|i| scene[i] - self.translation_m[i]);
        std::array::from_fn(|i| {
            (0..3).map(|row| self.rotation[row][i] * d[row]).sum::<f64>() / self.metres_per_unit
        })
    }
}

/// Tilt of a scan's world and its correction.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Levelling {
    /// Angle between the up axis of the files and the estimated up direction, degrees.
    pub tilt_deg: f32,
    /// Whether the scene was rotated to correct the tilt. Small tilts of a few degrees are not
    /// corrected.
    pub turned: bool,
    /// Share of the examined surfaces that are horizontal or vertical after correction, `0..=1`.
    pub confidence: f32,
    /// Evidence for the estimate, one sentence.
    pub evidence: String,
}

/// Report of the importer. Part of the scene in the API.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct ImportReport {
    /// Detected layout of the files: `uniground-scene/1`, `color-depth-pose`, `tum-rgbd` and so on.
    pub format: String,
    /// Axis of the files that is nearest to up. The stored scene has Z up. `levelling` gives the
    /// remaining tilt.
    pub up: UpAxis,
    /// Transform from the files to the scene. `null` in records from older versions.
    #[serde(default)]
    pub source_to_scene: Option<SourceToScene>,
    /// Tilt of the files' world and its evidence. `null` if it could not be estimated.
    #[serde(default)]
    pub levelling: Option<Levelling>,
    /// Direction of the poses in the files.
    pub pose: PoseConvention,
    /// Camera axes of the files: `opencv`, `opengl` or `ros`.
    pub camera_axes: String,
    /// Number of usable frames, without skipped ones.
    pub frames: u32,
    /// Number of skipped frames: their pose is marked as lost (infinite), or one of their files is
    /// damaged or missing. The warnings name them.
    pub frames_skipped: u32,
    /// Number of points in the archive's own cloud. `null` if the cloud is fused from the frames.
    pub cloud_points: Option<u64>,
    /// Share of sampled points that agree with the depth pictures they project into, `0..=1`.
    /// `null` if it could not be measured.
    pub reprojection_agreement: Option<f32>,
    /// Median distance of the surfaces that the depth pictures show, meters. `null` without frames,
    /// and in records from older versions.
    #[serde(default)]
    pub viewing_distance_m: Option<f32>,
    /// The texts of the findings that can make results worse.
    pub warnings: Vec<String>,
    /// What was read, left out, assumed and changed. Empty in records from older versions.
    #[serde(default)]
    pub findings: Vec<Finding>,
}

/// Closer than these, a scan is fused and segmented 2 and 3 times as fine as one of a room, meters.
const CLOSE_M: f32 = 1.3;
const VERY_CLOSE_M: f32 = 0.8;

/// Returns how many times as fine as a room a scan is fused and segmented whose surfaces are this
/// far away, meters.
#[must_use]
pub fn detail_at(viewing_distance_m: Option<f32>) -> f32 {
    match viewing_distance_m {
        Some(distance) if distance < VERY_CLOSE_M => 3.0,
        Some(distance) if distance < CLOSE_M => 2.0,
        _ => 1.0,
    }
}

impl ImportReport {
    /// Returns how many times as fine as a room the scan is fused and segmented: 1 for a room, more
    /// for a desk that was scanned from close by.
    #[must_use]
    pub fn detail(&self) -> f32 {
        detail_at(self.viewing_distance_m)
    }

    /// Adds findings. Those that are warnings are added to the warnings too.
    pub fn add_findings(&mut self, findings: Vec<Finding>) {
        let warnings = findings.iter().filter(|finding| finding.warning);
        self.warnings.extend(warnings.map(|finding| finding.text.clone()));
        self.findings.extend(findings);
    }

    /// Counts frames as skipped that turned out to be unusable.
    pub fn count_undecodable(&mut self, frames: usize) {
        let frames = (frames as u32).min(self.frames);
        self.frames -= frames;
        self.frames_skipped += frames;
    }
}

/// Report of stage 1 (parsing) for diagnosis.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct ParseReport {
    /// Number of points in the parsed cloud.
    pub points: u64,
    /// Number of frames used, a sample of the imported ones.
    pub frames_used: u32,
    /// Number of superpoints: small uniform patches of the cloud.
    pub superpoints: u32,
    /// Number of objects, including building elements.
    pub instances: u32,
    /// Number of parts of objects, and of wholes that group several.
    #[serde(default)]
    pub parts_and_wholes: u32,
    /// Number of instances classified as floor, wall or ceiling.
    pub structural: u32,
    /// Number of regions rejected because the masks of the frames do not support them. Their points
    /// belong to no instance.
    #[serde(default)]
    pub dropped: u32,
    /// Number of regions rejected because they have too few points and are tiny in all frames.
    #[serde(default)]
    pub specks: u32,
    /// Number of instances that no frame shows.
    pub without_views: u32,
    /// Result and duration of each stage, in order.
    pub stages: Vec<StageReport>,
    /// Possible causes of a worse result, one sentence each.
    pub warnings: Vec<String>,
}

/// Report of one stage of a parse.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct StageReport {
    /// Name of the stage: `import`, `superpoints`, `masks_and_lifting`, `gaps`, `planes`,
    /// `merging`, `part_merging`, `hierarchy`, `refinement`, `views`, `instances`, or with models
    /// `appearance`.
    pub stage: String,
    /// Wall-clock duration, seconds.
    pub seconds: f32,
    /// Number of results: points, superpoints, masks over all frames, regions, proposed parts and
    /// wholes, instances, or views of instances.
    #[serde(default)]
    pub produced: u64,
    /// Whether the results come from a checkpoint of an earlier parse with the same settings.
    #[serde(default)]
    pub reused: bool,
    /// Peak resident memory of the process during the stage, 10^6 bytes. `null` if the system does
    /// not report it.
    #[serde(default)]
    pub peak_memory_mb: Option<u32>,
    /// Time spent in models. Absent for stages without models, and for what a checkpoint held.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub models: Vec<ModelTime>,
}

/// Time that a stage spent in one network.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct ModelTime {
    /// The network.
    pub network: ModelNetwork,
    /// Number of inputs: pictures, or prompts of a mask decoder.
    pub inputs: u64,
    /// Duration of all calls, seconds, summed over threads. Includes the wait for a free session of
    /// the network.
    pub seconds: f32,
}

/// A network that a parse uses.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum ModelNetwork {
    /// Encodes a picture for the mask decoder.
    MaskEncoder,
    /// Computes masks from prompts.
    MaskDecoder,
    /// Embeds a picture.
    PictureEncoder,
}

impl std::fmt::Display for ModelTime {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let (network, inputs) = match self.network {
            ModelNetwork::MaskEncoder => ("mask encoder", "pictures"),
            ModelNetwork::MaskDecoder => ("mask decoder", "prompts"),
            ModelNetwork::PictureEncoder => ("picture encoder", "pictures"),
        };
        write!(f, "{network}: {} {inputs}, {:.1} s over all threads", self.inputs, self.seconds)
    }
}
