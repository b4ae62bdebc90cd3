//! What is told of a parsed scan: ids, supports, views, reports.

use crate::geometry::up_axis::UpAxis;
use serde::{Deserialize, Serialize};

/// Position of a frame in the scan's own list; stable when frames are skipped.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(transparent)]
pub struct FrameIndex(pub u32);

impl std::fmt::Display for FrameIndex {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        self.0.fmt(f)
    }
}

/// Number of an instance within its scene, counted from 1: things in falling order of points, then
/// parts and wholes, best shown first.
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

/// What an instance is among the others. Every point belongs to one thing or none; parts and wholes
/// overlap them.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum Level {
    /// One of the pieces the scene is cut into.
    #[default]
    Thing,
    /// A piece of a thing that masks show by itself: a drawer, a seat.
    Part,
    /// Several things that masks show as one: blanket and headboard of a bed.
    Whole,
}

impl Level {
    /// As the API says it: `thing`, `part`, `whole`.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Thing => "thing",
            Self::Part => "part",
            Self::Whole => "whole",
        }
    }
}

/// Part of the building rather than an object in it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum Structure {
    /// A level plane at the bottom of the room.
    Floor,
    /// A level plane at the top of the room.
    Ceiling,
    /// An upright plane at the rim of the room.
    Wall,
}

impl Structure {
    /// As people and the API say it: `floor`, `ceiling`, `wall`.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Floor => "floor",
            Self::Ceiling => "ceiling",
            Self::Wall => "wall",
        }
    }
}

/// What an instance rests on.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(tag = "on", rename_all = "snake_case")]
pub enum Support {
    /// It stands on the floor.
    Floor,
    /// It stands on, or in, another instance.
    Instance {
        /// What carries it.
        id: InstanceId,
    },
    /// Nothing carries it; it hangs on a wall.
    Wall {
        /// The wall, itself an instance.
        id: InstanceId,
    },
    /// Nothing below or behind it was found.
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

/// A picture that shows an instance well.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct View {
    /// Position of the frame in the scan's own list, from 0.
    pub frame: FrameIndex,
    /// Points of the instance visible in this frame.
    pub visible_points: u32,
    /// Tight box of the visible points in the colour picture: left, top, right, bottom, pixels.
    pub box_px: [u32; 4],
    /// What of the box shows the instance; left out in parses that were made before it was kept.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mask: Option<ViewMask>,
}

/// The photographs of a scan, in its own order.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct FrameList {
    /// Empty for a scan without frames, and in parses that were made before frames were kept.
    pub frames: Vec<FrameView>,
}

/// A photograph: pinhole camera and pose.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct FrameView {
    /// Position in the scan's own list, from 0, as views name it; frames left out leave gaps.
    pub index: FrameIndex,
    /// Columns of the photograph.
    pub width: u32,
    /// Rows of the photograph.
    pub height: u32,
    /// Focal length along x, pixels.
    pub fx: f32,
    /// Focal length along y, pixels.
    pub fy: f32,
    /// Column where the optical axis meets the photograph; 0 is the middle of the first pixel.
    pub cx: f32,
    /// Row where the optical axis meets the photograph.
    pub cy: f32,
    /// Takes points of the camera (x right, y down, z forward) to the scene's world (Z up),
    /// metres; rows of a 4 x 4 matrix.
    pub camera_to_world: [[f32; 4]; 4],
}

/// A mask over a box, in cells of equal size, as COCO writes run lengths: its tools read it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct ViewMask {
    /// Rows and columns of cells, at most 64 each.
    pub size: [u32; 2],
    /// Lengths of runs down the columns, outside and inside by turns, in COCO's compressed
    /// letters.
    pub counts: String,
}

/// A name the encoder would give without having heard a question.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct NameGuess {
    /// An English noun of the built-in lexicon.
    pub name: String,
    /// How well the name fits and how usual such a thing is, `0..=1`.
    pub score: f32,
}

/// How poses are to be read.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum PoseConvention {
    /// A pose takes points of the camera to the world.
    CameraToWorld,
    /// A pose takes points of the world to the camera.
    WorldToCamera,
}

/// From the coordinates of the files that were uploaded to the scene's (metres, Z up): `scene =
/// rotation * (metres_per_unit * source) + translation_m`. In double precision: what lies at map
/// coordinates keeps its place.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct SourceToScene {
    /// Rows of a 3x3 rotation matrix.
    pub rotation: [[f64; 3]; 3],
    /// Metres, in the scene's axes.
    pub translation_m: [f64; 3],
    /// Length of one unit of the files, metres.
    pub metres_per_unit: f64,
}

impl SourceToScene {
    /// Files that are in the scene's own coordinates.
    pub const IDENTITY: Self = Self {
        rotation: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
        translation_m: [0.0; 3],
        metres_per_unit: 1.0,
    };

