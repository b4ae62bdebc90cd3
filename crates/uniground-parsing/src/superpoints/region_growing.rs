//! Region growing over supervoxels: flat neighbors of one color become one superpoint (paper, after
//! GrowSP).

use super::voxel_cloud::VoxelCloud;
use super::{Patch, SuperpointSettings, mean_per_label};
use std::collections::VecDeque;

/// Joins supervoxels that continue each other; returns the region `0..n` of each.
///
/// A region grows from its flattest supervoxel. Candidates are compared with that one and not with
/// the last one added, so that a region does not follow a gently curved surface around an object.
pub(super) fn join(
    voxels: &VoxelCloud,
    labels: &[u32],
    adjacent: &[(u32, u32)],
    settings: &SuperpointSettings,
) -> Vec<u32> {
    let count = labels.iter().max().map_or(0, |&l| l as usize + 1);
    let patches = Patch::merge_by_label(&voxels.patches, labels, count);
    let roughness = mean_per_label(labels, &voxels.curvatures, count);
    let mut neighbors = vec![Vec::new(); count];
    for &(a, b) in adjacent {
        neighbors[a as usize].push(b);
        neighbors[b as usize].push(a);
    }
    let mut order: Vec<u32> = (0..count as u32).collect();
    order.sort_by(|&a, &b| roughness[a as usize].total_cmp(&roughness[b as usize]).then(a.cmp(&b)));
    let min_cos = settings.smoothness_deg.to_radians().cos();
    let mut region = vec![u32::MAX; count];
    let mut regions = 0;
    for &seed in &order {
        if region[seed as usize] != u32::MAX {
            continue;
        }
        let origin = &patches[seed as usize];
        region[seed as usize] = regions;
        let mut queue = VecDeque::from([seed]);
        while let Some(member) = queue.pop_front() {
            if roughness[member as usize] > settings.curvature {
                continue;
            }
            for &candidate in &neighbors[member as usize] {
                let patch = &patches[candidate as usize];
                let continues = region[candidate as usize] == u32::MAX
                    && patch.normal.dot(&origin.normal).abs() >= min_cos
                    && (patch.center - origin.center).dot(&origin.normal).abs() <= settings.voxel_m
                    && (patch.lab - patches[member as usize].lab).norm()
                        <= settings.colour_tolerance
                    && (patch.lab - origin.lab).norm() <= 2.0 * settings.colour_tolerance;
                if continues {
                    region[candidate as usize] = regions;
                    queue.push_back(candidate);
                }
            }
        }
        regions += 1;
    }
    region
}
