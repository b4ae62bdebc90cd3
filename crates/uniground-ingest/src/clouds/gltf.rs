//! glTF 2.0 and GLB: triangles and points of all meshes of the scene, with vertex colors and base
//! color textures. Y up, meters.
//!
//! The parser is part of this crate: it checks offsets and counts of the file before they are used,
//! and needs only a small part of the format.

mod document;

use super::CloudBuilder;
use super::mesh::{MAX_ELEMENTS, Mesh, MeshVertex, Triangle};
use super::texture::Texture;
use crate::IngestError;
use crate::limited_reader::read_text;
use camino::Utf8Path;
use document::{AccessorRows, Buffers, Document, Primitive};
use nalgebra::{Matrix4, Quaternion, UnitQuaternion};
use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom};
use std::ops::Range;

const MAX_JSON_BYTES: u64 = 64 << 20;
const MAX_FILE_BYTES: u64 = 2 << 30;
/// Maximum depth of nested nodes.
const MAX_DEPTH: usize = 64;
const MAX_NODES: usize = 100_000;
const TRIANGLES: u32 = 4;
const POINTS: u32 = 0;
/// Modes of lines, loops and strips: outlines, which are not measured geometry.
const LINES: std::ops::RangeInclusive<u32> = 1..=3;
/// Extensions that change how geometry is stored. A file that requires others cannot be read.
const KNOWN_EXTENSIONS: [&str; 4] = [
    "KHR_mesh_quantization",
    "KHR_materials_unlit",
    "KHR_texture_transform",
    "KHR_materials_pbrSpecularGlossiness",
];

pub(super) fn check(root: &Utf8Path, file: &Utf8Path) -> Result<(), IngestError> {
    open(root, file).map(drop)
}

pub(super) fn read(
    root: &Utf8Path,
    file: &Utf8Path,
    mut gathered: CloudBuilder,
) -> Result<CloudBuilder, IngestError> {
    let malformed = |reason: String| IngestError::malformed(file, reason);
    let (document, binary) = open(root, file)?;
    let blob = binary.map(|part| read_range(root, file, part)).transpose()?;
    let buffers = Buffers::load(&document, blob, root, file)?;
    let mut mesh = Mesh::default();
    let mut textures: Vec<Option<u32>> = vec![None; document.textures.len()];
    let mut left: Vec<(usize, Matrix4<f64>, usize)> =
        document.roots().into_iter().map(|node| (node, Matrix4::identity(), 0)).collect();
    let mut visited = 0;
    while let Some((node, parent, depth)) = left.pop() {
        visited += 1;
        if visited > MAX_NODES || depth > MAX_DEPTH {
            return Err(malformed(
                "it has too many nodes, or nodes that contain themselves".into(),
            ));
        }
        let node = document
            .nodes
            .get(node)
            .ok_or_else(|| malformed(format!("node {node} does not exist")))?;
        let to_world = parent * node.to_matrix();
        left.extend(node.children.iter().map(|child| (*child, to_world, depth + 1)));
        let Some(number) = node.mesh else { continue };
        let parts = document
            .meshes
            .get(number)
            .ok_or_else(|| malformed(format!("mesh {number} does not exist")))?;
        for primitive in &parts.primitives {
            let texture = load_texture(&document, &buffers, primitive, &mut textures, &mut mesh)
                .map_err(malformed)?;
            add_primitive(&buffers, primitive, &document, &to_world, texture, &mut mesh)
                .map_err(malformed)?;
        }
    }
    mesh.sample(file, 1.0, &mut gathered)?;
    Ok(gathered)
}

/// Range of the binary part of a GLB within its file, bytes.
type BinaryPart = Option<Range<u64>>;

