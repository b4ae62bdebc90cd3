//! Triangles to points: evenly spread over the surface, at places that depend on nothing but the
//! mesh.

use super::CloudBuilder;
use super::gathered::GREY;
use super::texture::Texture;
use crate::IngestError;
use camino::Utf8Path;

/// Points come about this far apart, metres, where that is not too many.
const SPACING_M: f64 = 0.01;
const MAX_POINTS: f64 = 4_000_000.0;
/// Most vertices and triangles that are read.
pub(super) const MAX_ELEMENTS: usize = 20_000_000;

/// A corner of a triangle.
#[derive(Debug, Clone, Copy)]
pub(super) struct MeshVertex {
    pub at: [f64; 3],
    /// Colour of the vertex, `0..=1`; white where there is none.
    pub tint: [f32; 3],
    /// Place in the texture; (0, 0) is its first pixel's corner, the second coordinate grows
    /// downwards.
    pub uv: Option<[f32; 2]>,
}

#[derive(Debug, Clone)]
pub(super) struct Triangle {
    pub corners: [MeshVertex; 3],
    /// Of [`Mesh::textures`].
    pub texture: Option<u32>,
}

/// A mesh in the file's own axes.
#[derive(Debug, Default)]
pub(super) struct Mesh {
    pub triangles: Vec<Triangle>,
    pub textures: Vec<Texture>,
    /// Vertices that stand alone; with colour where `Some`.
    pub points: Vec<([f64; 3], Option<[u8; 3]>)>,
    pub has_colour: bool,
}

impl Triangle {
    /// In the file's units; 0 where it is no number.
    pub fn area(&self) -> f64 {
        let [a, b, c] = self.corners.map(|corner| nalgebra::Vector3::from(corner.at));
        let area = (b - a).cross(&(c - a)).norm() / 2.0;
        if area.is_finite() { area } else { 0.0 }
    }

    /// The point with these weights of its corners.
    fn at(&self, weights: [f64; 3], textures: &[Texture]) -> ([f64; 3], [u8; 3]) {
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
            texture.at(uv(0), uv(1))
        });
        (position, std::array::from_fn(|i| (f64::from(base[i]) * tint[i]).round() as u8))
    }
}

impl Mesh {
    /// Hands points of the surface on. `metres_per_unit` is about right: it decides how dense they
    /// come.
    pub fn sample(
        &self,
        file: &Utf8Path,
        metres_per_unit: f64,
        gathered: &mut CloudBuilder,
    ) -> Result<(), IngestError> {
        gathered.coloured(self.has_colour);
        for (position, colour) in &self.points {
            gathered.push(*position, colour.unwrap_or(GREY));
        }
        if self.triangles.is_empty() {
            return Ok(());
        }
        let area = self.triangles.iter().map(Triangle::area).sum();
        let mut sampling = MeshSampler::of(area, metres_per_unit)
            .ok_or_else(|| IngestError::malformed(file, "the faces of the mesh have no area"))?;
        for triangle in &self.triangles {
            sampling.points(triangle, &self.textures, |position, colour| {
                gathered.push(position, if self.has_colour { colour } else { GREY });
            });
        }
        Ok(())
    }
}

/// Spreads points over triangles that come one after the other.
pub(super) struct MeshSampler {
    per_area: f64,
    /// Points of the area so far that are still to come.
    owed: f64,
    drawn: u32,
}

impl MeshSampler {
    /// For triangles of so much area together; `None`: there is none.
    pub fn of(area: f64, metres_per_unit: f64) -> Option<Self> {
        let most = area * (metres_per_unit / SPACING_M).powi(2);
        (area.is_finite() && area > 0.0).then(|| Self {
            per_area: most.min(MAX_POINTS) / area,
            owed: 0.5,
            drawn: 0,
        })
    }

    /// Points of the next triangle, with their colours.
    pub fn points(
        &mut self,
        triangle: &Triangle,
        textures: &[Texture],
        mut hand: impl FnMut([f64; 3], [u8; 3]),
    ) {
        self.owed += triangle.area() * self.per_area;
        while self.owed >= 1.0 {
            self.owed -= 1.0;
            let (position, colour) = triangle.at(weights(self.drawn), textures);
            hand(position, colour);
            self.drawn = self.drawn.wrapping_add(1);
        }
    }
}

/// The next of a sequence that fills a triangle evenly (Roberts' R2, folded).
fn weights(drawn: u32) -> [f64; 3] {
    const A: f64 = 0.754_877_666_246_692_7;
    const B: f64 = 0.569_840_290_998_053_2;
    let (mut u, mut v) =
        ((0.5 + A * f64::from(drawn)).fract(), (0.5 + B * f64::from(drawn)).fract());
    if u + v > 1.0 {
        (u, v) = (1.0 - u, 1.0 - v);
    }
    [1.0 - u - v, u, v]
}
