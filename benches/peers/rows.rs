//! The comparisons: each function returns the rows of one job.

use crate::duel::{Comparison, OwnSide, Run, Side};
use crate::process::Peer;
use crate::vccs::Vccs;
use anyhow::anyhow;
use camino::Utf8PathBuf;
use image::RgbImage;
use std::collections::HashSet;
use std::sync::Arc;
use std::time::Instant;
use uniground_core::geometry::boxes::Aabb;
use uniground_core::geometry::statistics::quantile;
use uniground_core::geometry::voxels::{VoxelGrid, typical_spacing_m};
use uniground_core::geometry::{Point3, Vector3};
use uniground_core::ingest::read_cloud;
use uniground_core::models::neural::{Encoded, Prompt, Segmenter};
use uniground_core::parsing::superpoints;
use uniground_core::progress::Progress;
use uniground_core::render::{ROOM_VIEW, RenderScene, draw_scene};
use uniground_core::scene::{PointCloud, write_cloud_ply};
use uniground_types::settings::SuperpointSettings;

/// Edge of the voxels for thinning a cloud, in meters.
const THINNED_M: f32 = 0.05;
/// The ceiling cut and the splat size of `draw_scene`, so that the peer's mesh shows the same.
const CEILING_PERCENTILE: f32 = 0.95;
const SPLAT_OVERLAP: f32 = 1.6;
/// The background of `draw_scene`.
const BACKGROUND: [u8; 3] = [250, 250, 250];

/// The cloud in memory, the same as a file, and its extent.
pub struct Input {
    pub cloud: PointCloud,
    file: Utf8PathBuf,
    extent: Aabb,
}

impl Input {
    /// Writes the cloud to `file`, from which the peers read it.
    pub fn new(cloud: PointCloud, file: Utf8PathBuf) -> Self {
        write_cloud_ply(&cloud, std::fs::File::create(&file).unwrap()).unwrap();
        let extent = Aabb::around(&cloud.positions).unwrap();
        Self { cloud, file, extent }
    }

    /// The cloud, the camera of the render, and a mesh of the squares that the render consists of.
    pub fn for_open3d(&self) -> [String; 3] {
        let camera = ROOM_VIEW.camera(&self.extent);
        let of = camera.intrinsics;
        let ceiling_m = quantile(
            &mut self.cloud.positions.iter().map(|p| p.z).collect::<Vec<_>>(),
            CEILING_PERCENTILE,
        )
        .unwrap();
        let rows = camera.world_to_camera().to_homogeneous().transpose();
        let pose: String = rows.iter().map(|v| format!(" {v}")).collect();
        let side_m = typical_spacing_m(&self.cloud.positions) * SPLAT_OVERLAP;
        [
            format!("read {}", self.file),
            format!(
                "camera {} {} {} {} {} {} {ceiling_m}{pose}",
                of.width, of.height, of.fx, of.fy, of.cx, of.cy
            ),
            format!("squares {side_m}"),
        ]
    }
}

/// Times `work`; its result is described outside of the timing.
fn timed<T>(work: impl Fn() -> T, tell: impl Fn(&T) -> String) -> Run {
    let start = Instant::now();
    let result = work();
    let ms = start.elapsed().as_secs_f32() * 1000.0;
    Run { ms, gives: tell(&result) }
}

fn ask_peer(peer: &Peer, command: String) -> Side<'_> {
    Box::new(move || peer.ask(&command))
}

fn own_superpoints(input: &Input, settings: SuperpointSettings) -> Side<'_> {
    let work = move || superpoints::compute(&input.cloud, &settings, &Progress::silent()).unwrap();
    Box::new(move || Ok(timed(work, |found| format!("{} superpoints", found.patches.len()))))
}