/// Returns the document, and the range of the binary part of a GLB.
fn open(root: &Utf8Path, file: &Utf8Path) -> Result<(Document, BinaryPart), IngestError> {
    let malformed = |reason: String| IngestError::malformed(file, reason);
    let reading = |source| IngestError::reading(file, source);
    let mut source = File::open(root.join(file)).map_err(reading)?;
    let bytes = source.metadata().map_err(reading)?.len();
    if bytes > MAX_FILE_BYTES {
        return Err(malformed(format!("it is larger than {} GiB", MAX_FILE_BYTES >> 30)));
    }
    let mut magic = [0; 4];
    let (text, binary) = match source.read_exact(&mut magic) {
        Ok(()) if &magic == b"glTF" => read_chunks(&mut source, bytes)
            .map_err(reading)?
            .ok_or_else(|| malformed("not a complete GLB file of version 2".into()))?,
        _ => (read_text(root, file, MAX_JSON_BYTES)?.into_bytes(), None),
    };
    let document: Document = serde_json::from_slice(&text).map_err(|e| malformed(e.to_string()))?;
    if let Some(strange) =
        document.extensions_required.iter().find(|e| !KNOWN_EXTENSIONS.contains(&e.as_str()))
    {
        return Err(malformed(format!(
            "it needs {strange}, which is not supported: export it without compression"
        )));
    }
    Ok((document, binary))
}

/// Reads the JSON of a GLB and the range of its binary chunk. `bytes` is the file's size; `source`
/// is positioned after the magic. Compares lengths with the file's size before it reads. Returns
/// `None` if the file is incomplete.
fn read_chunks(source: &mut File, bytes: u64) -> io::Result<Option<(Vec<u8>, BinaryPart)>> {
    let mut head = [0; 16];
    source.read_exact(&mut head)?;
    let word = |at: usize| u32::from_le_bytes(std::array::from_fn(|i| head[at + i]));
    let (json_start, json_bytes) = (20, u64::from(word(8)));
    let is_json = word(0) == 2 && word(12) == u32::from_le_bytes(*b"JSON");
    if !is_json || json_bytes > MAX_JSON_BYTES || json_start + json_bytes > bytes {
        return Ok(None);
    }
    let mut json = vec![0; json_bytes as usize];
    source.read_exact(&mut json)?;
    let start = json_start + json_bytes + 8;
    if start > bytes {
        return Ok(Some((json, None)));
    }
    let mut head = [0; 8];
    source.read_exact(&mut head)?;
    let end = start + u64::from(u32::from_le_bytes([head[0], head[1], head[2], head[3]]));
    match head[4..] == *b"BIN\0" {
        true if end > bytes => Ok(None),
        is_binary => Ok(Some((json, is_binary.then_some(start..end)))),
    }
}

/// Reads a part of a file. The part must lie within the file.
fn read_range(root: &Utf8Path, file: &Utf8Path, part: Range<u64>) -> Result<Vec<u8>, IngestError> {
    let read = || {
        let mut source = File::open(root.join(file))?;
        source.seek(SeekFrom::Start(part.start))?;
        let mut bytes = vec![0; usize::try_from(part.end - part.start).map_err(io::Error::other)?];
        source.read_exact(&mut bytes)?;
        Ok(bytes)
    };
    read().map_err(|source| IngestError::reading(file, source))
}

impl document::Node {
    fn to_matrix(&self) -> Matrix4<f64> {
        if let Some(columns) = self.matrix {
            return Matrix4::from_column_slice(&columns);
        }
        let [x, y, z, w] = self.rotation.unwrap_or([0.0, 0.0, 0.0, 1.0]);
        let rotation = UnitQuaternion::new_normalize(Quaternion::new(w, x, y, z)).to_homogeneous();
        let translation = Matrix4::new_translation(&self.translation.unwrap_or_default().into());
        translation
            * rotation
            * Matrix4::new_nonuniform_scaling(&self.scale.unwrap_or([1.0; 3]).into())
    }
}

/// Returns the texture of a primitive's material, decoded once.
fn load_texture(
    document: &Document,
    buffers: &Buffers,
    primitive: &Primitive,
    known: &mut [Option<u32>],
    mesh: &mut Mesh,
) -> Result<Option<u32>, String> {
    let material = primitive.material.and_then(|m| document.materials.get(m));
    let Some(number) = material.and_then(|m| m.pbr.base_color_texture.as_ref()).map(|t| t.index)
    else {
        return Ok(None);
    };
    let Some(slot) = known.get_mut(number) else {
        return Err(format!("texture {number} does not exist"));
    };
    if slot.is_none() {
        let Some(image) = document.textures[number].source else { return Ok(None) };
        let bytes = buffers.read_image(document, image)?;
        let texture = Texture::decode(&bytes)
            .map_err(|e| format!("image {image} is not a readable picture: {e}"))?;
        *slot = Some(mesh.textures.len() as u32);
        mesh.textures.push(texture);
    }
    Ok(*slot)
}

