//! Scans of a small space from close by: a desk, a shelf. Not in the paper.
//!
//! The distances of stage 1 suit rooms, which are seen from two meters and more. A mug on a desk
//! that is seen from half a meter has as many pixels as a chair in a room. So the scan of a desk is
//! segmented enlarged, and what is found is reduced again before it is named.

use super::checkpoints::Checkpoints;
use uniground_geometry::boxes::Aabb;
use uniground_geometry::scene::{
    FrameRef, ImportReport, Instance, InstanceId, PointCloud, SceneBundle, Structure, Support,
    viewing_distance_m,
};
use uniground_types::scene::detail_at;
use uniground_types::settings::FusionSettings;

/// A piece of the building is at least this long, meters. In an enlarged scan, shorter planes are
/// table tops, screens and sides of furniture.
const MIN_BUILDING_M: f32 = 2.0;
/// Height of a table, meters: that of the lowest surface if the scan shows no floor.
const TABLE_M: f32 = 0.74;

/// The points of a fine cloud are at most this many times as far apart as its voxels.
const COARSER: f32 = 1.3;

/// By how much a scan is enlarged.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Enlargement(f32);

impl Enlargement {
    /// Returns the enlargement of a scan with this import report.
    pub fn of(report: &ImportReport) -> Self {
        Self(report.detail())
    }

    /// Returns the enlargement for the things that a frame shows, in a cloud that is as fine as that
    /// of a scan from this distance.
    pub fn of_frame(frame: &FrameRef, spacing_m: f32) -> Self {
        let detail = detail_at(viewing_distance_m(std::slice::from_ref(frame)));
        let finest_m = FusionSettings::default().in_detail(detail).voxel_m;
        Self(if spacing_m <= COARSER * finest_m { detail } else { 1.0 })
    }

    /// Returns whether anything is enlarged.
    pub fn is_used(self) -> bool {
        self.0 != 1.0
    }

    /// Returns checkpoints that are not those of the scan in its size.
    pub fn separate_checkpoints(self, checkpoints: &Checkpoints) -> Checkpoints {
        match self.is_used() {
            true => checkpoints.with_dependency(&format!("enlarged {}", self.0)),
            false => checkpoints.clone(),
        }
    }

    /// Enlarges a scan.
    pub fn enlarge(self, mut bundle: SceneBundle) -> SceneBundle {
        if !self.is_used() {
            return bundle;
        }
        self.enlarge_cloud(&mut bundle.cloud);
        self.enlarge_frames(&mut bundle.frames);
        for addition in &mut bundle.additions {
            self.enlarge_cloud(&mut addition.new);
            addition.apart_m *= self.0;
            self.enlarge_frames(&mut addition.frames);
        }
        bundle
    }

    /// Enlarges a cloud.
    pub fn enlarge_cloud(self, cloud: &mut PointCloud) {
        cloud.positions.iter_mut().for_each(|position| *position *= self.0);
    }

    /// Enlarges what frames measure, and their distances.
    pub fn enlarge_frames(self, frames: &mut [FrameRef]) {
        for frame in frames {
            frame.camera_to_world.translation.vector *= self.0;
            frame.depth_scale_m *= self.0;
            if let Some(sensor) = &mut frame.optics.depth_sensor {
                sensor.depth_to_color.translation.vector *= self.0;
            }
        }
    }

    /// Enlarges an instance.
    pub fn enlarge_instance(self, instance: &mut Instance) {
        scale_instance(instance, self.0);
    }

    /// Reduces an instance to its size.
    pub fn reduce_instance(self, instance: &mut Instance) {
        scale_instance(instance, 1.0 / self.0);
    }

    /// Reduces instances to their size. Planes that are too small for a piece of the building become
    /// objects.
    pub fn reduce_instances(self, instances: &mut [Instance]) {
        if !self.is_used() {
            return;
        }
        instances.iter_mut().for_each(|instance| self.reduce_instance(instance));
        let is_small = |i: &Instance| i.oriented_box.size.max() < MIN_BUILDING_M;
        let is_floor = |i: &&Instance| i.structure == Some(Structure::Floor);
        // Things are sorted by size: the first is the largest.
        let has_floor = instances.iter().filter(is_floor).any(|floor| !is_small(floor));
        let largest = instances.iter().find(is_floor).map(|floor| floor.id);
        let table = largest.filter(|_| !has_floor);
        let objects: Vec<InstanceId> = instances
            .iter()
            .filter(|i| i.structure.is_some() && is_small(i))
            .map(|i| i.id)
            .collect();
        for instance in instances.iter_mut() {
            if objects.contains(&instance.id) {
                instance.structure = None;
            }
            instance.support = match instance.support {
                Support::Wall { id } if objects.contains(&id) => Support::Nothing,
                Support::Floor if Some(instance.id) == table => Support::Nothing,
                Support::Floor => table.map_or(Support::Floor, |id| Support::Instance { id }),
                other => other,
            };
        }
        if !has_floor {
            instances.iter_mut().for_each(|i| i.height_above_floor_m += TABLE_M);
        }
    }

