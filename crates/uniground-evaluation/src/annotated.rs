//! Annotated rooms: an archive `<room>.zip`, its objects in `<room>.scene.json` and, optionally,
//! the object of each point of its cloud in `<room>.cloud_instance.npy`.

use super::annotations::{Annotations, SceneObject};
use super::segmentation::AnnotatedObject;
use anyhow::{Context, ensure};
use camino::Utf8Path;
use nalgebra::UnitQuaternion;
use std::collections::BTreeMap;
use std::sync::Arc;
use uniground_geometry::boxes::Aabb;
use uniground_geometry::progress::Progress;
use uniground_geometry::scene::{Frame, PointCloud, SceneBundle, Structure};
use uniground_geometry::voxels::{VoxelKey, VoxelMap};
use uniground_geometry::{Point3, Vector3};
use uniground_ingest;
use uniground_ingest::archive::{ArchiveKind, UnpackLimits, unpack};
use uniground_parsing::ParseError;
use uniground_parsing::masks::{IdImage, MaskSource};
use uniground_types::settings::{ImportSettings, LevellingChoice};

/// An annotated room, loaded.
#[derive(Clone)]
pub struct AnnotatedRoom {
    pub bundle: SceneBundle,
    /// Annotated id of each point of the bundle's cloud; 0 = none.
    pub truth: Vec<u32>,
    annotations: Arc<Annotations>,
    /// Rotation of the world about Z relative to the annotations, degrees.
    turned_deg: f32,
}

impl AnnotatedRoom {
    /// Loads `<name>.zip` and its annotations from `folder`. The archive is unpacked into
    /// `scratch`, which must outlive the room.
    ///
    /// # Errors
    /// Returns an error that names the unreadable or malformed file.
    pub fn load(folder: &Utf8Path, name: &str, scratch: &Utf8Path) -> anyhow::Result<Self> {
        let file = Annotations::find_file(folder, name)
            .with_context(|| format!("{folder}: no annotations of {name}"))?;
        let (annotations, omissions) = Annotations::read(&file);
        ensure!(
            omissions.is_empty(),
            "{}",
            omissions.iter().map(ToString::to_string).collect::<Vec<_>>().join("; ")
        );
        unpack(
            &folder.join(format!("{name}.zip")),
            ArchiveKind::Zip,
            scratch,
            &UnpackLimits::default(),
        )?;
        let bundle = uniground_ingest::load(
            &uniground_ingest::open(scratch)?,
            &ImportSettings { levelling: LevellingChoice::Off, ..ImportSettings::default() },
            &Progress::silent(),
        )?;
        let truth = annotations
            .label_points(&bundle.cloud)
            .into_iter()
            .map(Option::unwrap_or_default)
            .collect();
        Ok(Self { bundle, truth, annotations: Arc::new(annotations), turned_deg: 0.0 })
    }

    /// Returns movable objects with at least `min_points` annotated points. In a rotated world,
    /// their boxes are the bounds of their points.
    #[must_use]
    pub fn objects(&self, min_points: u32) -> Vec<AnnotatedObject> {
        let objects = self.annotations.objects(min_points);
        if self.turned_deg == 0.0 {
            return objects;
        }
        let around = |id: u32| {
            Aabb::around(
                self.bundle
                    .cloud
                    .positions
                    .iter()
                    .zip(&self.truth)
                    .filter(|(_, t)| **t == id)
                    .map(|(p, _)| p),
            )
        };
        objects
            .into_iter()
            .filter_map(|o| Some(AnnotatedObject { aabb: around(o.id)?, ..o }))
            .collect()
    }

    /// Returns the annotated ids of floors, walls and ceilings.
    #[must_use]
    pub fn structures(&self) -> BTreeMap<u32, Structure> {
        self.annotations.objects.iter().filter_map(|o| Some((o.id, o.structure()?))).collect()
    }

