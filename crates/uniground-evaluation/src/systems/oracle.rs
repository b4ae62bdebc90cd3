//! Uses annotations as instances: perfect boxes, with perfect names or the encoder's names.

use crate::annotations::{Annotations, SceneObject};
use uniground_geometry::boxes::OrientedBox;
use uniground_geometry::color::ColorHistogram;
use uniground_geometry::progress::Progress;
use uniground_geometry::scene::{
    Embeddings, FrameRef, Instance, InstanceId, NameGuess, PointCloud, Structure, Support,
};
use uniground_geometry::{Point3, Vector3};
use uniground_models::neural::DualEncoder;
use uniground_models::{attributes, calibration};
use uniground_parsing::appearance;
use uniground_parsing::instances::{Body, find_supports, planarity};
use uniground_parsing::labels::Labels;
use uniground_parsing::lifting::MasksOfFrames;
use uniground_parsing::sharpness::SharpnessOfFrames;
use uniground_parsing::views::LabeledPoints;
use uniground_parsing::visibility::Visibility;
use uniground_parsing::{ParseError, ParsingSettings, views};

/// The source of names for annotated instances.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum NamedBy {
    Annotated,
    Encoder,
}

/// Planarity of an object without points: neither flat nor rough.
const UNKNOWN_PLANARITY: f32 = 0.4;

/// Builds instances with annotated boxes, in the order of the annotations. With annotated names,
/// annotated colors are used. Otherwise, or if there are none, colors come from the points of each
/// object in `cloud`, or from the annotated mean color if it has no points.
#[must_use]
pub fn instances_of(
    annotations: &Annotations,
    cloud: &PointCloud,
    names: NamedBy,
) -> Vec<Instance> {
    let objects = &annotations.objects;
    let label_of_point = annotations.label_points(cloud);
    let mut colors: Vec<Vec<[u8; 3]>> = vec![Vec::new(); objects.len()];
    let mut points: Vec<Vec<Point3<f32>>> = vec![Vec::new(); objects.len()];
    for (i, label) in label_of_point.iter().enumerate() {
        if let Some(Ok(object)) = label.map(|label| objects.binary_search_by_key(&label, |o| o.id))
        {
            colors[object].push(cloud.colors[i]);
            points[object].push(cloud.positions[i]);
        }
    }
    let structures: Vec<Option<Structure>> = objects.iter().map(SceneObject::structure).collect();
    let bodies: Vec<Body> =
        objects.iter().map(|o| Body::from_box(o.aabb, &oriented_box_of(o))).collect();
    let floor =
        objects.iter().find(|o| o.structure() == Some(Structure::Floor)).map(|o| o.aabb.max().z);
    let floor_z = floor
        .or_else(|| objects.iter().map(|o| o.aabb.min().z).min_by(f32::total_cmp))
        .unwrap_or(0.0);
    // Silent progress cannot be cancelled.
    let supports = find_supports(&bodies, &structures, floor_z, &Progress::silent())
        .unwrap_or_else(|_| vec![Support::Nothing; objects.len()]);
    let build = |(i, object): (usize, &SceneObject)| {
        let seen = &colors[i];
        let annotated = object.mean_rgb.map(|rgb| rgb.map(|v| v.clamp(0.0, 255.0) as u8));
        let mean_rgb = mean_color(seen).or(annotated).unwrap_or([128; 3]);
        let mut instance = Instance {
            oriented_box: oriented_box_of(object),
            point_count: seen.len() as u32,
            mean_rgb,
            colors: if names == NamedBy::Annotated && !object.colors.is_empty() {
                ColorHistogram::uniform(&object.colors)
            } else if seen.is_empty() {
                ColorHistogram::from_colors([mean_rgb])
            } else {
                ColorHistogram::from_colors(seen.iter().copied())
            },
            planarity: if seen.is_empty() { UNKNOWN_PLANARITY } else { planarity(&points[i]) },
            structure: structures[i],
            support: supports[i],
            height_above_floor_m: object.aabb.min().z - floor_z,
            ..Instance::from_box(InstanceId(i as u32 + 1), object.aabb)
        };
        if names == NamedBy::Annotated {
            give_name(&mut instance, &object.name);
        }
        instance
    };
    let mut instances: Vec<Instance> = objects.iter().enumerate().map(build).collect();
    if names == NamedBy::Encoder {
        attributes::name_all(&mut instances);
    }
    instances
}