    /// A point of the files, in their units, in the scene: metres, Z up.
    #[must_use]
    pub fn apply(&self, source: [f64; 3]) -> [f64; 3] {
        let m = source.map(|c| c * self.metres_per_unit);
        std::array::from_fn(|i| {
            self.rotation[i].iter().zip(m).map(|(r, c)| r * c).sum::<f64>() + self.translation_m[i]
        })
    }

    /// A point of the scene (metres, Z up) in the files' own coordinates and units.
    #[must_use]
    pub fn invert(&self, scene: [f64; 3]) -> [f64; 3] {
        let d: [f64; 3] = std::array::from_fn(|i| scene[i] - self.translation_m[i]);
        std::array::from_fn(|i| {
            (0..3).map(|row| self.rotation[row][i] * d[row]).sum::<f64>() / self.metres_per_unit
        })
    }
}

/// How level a scan's world is.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Levelling {
    /// Angle between the axis called up in the files and what was found to be up, degrees.
    pub tilt_deg: f32,
    /// Whether the scene was turned by it. Worlds that are level within a few degrees stay as they
    /// are.
    pub turned: bool,
    /// Share of the surfaces looked at that are level or upright with it, `0..=1`.
    pub confidence: f32,
    /// What it was told by, a sentence.
    pub evidence: String,
}

/// What the importer found; part of the scene's public record.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct ImportReport {
    /// Layout that the files were read as: `uniground-scene/1`, `color-depth-pose`, `tum-rgbd` and
    /// so on.
    pub format: String,
    /// The axis of the files next to what is up; the stored scene has Z up. Of a tilted world
    /// `levelling` says the rest.
    pub up: UpAxis,
    /// From the files' coordinates to the scene's; `null` in records of before it was kept.
    #[serde(default)]
    pub source_to_scene: Option<SourceToScene>,
    /// How level the world of the files is, and by what that was told; `null` where nothing was
    /// there to tell by.
    #[serde(default)]
    pub levelling: Option<Levelling>,
    /// Which way the poses of the files were read.
    pub pose: PoseConvention,
    /// Camera axes of the files: `opencv` or `opengl`.
    pub camera_axes: String,
    /// Frames that can be used: those left out are not counted.
    pub frames: u32,
    /// Frames left out: their pose is marked as lost (infinite), or a file of theirs is damaged or
    /// missing. The warnings name them.
    pub frames_skipped: u32,
    /// Points in the archive's own cloud; `null` when the cloud is fused from the frames.
    pub cloud_points: Option<u64>,
    /// Share of sampled points that agree with the depth pictures they project into, `0..=1`;
    /// `null` where it could not be measured.
    pub reprojection_agreement: Option<f32>,
    /// What is odd but was accepted, each with its file or frame.
    pub warnings: Vec<String>,
}

/// What stage 1 did, for people who want to know what went wrong.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct ParseReport {
    /// Points of the cloud that was parsed.
    pub points: u64,
    /// Frames looked at, a sample of those imported.
    pub frames_used: u32,
    /// Small even patches the cloud was cut into before merging.
    pub superpoints: u32,
    /// Things found, structural ones included.
    pub instances: u32,
    /// Parts of things, and wholes of several, that masks show beside them.
    #[serde(default)]
    pub parts_and_wholes: u32,
    /// Instances flagged as floor, wall or ceiling.
    pub structural: u32,
    /// Regions that became no instance because the masks of the frames that see them show
    /// something else; their points belong to nothing.
    #[serde(default)]
    pub dropped: u32,
    /// Regions that became no instance because they have too few points and no frame shows more of
    /// them than a few pixels.
    #[serde(default)]
    pub specks: u32,
    /// Instances that no frame shows.
    pub without_views: u32,
    /// What each stage did and took, in order.
    pub stages: Vec<StageReport>,
    /// What may have made the result worse, a sentence each.
    pub warnings: Vec<String>,
}

/// One stage of a parse: what it took and what came out.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct StageReport {
    /// `import`, `superpoints`, `masks_and_lifting`, `gaps`, `planes`, `merging`, `part_merging`,
    /// `hierarchy`, `refinement`, `views`, `instances`, or with models `appearance`.
    pub stage: String,
    /// Wall-clock.
    pub seconds: f32,
    /// How many came out: points, superpoints, masks over all frames, regions, proposals of parts
    /// and wholes, instances, sightings of instances.
    #[serde(default)]
    pub produced: u64,
    /// Whether they were kept from an earlier parse of the scan that got so far under the same
    /// settings.
    #[serde(default)]
    pub reused: bool,
    /// Largest resident memory of the whole process during the stage, 10^6 bytes; `null` where the
    /// system does not tell.
    #[serde(default)]
    pub peak_memory_mb: Option<u32>,
}