    /// Returns the annotations as a source of 2D masks. Only valid for the world as annotated, not
    /// after [`rotated`](Self::rotated).
    #[must_use]
    pub fn masks(&self) -> AnnotatedMasks {
        self.annotations.masks(&self.bundle.cloud)
    }

    /// Returns the same room in a world rotated about Z.
    #[must_use]
    pub fn rotated(&self, deg: f32) -> Self {
        let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), deg.to_radians());
        let mut room = self.clone();
        room.bundle.cloud.positions.iter_mut().for_each(|p| *p = turn * *p);
        room.bundle.frames.iter_mut().for_each(|f| f.camera_to_world = turn * f.camera_to_world);
        room.turned_deg += deg;
        room
    }

    /// Returns the same room with the points of its cloud in another order.
    #[must_use]
    pub fn shuffled(&self) -> Self {
        let mut order: Vec<usize> = (0..self.truth.len()).collect();
        // Any fixed order works: by a hash of the index.
        order.sort_by_key(|&i| (i as u64 + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15));
        let mut room = self.clone();
        let cloud = &self.bundle.cloud;
        room.bundle.cloud.positions = order.iter().map(|&i| cloud.positions[i]).collect();
        room.bundle.cloud.colors = order.iter().map(|&i| cloud.colors[i]).collect();
        room.truth = order.iter().map(|&i| self.truth[i]).collect();
        room
    }
}

impl Annotations {
    fn objects(&self, min_points: u32) -> Vec<AnnotatedObject> {
        let movable =
            self.objects.iter().filter(|o| o.structure().is_none() && o.cloud_points >= min_points);
        movable
            .map(|o| AnnotatedObject {
                id: o.id,
                name: o.name.clone(),
                aabb: o.aabb,
                points: o.cloud_points,
            })
            .collect()
    }

    /// Returns the annotated id of each point of a cloud, if any: from the point annotations if it
    /// is the room's own cloud, otherwise from the annotated boxes. `None` instead of 0, because
    /// data sets have objects with number 0.
    pub(super) fn label_points(&self, cloud: &PointCloud) -> Vec<Option<u32>> {
        match &self.of_point {
            Some(of_point) if of_point.len() == cloud.len() => {
                of_point.iter().map(|&id| (id != 0).then_some(id)).collect()
            }
            _ => cloud.positions.iter().map(|p| self.object_at(p, 0.02)).collect(),
        }
    }

    /// Returns the object at a position that was measured with an error of about `noise_m`. `None`
    /// when no box is near.
    ///
    /// The smallest box that contains the position wins: a cup in a shelf is not the shelf. A
    /// position on a floor or wall belongs to the floor or wall, unless the box is a flat one on it
    /// (rugs, pictures) or is embedded in it (windows, doors).
    fn object_at(&self, p: &Point3<f32>, noise_m: f32) -> Option<u32> {
        let holding = |slack: f32| self.objects.iter().filter(move |o| o.distance(p) <= slack);
        let smallest = holding(noise_m).min_by(|a, b| a.volume().total_cmp(&b.volume()));
        let structural = holding(noise_m).find(|o| o.structure().is_some());
        match (smallest, structural) {
            (Some(object), Some(structure)) => {
                Some(if object.is_part_of(structure) { object.id } else { structure.id })
            }
            (Some(object), None) => Some(object.id),
            (None, _) => None,
        }
    }

    fn masks(&self, cloud: &PointCloud) -> AnnotatedMasks {
        let mut near: VoxelMap<Vec<LabeledPoint>> = VoxelMap::default();
        if let Some(of_point) = self.of_point.as_ref().filter(|ids| ids.len() == cloud.len()) {
            for (p, &id) in cloud.positions.iter().zip(of_point) {
                near.entry(VoxelKey::containing(p, NEAR_M)).or_default().push((*p, id));
            }
        }
        AnnotatedMasks { annotations: Arc::new(self.clone()), near: Arc::new(near) }
    }
}

impl SceneObject {
    fn size(&self) -> Vector3<f32> {
        self.rotated_box().size
    }