    /// Reduces a cloud to its size.
    pub fn reduce_cloud(self, cloud: &mut PointCloud) {
        if self.is_used() {
            cloud.positions.iter_mut().for_each(|position| *position /= self.0);
        }
    }

    /// Returns a box in its size.
    pub fn reduce(self, Aabb { center, size }: Aabb) -> Aabb {
        Aabb { center: center / self.0, size: size / self.0 }
    }
}

fn scale_instance(instance: &mut Instance, by: f32) {
    for of in [&mut instance.aabb, &mut instance.raw_box] {
        *of = Aabb { center: of.center * by, size: of.size * by };
    }
    instance.oriented_box.center *= by;
    instance.oriented_box.size *= by;
    instance.height_above_floor_m *= by;
}

#[cfg(test)]
mod tests {
    use super::*;
    use uniground_geometry::scene::Intrinsics;
    use uniground_geometry::{Point3, Vector3};

    fn flat(id: u32, size: [f32; 3], structure: Structure) -> Instance {
        let aabb = Aabb { center: Point3::new(3.0, 0.0, 0.6), size: Vector3::from(size) };
        Instance { structure: Some(structure), ..Instance::from_box(InstanceId(id), aabb) }
    }

    #[test]
    fn a_small_floor_is_a_table_with_things_on_it() {
        let mug = Aabb { center: Point3::new(3.0, 0.3, 0.9), size: Vector3::repeat(0.3) };
        let on_floor =
            |id| Instance { support: Support::Floor, ..Instance::from_box(InstanceId(id), mug) };
        let mut instances = vec![flat(1, [3.6, 2.1, 0.0], Structure::Floor), on_floor(2)];
        let three = Enlargement(3.0);
        three.reduce_instances(&mut instances);
        let [table, mug] = &instances[..] else { panic!() };
        assert_eq!((table.structure, mug.support), (None, Support::Instance { id: InstanceId(1) }));
        assert!((mug.aabb.size - Vector3::repeat(0.1)).norm() < 1e-6, "{mug:?}");
        assert!((mug.aabb.center - Point3::new(1.0, 0.1, 0.3)).norm() < 1e-6, "{mug:?}");
        assert_eq!(mug.height_above_floor_m, TABLE_M);

        // A floor of two meters stays one, and things on it, whatever other planes there are.
        let mut instances = vec![
            flat(1, [7.5, 6.0, 0.0], Structure::Floor),
            on_floor(2),
            flat(3, [1.5, 1.5, 0.0], Structure::Floor),
        ];
        three.reduce_instances(&mut instances);
        let structures: Vec<_> = instances.iter().map(|i| i.structure).collect();
        assert_eq!(structures, [Some(Structure::Floor), None, None]);
        assert_eq!(
            (instances[1].support, instances[1].height_above_floor_m),
            (Support::Floor, 0.0)
        );
    }

    #[test]
    fn what_a_frame_shows_is_enlarged_in_a_fine_cloud() {
        let folder = tempfile::tempdir().unwrap();
        let folder = camino::Utf8Path::from_path(folder.path()).unwrap();
        let camera = Intrinsics { width: 32, height: 24, fx: 30.0, fy: 30.0, cx: 15.5, cy: 11.5 };
        let enlarged = |depth_m: f32, spacing_m: f32| {
            let frame = uniground_testing::flat_frame(folder, 0, camera, depth_m);
            Enlargement::of_frame(&frame, spacing_m)
        };
        assert_eq!(enlarged(0.5, 0.006), Enlargement(3.0));
        assert_eq!(enlarged(1.0, 0.009), Enlargement(2.0));
        // A cloud as coarse as that of a room, and a room.
        assert_eq!(enlarged(0.5, 0.018), Enlargement(1.0));
        assert_eq!(enlarged(2.0, 0.006), Enlargement(1.0));
    }

    #[test]
    fn a_scan_that_is_not_enlarged_stays_as_it_is() {
        let mut instances = vec![flat(1, [0.5, 0.5, 0.0], Structure::Wall)];
        let before = instances.clone();
        Enlargement(1.0).reduce_instances(&mut instances);
        assert_eq!(instances, before);
    }
}