fn add_primitive(
    buffers: &Buffers,
    primitive: &Primitive,
    document: &Document,
    to_world: &Matrix4<f64>,
    texture: Option<u32>,
    mesh: &mut Mesh,
) -> Result<(), String> {
    let mode = primitive.mode.unwrap_or(TRIANGLES);
    let Some(position) = primitive.attributes.get("POSITION").filter(|_| !LINES.contains(&mode))
    else {
        return Ok(());
    };
    let positions = buffers.read_accessor(document, *position, 3)?;
    let colors = primitive
        .attributes
        .get("COLOR_0")
        .map(|a| buffers.read_accessor(document, *a, 3))
        .transpose()?;
    let places = primitive
        .attributes
        .get("TEXCOORD_0")
        .map(|a| buffers.read_accessor(document, *a, 2))
        .transpose()?;
    let factor = primitive
        .material
        .and_then(|m| document.materials.get(m))
        .and_then(|m| m.pbr.base_color_factor);
    mesh.has_color |= colors.is_some() || texture.is_some() || factor.is_some();
    let factor = factor.map_or([1.0; 3], |f| [f[0], f[1], f[2]]);
    let corner = |i: usize| -> Result<MeshVertex, String> {
        let p = positions.get(i).ok_or_else(|| format!("vertex {i} does not exist"))?;
        let p = to_world.transform_point(&nalgebra::Point3::new(p[0], p[1], p[2]));
        let own = colors
            .as_ref()
            .and_then(|c| c.get(i))
            .map_or([1.0; 3], |c| [c[0] as f32, c[1] as f32, c[2] as f32]);
        // Factors and vertex colors are linear, pictures are sRGB.
        let tint = std::array::from_fn(|k| linear_to_srgb(own[k] * factor[k]));
        let uv =
            places.as_ref().and_then(|places| places.get(i)).map(|uv| [uv[0] as f32, uv[1] as f32]);
        Ok(MeshVertex { at: [p.x, p.y, p.z], tint, uv })
    };
    let indices =
        primitive.indices.map(|indices| buffers.read_accessor(document, indices, 1)).transpose()?;
    let count = indices.as_ref().map_or(positions.len(), AccessorRows::len);
    let vertex = |i: usize| match &indices {
        Some(indices) => indices.get(i).map_or(usize::MAX, |index| index[0] as usize),
        None => i,
    };
    // Checked before memory is allocated.
    let elements = if mode == TRIANGLES {
        mesh.triangles.len() + count / 3
    } else {
        mesh.points.len() + count
    };
    if elements > MAX_ELEMENTS {
        return Err(format!("more than {MAX_ELEMENTS} faces or points: simplify it first"));
    }
    match mode {
        TRIANGLES => {
            mesh.triangles.reserve_exact(count / 3);
            for first in (0..count / 3).map(|triangle| 3 * triangle) {
                let [a, b, c] = [first, first + 1, first + 2].map(vertex);
                mesh.triangles
                    .push(Triangle { corners: [corner(a)?, corner(b)?, corner(c)?], texture });
            }
        }
        POINTS => {
            let colored = colors.is_some();
            for i in 0..count {
                let corner = corner(vertex(i))?;
                mesh.points.push((
                    corner.at,
                    colored.then(|| corner.tint.map(|c| (c * 255.0).round() as u8)),
                ));
            }
        }
        mode => {
            return Err(format!("primitive mode {mode} is not supported: use triangles or points"));
        }
    }
    Ok(())
}