pub fn superpoints<'a>(input: &'a Input, vccs: &'a anyhow::Result<Vccs>) -> Vec<Comparison<'a>> {
    let default = SuperpointSettings::default();
    let same = SuperpointSettings { voxel_m: 0.05, seed_m: 0.2, ..default };
    let against = |ours: SuperpointSettings, voxel: &'static str, differ: &str| Comparison {
        what: format!("superpoints {}/{}, PCL VCCS {voxel}/.2", ours.voxel_m, ours.seed_m),
        ours: OwnSide::Same(own_superpoints(input, ours)),
        peer: Box::new(move || {
            let (seconds, labels) =
                vccs.as_ref().map_err(|e| anyhow!("{e:#}"))?.run(voxel, ".2")?;
            let distinct: HashSet<u32> = labels.into_iter().filter(|label| *label > 0).collect();
            Ok(Run { ms: seconds * 1000.0, gives: format!("{} superpoints", distinct.len()) })
        }),
        differ: differ.to_owned(),
    };
    vec![
        against(
            same,
            ".05",
            "The same voxel and seed. PCL runs on one core, in a new process each time; uniground uses all \
                 cores.",
        ),
        against(default, ".05", "uniground's default settings and the peer's usual ones."),
        against(
            default,
            ".02",
            "uniground's default settings and the peer's settings of similar quality (`make \
                 bench-superpoints` measures it).",
        ),
    ]
}

pub fn reading<'a>(input: &'a Input, open3d: &'a Peer) -> Comparison<'a> {
    Comparison {
        what: "reading a binary PLY, Open3D `io.read_point_cloud`".into(),
        ours: OwnSide::Same(Box::new(|| Ok(timed(|| read_cloud(&input.file).unwrap(), |cloud| format!("{} points", cloud.len()))))),
        peer: ask_peer(open3d, format!("read {}", input.file)),
        differ: "The same file, in the page cache. uniground stores 32-bit coordinates and 8-bit colors and \
                 checks both; Open3D converts all to 64-bit floats."
            .into(),
    }
}

pub fn thinning<'a>(input: &'a Input, open3d: &'a Peer) -> Comparison<'a> {
    Comparison {
        what: format!("thinning to {THINNED_M} m voxels, Open3D `voxel_down_sample`"),
        ours: OwnSide::Same(Box::new(|| Ok(timed(|| means(&input.cloud), |cloud| format!("{} voxels", cloud.len()))))),
        peer: ask_peer(open3d, format!("voxels {THINNED_M}")),
        differ: "uniground has no such call: the bench uses its public `VoxelGrid::new` and computes the means \
                 of points and colors on one core. Its grid starts at the origin and cuts this room's walls \
                 into two layers; Open3D's starts at the cloud's corner and fills fewer voxels."
            .into(),
    }
}

/// Returns the mean point and color of every voxel.
fn means(cloud: &PointCloud) -> PointCloud {
    let grid = VoxelGrid::new(&cloud.positions, THINNED_M);
    let mut sums = vec![(0.0, Vector3::zeros(), Vector3::zeros()); grid.len()];
    for ((p, c), &voxel) in cloud.positions.iter().zip(&cloud.colors).zip(&grid.of_point) {
        let (count, position, color) = &mut sums[voxel as usize];
        *count += 1.0;
        *position += p.coords;
        *color += Vector3::from(c.map(f32::from));
    }
    let mean = |(count, position, color): (f32, Vector3<f32>, Vector3<f32>)| {
        (Point3::from(position / count), <[u8; 3]>::from((color / count).map(|c| c.round() as u8)))
    };
    let (positions, colors) = sums.into_iter().map(mean).unzip();
    PointCloud { positions, colors }
}

pub fn normals<'a>(input: &'a Input, open3d: &'a Peer) -> Vec<Comparison<'a>> {
    let voxel_m = SuperpointSettings::default().voxel_m;
    let against = |what: String, command: String, differ: &str| Comparison {
        what,
        ours: OwnSide::Within(own_superpoints(input, SuperpointSettings::default())),
        peer: ask_peer(open3d, command),
        differ: format!(
            "{differ} uniground computes normals only as a part of superpoints: the figure is that of all \
                 of superpoints."
        ),
    };
    vec![
        against(
            format!("normals of {voxel_m} m voxels, Open3D `estimate_normals`"),
            format!("voxel_normals {voxel_m}"),
            "One normal per voxel on both sides. Open3D: from the 30 nearest voxel means, which are \
                 computed beforehand. uniground: from the points of the voxel and the 26 around it.",
        ),
        against(
            "normals of all points, Open3D `estimate_normals`".into(),
            "normals".into(),
            "Open3D: one normal per point, from the 30 nearest. uniground: one per voxel, which is less \
                 work.",
        ),
    ]
}