/// Only the yaw of a tilted box is representable by an oriented box. Most objects stand upright.
fn oriented_box_of(object: &SceneObject) -> OrientedBox {
    let own = object.rotated_box();
    let (_, _, yaw_rad) = own.rotation.euler_angles();
    match own.rotation.transform_vector(&Vector3::z()).z > 0.99 {
        true => OrientedBox { center: own.center, size: own.size, yaw_rad },
        false => OrientedBox { center: object.aabb.center, size: object.aabb.size, yaw_rad: 0.0 },
    }
}

/// Computes embeddings and names of annotated instances with an encoder, from crops around their
/// annotated points.
///
/// # Errors
/// Returns an error for an unreadable frame, or a model that fails.
pub fn embed_and_name(
    annotations: &Annotations,
    instances: &mut [Instance],
    cloud: &PointCloud,
    frames: &[FrameRef],
    encoder: &DualEncoder,
    settings: &ParsingSettings,
) -> Result<Embeddings, ParseError> {
    let (own, instance_of_point) = object_points(annotations, cloud);
    let labels = Labels::from_things(&instance_of_point);
    let visibility = visibility(&own, &instance_of_point, settings);
    let labeled = LabeledPoints { labels: &labels, visibility: &visibility };
    let rows = appearance::embed_known(frames, instances, labeled, encoder, &settings.appearance)?;
    Ok(calibration::name_all(instances, encoder, &rows)?)
}

/// Chooses the frames that show annotated instances best.
///
/// # Errors
/// Returns an error for an unreadable frame.
pub(super) fn choose_views(
    annotations: &Annotations,
    instances: &mut [Instance],
    cloud: &PointCloud,
    frames: &[FrameRef],
    settings: &ParsingSettings,
) -> Result<(), ParseError> {
    let (own, instance_of_point) = object_points(annotations, cloud);
    let labels = Labels::from_things(&instance_of_point);
    let visibility = visibility(&own, &instance_of_point, settings);
    let labeled = LabeledPoints { labels: &labels, visibility: &visibility };
    let seen =
        views::compute_sightings(labeled, frames, &MasksOfFrames::new(), &Progress::silent())?;
    views::choose_views(instances, seen, frames, &SharpnessOfFrames::new(), &settings.views);
    Ok(())
}

fn visibility(
    cloud: &PointCloud,
    instance_of_point: &[InstanceId],
    settings: &ParsingSettings,
) -> Visibility {
    let group_of: Vec<u32> = instance_of_point.iter().map(|id| id.0).collect();
    Visibility::new(cloud, &group_of, settings.depth_tolerance)
}

/// Returns the points that are annotated as part of an object, with the objects' ids.
fn object_points(annotations: &Annotations, cloud: &PointCloud) -> (PointCloud, Vec<InstanceId>) {
    let mut own = PointCloud::default();
    let mut instance_of_point = Vec::new();
    for (i, label) in annotations.label_points(cloud).iter().enumerate() {
        if let Some(Ok(object)) =
            label.map(|label| annotations.objects.binary_search_by_key(&label, |o| o.id))
        {
            own.positions.push(cloud.positions[i]);
            own.colors.push(cloud.colors[i]);
            instance_of_point.push(InstanceId(object as u32 + 1));
        }
    }
    (own, instance_of_point)
}

/// Names an instance, with the lexicon's word if it has one.
pub(super) fn give_name(instance: &mut Instance, name: &str) {
    let known = attributes::Lexicon::get()
        .find(name)
        .map_or_else(|| name.to_owned(), |noun| noun.name.clone());
    instance.names = vec![NameGuess { name: known, score: 1.0 }];
    instance.given_name = Some(name.to_owned());
}

fn mean_color(colors: &[[u8; 3]]) -> Option<[u8; 3]> {
    let n = colors.len() as u64;
    let sum =
        colors.iter().fold([0_u64; 3], |sum, c| std::array::from_fn(|i| sum[i] + u64::from(c[i])));
    (n > 0).then(|| sum.map(|s| ((s + n / 2) / n) as u8))
}
