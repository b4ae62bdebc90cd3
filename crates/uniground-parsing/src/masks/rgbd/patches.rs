//! Even patches: a graph segmentation (Felzenszwalb and Huttenlocher 2004) over color and normal
//! edges that never crosses a depth step.

use super::RgbdSettings;
use super::surfaces::SurfaceGrid;
use uniground_geometry::Vector3;

/// Returns the signed bend between two neighboring elements, radians: positive where the surface is
/// concave (a valley).
pub(super) fn signed_bend(surfaces: &SurfaceGrid, a: usize, b: usize) -> f32 {
    let (na, nb): (Vector3<f32>, Vector3<f32>) = (surfaces.normals[a], surfaces.normals[b]);
    let angle = na.dot(&nb).clamp(-1.0, 1.0).acos();
    let across = surfaces.points[b] - surfaces.points[a];
    // In a valley the normals lean toward each other.
    if (na - nb).dot(&across) > 0.0 { angle } else { -angle }
}

/// Returns the patch label `0..n` of each element.
pub(super) fn cut_patches(surfaces: &SurfaceGrid, settings: &RgbdSettings) -> Vec<u32> {
    let mut edges: Vec<(f32, u32, u32)> = surfaces
        .adjacent_pairs()
        .filter(|&(a, b)| surfaces.is_continuous(a, b))
        .map(|(a, b)| {
            let color = (surfaces.labs[a] - surfaces.labs[b]).norm() / settings.colour_edge;
            let bend = signed_bend(surfaces, a, b).to_degrees();
            let shape = if bend > 0.0 {
                bend / settings.concave_edge_deg
            } else {
                -bend / settings.convex_edge_deg
            };
            (color.max(shape), a as u32, b as u32)
        })
        .collect();
    edges.sort_unstable_by(|x, y| x.0.total_cmp(&y.0).then((x.1, x.2).cmp(&(y.1, y.2))));
    let mut forest = PatchForest::new(surfaces.depth_m.len());
    for &(weight, a, b) in &edges {
        let (a, b) = (forest.sets.find(a), forest.sets.find(b));
        if a != b
            && weight
                <= forest
                    .tolerance(a, settings.patch_scale)
                    .min(forest.tolerance(b, settings.patch_scale))
        {
            forest.join(a, b, weight);
        }
    }
    for &(weight, a, b) in &edges {
        let (a, b) = (forest.sets.find(a), forest.sets.find(b));
        if a != b
            && forest.size[a as usize].min(forest.size[b as usize]) < settings.min_patch_pixels
        {
            forest.join(a, b, weight);
        }
    }
    forest.sets.into_labels().0
}

struct PatchForest {
    sets: uniground_geometry::union_find::UnionFind,
    size: Vec<u32>,
    /// Largest edge inside each tree.
    inner: Vec<f32>,
}

impl PatchForest {
    fn new(len: usize) -> Self {
        Self {
            sets: uniground_geometry::union_find::UnionFind::new(len),
            size: vec![1; len],
            inner: vec![0.0; len],
        }
    }

    fn tolerance(&self, root: u32, scale: f32) -> f32 {
        self.inner[root as usize] + scale / self.size[root as usize] as f32
    }

    fn join(&mut self, a: u32, b: u32, weight: f32) {
        let size = self.size[a as usize] + self.size[b as usize];
        let root = self.sets.union(a, b) as usize;
        self.size[root] = size;
        self.inner[root] = self.inner[a as usize].max(self.inner[b as usize]).max(weight);
    }
}
