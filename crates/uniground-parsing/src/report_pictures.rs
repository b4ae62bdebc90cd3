//! Pictures of a parse for diagnosis: the cloud by superpoint and by instance, and the instances
//! drawn over a few frames.

use super::ParseError;
use rayon::prelude::*;
use uniground_geometry::boxes::Aabb;
use uniground_geometry::progress::Progress;
use uniground_geometry::scene::{
    FrameError, FrameRef, Instance, InstanceId, ParsedScene, PointCloud, id_color,
};
use uniground_render::{
    Orbit, ROOM_VIEW, RenderScene, draw_frame_overlay, draw_scene, encode_jpeg,
};

/// One picture of a report.
pub struct ReportPicture {
    /// `superpoints`, `instances`, `frame-1`, ...
    pub name: String,
    /// Description for people.
    pub title: String,
    /// The encoded file.
    pub jpeg: Vec<u8>,
}

/// Maximum number of frames shown.
const FRAMES: usize = 3;
const STRUCTURE_GRAY: [u8; 3] = [200, 200, 200];
/// Color of points that belong to no instance.
const DROPPED_GRAY: [u8; 3] = [90, 90, 90];

/// Renders the pictures: two of the cloud, and one for each of up to three frames spread over the
/// scan.
///
/// # Errors
/// [`ParseError`] for unreadable frames and cancellation.
pub fn render(
    scene: &ParsedScene,
    frames: &[FrameRef],
    progress: &Progress,
) -> Result<Vec<ReportPicture>, ParseError> {
    let by_superpoint = RenderScene::with_building(
        with_colors(scene, |i| id_color(scene.superpoint_of_point[i])),
        &scene.instances,
    );
    let by_instance = RenderScene::with_building(
        with_colors(scene, |i| instance_color(&scene.instances, scene.instance_of_point[i])),
        &scene.instances,
    );
    let count = FRAMES.min(frames.len());
    let shown = (0..count).map(|k| &frames[frames.len() * (2 * k + 1) / (2 * count)]);
    let structural = scene.report.structural;
    let mut jobs: Vec<(String, String, PictureSubject)> = vec![
        (
            "superpoints".into(),
            format!("The cloud by superpoint ({})", scene.report.superpoints),
            PictureSubject::Cloud(&by_superpoint),
        ),
        (
            "instances".into(),
            format!(
                "The cloud by instance ({}, {structural} of them structural and gray)",
                scene.report.instances
            ),
            PictureSubject::Cloud(&by_instance),
        ),
    ];
    jobs.extend(shown.enumerate().map(|(k, frame)| {
        let title = format!("Instances over frame {}", frame.index);
        (format!("frame-{}", k + 1), title, PictureSubject::Frame(frame))
    }));
    jobs.into_par_iter()
        .map(|(name, title, subject)| {
            progress.check()?;
            let picture = match subject {
                PictureSubject::Cloud(cloud) => draw_scene(cloud, &scene.extent, &ROOM_VIEW, &[]),
                PictureSubject::Frame(frame) => {
                    draw_frame_overlay(&frame.decode_color()?, &frame.color_camera(), &by_instance)
                }
            };
            Ok(ReportPicture { name, title, jpeg: encode_jpeg(&picture) })
        })
        .collect()
}

/// Renders a thumbnail of the room in its own colors, for lists of rooms. JPEG.
#[must_use]
pub fn thumbnail(render_scene: &RenderScene, extent: &Aabb) -> Vec<u8> {
    let small = Orbit { width: 320, height: 240, ..ROOM_VIEW };
    encode_jpeg(&draw_scene(render_scene, extent, &small, &[]))
}

/// Draws the instances in a photograph in their colors, half transparent; parts of the building are
/// gray. `shown_as` returns the instance as which each point is drawn.
///
/// # Errors
/// An unreadable photograph.
pub fn photograph_with_instances(
    frame: &FrameRef,
    cloud: &PointCloud,
    instances: &[Instance],
    shown_as: impl Fn(usize) -> InstanceId + Sync + Send,
) -> Result<Vec<u8>, FrameError> {
    let colors = (0..cloud.len())
        .into_par_iter()
        .map(|point| instance_color(instances, shown_as(point)))
        .collect();
    let colored = RenderScene::new(PointCloud { positions: cloud.positions.clone(), colors });
    Ok(encode_jpeg(&draw_frame_overlay(&frame.decode_color()?, &frame.color_camera(), &colored)))
}

enum PictureSubject<'a> {
    Cloud(&'a RenderScene),
    Frame(&'a FrameRef),
}

fn with_colors(scene: &ParsedScene, color: impl Fn(usize) -> [u8; 3] + Sync + Send) -> PointCloud {
    let positions = scene.cloud.positions.clone();
    PointCloud { colors: (0..positions.len()).into_par_iter().map(color).collect(), positions }
}

fn instance_color(instances: &[Instance], id: InstanceId) -> [u8; 3] {
    let instance = (id.0 as usize).checked_sub(1).and_then(|i| instances.get(i));
    match instance {
        None => DROPPED_GRAY,
        Some(instance) if instance.structure.is_some() => STRUCTURE_GRAY,
        Some(_) => id_color(id.0),
    }
}