    fn volume(&self) -> f32 {
        self.size().product()
    }

    /// Returns whether this object lies flat on a slab of the building, or is embedded in it.
    fn is_part_of(&self, slab: &Self) -> bool {
        const FLAT_M: f32 = 0.1;
        const LET_IN_M: f32 = 0.02;
        let normal = slab.size().imin();
        self.aabb.size[normal] < FLAT_M || -self.aabb.gap_per_axis(&slab.aabb)[normal] >= LET_IN_M
    }

    /// Returns the distance of a point to the (oriented) box, meters; 0 inside.
    fn distance(&self, p: &Point3<f32>) -> f32 {
        let own = self.rotated_box();
        let turned = own.rotation.inverse() * (p - own.center);
        (turned.abs() - self.size() / 2.0).map(|v| v.max(0.0)).norm()
    }
}

/// A point and the object it belongs to.
type LabeledPoint = (Point3<f32>, u32);

/// Maximum distance of a pixel from the annotated point whose object it takes, meters.
const NEAR_M: f32 = 0.03;

/// Annotated 2D masks. Each depth pixel takes the object of the nearest annotated point, or of the
/// boxes if there are only those. Isolates the errors of grouping and boxes from those of masks.
#[derive(Clone)]
pub struct AnnotatedMasks {
    annotations: Arc<Annotations>,
    near: Arc<VoxelMap<Vec<LabeledPoint>>>,
}

impl AnnotatedMasks {
    fn object_at(&self, p: &Point3<f32>, z_m: f32) -> u32 {
        if self.near.is_empty() {
            return self.annotations.object_at(p, 0.01 + 0.003 * z_m * z_m).unwrap_or_default();
        }
        let center = VoxelKey::containing(p, NEAR_M);
        let mut best = (NEAR_M * NEAR_M, 0);
        for d in 0..27 {
            let key = center.offset([d / 9 - 1, d / 3 % 3 - 1, d % 3 - 1]);
            for (q, id) in self.near.get(&key).into_iter().flatten() {
                let distance = (q - p).norm_squared();
                if distance < best.0 {
                    best = (distance, *id);
                }
            }
        }
        best.1
    }
}

impl MaskSource for AnnotatedMasks {
    fn name(&self) -> &'static str {
        "annotated"
    }

    fn masks(&self, frame: &Frame, _progress: &Progress) -> Result<Vec<IdImage>, ParseError> {
        let (width, height) = (frame.depth.width, frame.depth.height);
        let camera_to_world = frame.depth_camera.world_to_camera().inverse();
        let intrinsics = frame.depth_camera.intrinsics;
        let at = |u: u32, v: u32| match frame.depth.at((u, v)) {
            0.0 => 0,
            z_m => self
                .object_at(&(camera_to_world * intrinsics.unproject(u as f32, v as f32, z_m)), z_m)
                as u16,
        };
        let ids = (0..height)
            .flat_map(|v| (0..width).map(move |u| (u, v)))
            .map(|(u, v)| at(u, v))
            .collect();
        Ok(vec![IdImage { width, height, ids }])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// `ScanNet` counts from 0: unlabeled points do not belong to its object 0.
    #[test]
    fn unlabeled_points_do_not_belong_to_object_zero() {
        let boxes = [-1.0, 1.0].map(|x| {
            (
                "box".to_owned(),
                Aabb { center: Point3::new(x, 0.0, 0.0), size: Vector3::new(1.0, 1.0, 1.0) },
            )
        });
        let mut annotations = Annotations::from_boxes(&boxes);
        annotations.objects.iter_mut().for_each(|object| object.id -= 1);
        let positions = vec![
            Point3::new(-1.0, 0.0, 0.0),
            Point3::new(1.0, 0.0, 0.0),
            Point3::new(9.0, 0.0, 0.0),
        ];
        let cloud = PointCloud { colors: vec![[0; 3]; 3], positions };
        assert_eq!(annotations.label_points(&cloud), [Some(0), Some(1), None]);
    }
}