pub fn drawing<'a>(input: &'a Input, open3d: &'a Peer) -> Vec<Comparison<'a>> {
    let size = format!("{}x{}", ROOM_VIEW.width, ROOM_VIEW.height);
    let against = |how: &str, command: &str, differ: String| Comparison {
        what: format!("render of the room, {size}, Open3D {how}"),
        ours: OwnSide::Same(Box::new(|| {
            let drawn = |picture: &image::RgbImage| {
                format!("{} pixels", picture.pixels().filter(|p| p.0 != BACKGROUND).count())
            };
            Ok(timed(
                || {
                    draw_scene(
                        &RenderScene::new(input.cloud.clone()),
                        &input.extent,
                        &ROOM_VIEW,
                        &[],
                    )
                },
                drawn,
            ))
        })),
        peer: ask_peer(open3d, command.into()),
        differ,
    };
    let mesh = open3d
        .prepared
        .last()
        .map_or_else(String::new, |run| format!(" ({} built once in {:.0} ms)", run.gives, run.ms));
    vec![
        against(
            "`project_to_rgbd_image`",
            "project",
            "The same camera and points. uniground detects the ceiling and the point spacing, and closes \
                 gaps with squares; Open3D colors one pixel per point, and the ceiling was removed beforehand."
                .into(),
        ),
        against(
            "`RaycastingScene`",
            "cast",
            format!(
                "One ray per pixel from the same camera at the squares that uniground renders, two triangles \
                 per point{mesh}. The mesh, its tree, the rays and the removed ceiling are prepared beforehand; \
                 uniground starts from the points each time."
            ),
        ),
    ]
}

/// A segmenter and an image that it has encoded.
pub struct EncodedImage {
    pub segmenter: Arc<Segmenter>,
    pub picture: RgbImage,
    pub encoded: Encoded,
}

pub fn perception<'a>(
    ours: &'a anyhow::Result<EncodedImage>,
    onnxruntime: &'a Peer,
) -> Vec<Comparison<'a>> {
    let measured = |work: fn(&EncodedImage) -> String| -> OwnSide<'a> {
        OwnSide::Same(Box::new(move || match ours {
            Ok(asked) => Ok(timed(|| work(asked), Clone::clone)),
            Err(why) => anyhow::bail!("{why:#}"),
        }))
    };
    vec![
        Comparison {
            what: "SAM 2 tiny, one image encoded, onnxruntime (Python)".into(),
            ours: measured(|asked| {
                asked.segmenter.encode(&asked.picture).unwrap();
                "1 image".into()
            }),
            peer: ask_peer(onnxruntime, "encode".into()),
            differ: "The same network with the same number of threads. uniground starts from the image: resizing, \
                 normalizing and copying the features are timed; the peer's input is prepared."
                .into(),
        },
        Comparison {
            what: "SAM 2 tiny, two prompts decoded, onnxruntime (Python)".into(),
            ours: measured(|asked| {
                let masks = asked
                    .segmenter
                    .decode(&asked.encoded, &[Prompt::from_inside_points([(300.0, 200.0)]), Prompt::from_inside_points([(100.0, 90.0)])]);
                format!("{} masks", masks.unwrap().iter().map(Vec::len).sum::<usize>())
            }),
            peer: ask_peer(onnxruntime, "decode 2".into()),
            differ:
                "One thread each, because a parse decodes two prompts at a time from two threads. uniground \
                 returns one mask after the other; the peer returns whole arrays."
                    .into(),
        },
    ]
}