/// Converts linear light to sRGB, both `0..=1`.
fn linear_to_srgb(linear: f32) -> f32 {
    let c = linear.clamp(0.0, 1.0);
    if c <= 0.003_130_8 { 12.92 * c } else { 1.055 * c.powf(1.0 / 2.4) - 0.055 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::clouds::{self, CloudBounds, CoordinateOrigin, LoadedCloud};
    use proptest::prelude::*;

    fn glb(json: &str, blob: &[u8]) -> Vec<u8> {
        let json = format!("{json}{}", " ".repeat((4 - json.len() % 4) % 4));
        let mut bytes = b"glTF".to_vec();
        let total = 12 + 8 + json.len() + 8 + blob.len();
        [2, total as u32, json.len() as u32].iter().for_each(|v| bytes.extend(v.to_le_bytes()));
        bytes.extend(b"JSON");
        bytes.extend(json.as_bytes());
        bytes.extend((blob.len() as u32).to_le_bytes());
        bytes.extend(b"BIN\0");
        bytes.extend(blob);
        bytes
    }

    fn read_bytes(bytes: &[u8]) -> Result<LoadedCloud, IngestError> {
        let folder = tempfile::tempdir().unwrap();
        let root = Utf8Path::from_path(folder.path()).unwrap();
        std::fs::write(root.join("a.glb"), bytes).unwrap();
        clouds::read(
            root,
            Utf8Path::new("a.glb"),
            &CloudBounds { announced: 1 << 30, kept: 1 << 30 },
            CoordinateOrigin::Free,
        )
    }

    /// Creates a triangle of half a square meter, moved up by two, with a color for each corner.
    fn triangle() -> (String, Vec<u8>) {
        let mut blob = Vec::new();
        [0.0_f32, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0]
            .iter()
            .for_each(|v| blob.extend(v.to_le_bytes()));
        blob.extend([255_u8, 0, 0, 255].repeat(3));
        [0_u16, 1, 2].iter().for_each(|v| blob.extend(v.to_le_bytes()));
        let json = r#"{"asset":{"version":"2.0"},"scene":0,"scenes":[{"nodes":[0]}],"nodes":[{"mesh":0,"translation":[0,2,0]}],
            "meshes":[{"primitives":[{"attributes":{"POSITION":0,"COLOR_0":1},"indices":2}]}],
            "accessors":[{"bufferView":0,"componentType":5126,"count":3,"type":"VEC3"},
                {"bufferView":1,"componentType":5121,"normalized":true,"count":3,"type":"VEC4"},
                {"bufferView":2,"componentType":5123,"count":3,"type":"SCALAR"}],
            "bufferViews":[{"buffer":0,"byteLength":36},{"buffer":0,"byteOffset":36,"byteLength":12},{"buffer":0,"byteOffset":48,"byteLength":6}],
            "buffers":[{"byteLength":54}]}"#;
        (json.to_owned(), blob)
    }

    #[test]
    fn triangles_are_sampled_with_the_transform_of_their_node() {
        let (json, blob) = triangle();
        let loaded = read_bytes(&glb(&json, &blob)).unwrap();
        assert_eq!(loaded.cloud.len(), 5000);
        assert!(loaded.has_color && loaded.cloud.colors.iter().all(|c| *c == [255, 0, 0]));
        assert!(
            loaded
                .cloud
                .positions
                .iter()
                .all(|p| p.y == 2.0 && p.x >= 0.0 && p.z >= 0.0 && p.x + p.z <= 1.001)
        );
    }

    #[test]
    fn invalid_counts_offsets_and_references_are_refused() {
        let (json, blob) = triangle();
        for (from, to, expected) in [
            (
                r#""count":3,"type":"VEC3""#,
                r#""count":4000000000,"type":"VEC3""#,
                "larger than its buffer",
            ),
            (r#""byteOffset":36"#, r#""byteOffset":36000"#, "larger than its buffer"),
            (r#""nodes":[0]"#, r#""nodes":[7]"#, "node 7"),
            (r#""mesh":0"#, r#""mesh":0,"children":[0]"#, "contain themselves"),
            (
                r#""asset""#,
                r#""extensionsRequired":["KHR_draco_mesh_compression"],"asset""#,
                "KHR_draco_mesh_compression",
            ),
        ] {
            assert!(json.contains(from));
            let message = read_bytes(&glb(&json.replace(from, to), &blob)).unwrap_err().to_string();
            assert!(message.contains(expected), "{message}");
        }
    }

    proptest! {
        #[test]
        fn damaged_files_never_panic(at in 0_usize..900, with in prop::collection::vec(any::<u8>(), 1..6)) {
            let (json, blob) = triangle();
            let mut bytes = glb(&json, &blob);
            for (i, byte) in with.iter().enumerate() {
                if let Some(own) = bytes.get_mut(at + i) {
                    *own = *byte;
                }
            }
            let _ = read_bytes(&bytes);
        }
    }
}
