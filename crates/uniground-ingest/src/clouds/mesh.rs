//! Samples points from triangles: evenly spread over the surface, at positions that depend only on
//! the mesh.

use super::CloudBuilder;
use super::gathered::GREY;
use super::texture::Texture;
use crate::IngestError;
use camino::Utf8Path;

/// Distance between sampled points, meters, unless that gives too many points.
const SPACING_M: f64 = 0.01;
const MAX_POINTS: f64 = 4_000_000.0;
/// Maximum number of vertices and triangles.
pub(super) const MAX_ELEMENTS: usize = 20_000_000;

/// A corner of a triangle.
#[derive(Debug, Clone, Copy)]
pub(super) struct MeshVertex {
    pub at: [f64; 3],
    /// Color of the vertex, `0..=1`. White if it has none.
    pub tint: [f32; 3],
    /// Texture coordinates. (0, 0) is the corner of the texture's first pixel; the second
    /// coordinate grows downwards.
    pub uv: Option<[f32; 2]>,
}

#[derive(Debug, Clone)]
pub(super) struct Triangle {
    pub corners: [MeshVertex; 3],
    /// Index into [`Mesh::textures`].
    pub texture: Option<u32>,
}

/// A mesh in the file's own axes.
#[derive(Debug, Default)]
pub(super) struct Mesh {
    pub triangles: Vec<Triangle>,
    pub textures: Vec<Texture>,
    /// Vertices without faces, with color where `Some`.
    pub points: Vec<([f64; 3], Option<[u8; 3]>)>,
    pub has_color: bool,
}

impl Triangle {
    /// Returns the area in the file's units squared, or 0 if it is not a number.
    pub fn area(&self) -> f64 {
        let [a, b, c] = self.corners.map(|corner| nalgebra::Vector3::from(corner.at));
        let area = (b - a).cross(&(c - a)).norm() / 2.0;
        if area.is_finite() { area } else { 0.0 }
    }

    /// Returns the point with these weights of its corners.
    fn interpolate(&self, weights: [f64; 3], textures: &[Texture]) -> ([f64; 3], [u8; 3]) {
        let mix = |of: &dyn Fn(&MeshVertex) -> f64| {
            self.corners.iter().zip(weights).map(|(corner, w)| of(corner) * w).sum::<f64>()
        };
        let position = std::array::from_fn(|i| mix(&|c| c.at[i]));
        let tint: [f64; 3] = std::array::from_fn(|i| mix(&|c| f64::from(c.tint[i])));
        let texture = self
            .texture
            .and_then(|t| textures.get(t as usize))
            .filter(|_| self.corners.iter().all(|c| c.uv.is_some()));
        let base = texture.map_or([255; 3], |texture| {
            let uv = |i: usize| mix(&|c| f64::from(c.uv.unwrap_or_default()[i])) as f32;
            texture.interpolate(uv(0), uv(1))
        });
        (position, std::array::from_fn(|i| (f64::from(base[i]) * tint[i]).round() as u8))
    }
}

impl Mesh {
    /// Passes points of the surface to `gathered`. `metres_per_unit` can be approximate: it only
    /// determines the density of the points.
    pub fn sample(
        &self,
        file: &Utf8Path,
        metres_per_unit: f64,
        gathered: &mut CloudBuilder,
    ) -> Result<(), IngestError> {
        gathered.set_has_color(self.has_color);
        for (position, color) in &self.points {
            gathered.push(*position, color.unwrap_or(GREY));
        }
        if self.triangles.is_empty() {
            return Ok(());
        }
        let area = self.triangles.iter().map(Triangle::area).sum();
        let mut sampling = MeshSampler::for_area(area, metres_per_unit)
            .ok_or_else(|| IngestError::malformed(file, "the faces of the mesh have no area"))?;
        for triangle in &self.triangles {
            sampling.sample_triangle(triangle, &self.textures, |position, color| {
                gathered.push(position, if self.has_color { color } else { GREY });
            });
        }
        Ok(())
    }
}

/// Spreads points over consecutive triangles.
pub(super) struct MeshSampler {
    per_area: f64,
    /// Number of points that the area so far still requires.
    owed: f64,
    drawn: u32,
}

impl MeshSampler {
    /// Creates a sampler for triangles of this total area. Returns `None` if there is none.
    pub fn for_area(area: f64, metres_per_unit: f64) -> Option<Self> {
        let most = area * (metres_per_unit / SPACING_M).powi(2);
        (area.is_finite() && area > 0.0).then(|| Self {
            per_area: most.min(MAX_POINTS) / area,
            owed: 0.5,
            drawn: 0,
        })
    }

    /// Passes the points of the next triangle, with their colors, to `hand`.
    pub fn sample_triangle(
        &mut self,
        triangle: &Triangle,
        textures: &[Texture],
        mut hand: impl FnMut([f64; 3], [u8; 3]),
    ) {
        self.owed += triangle.area() * self.per_area;
        while self.owed >= 1.0 {
            self.owed -= 1.0;
            let (position, color) = triangle.interpolate(nth_weights(self.drawn), textures);
            hand(position, color);
            self.drawn = self.drawn.wrapping_add(1);
        }
    }
}

/// Returns the item at an index of a sequence that fills a triangle evenly (Roberts' R2, folded),
/// as weights of the corners.
fn nth_weights(drawn: u32) -> [f64; 3] {
    const A: f64 = 0.754_877_666_246_692_7;
    const B: f64 = 0.569_840_290_998_053_2;
    let (mut u, mut v) =
        ((0.5 + A * f64::from(drawn)).fract(), (0.5 + B * f64::from(drawn)).fract());
    if u + v > 1.0 {
        (u, v) = (1.0 - u, 1.0 - v);
    }
    [1.0 - u - v, u, v]
}
