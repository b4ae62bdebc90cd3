//! The parts of a glTF file that are read, and the numbers in its buffers.

use crate::IngestError;
use crate::clouds::obj::sibling_path;
use camino::Utf8Path;
use serde::Deserialize;
use std::borrow::Cow;
use std::collections::BTreeMap;
use std::fs::File;
use std::io::Read;

const MAX_BUFFER_BYTES: u64 = 2 << 30;

#[derive(Deserialize)]
#[serde(rename_all = "camelCase", default)]
#[derive(Default)]
pub(super) struct Document {
    scene: Option<usize>,
    scenes: Vec<Scene>,
    pub nodes: Vec<Node>,
    pub meshes: Vec<GltfMesh>,
    pub materials: Vec<Material>,
    pub textures: Vec<TextureSource>,
    images: Vec<Image>,
    accessors: Vec<Accessor>,
    buffer_views: Vec<BufferView>,
    buffers: Vec<Buffer>,
    pub extensions_required: Vec<String>,
}

#[derive(Deserialize, Default)]
#[serde(default)]
struct Scene {
    nodes: Vec<usize>,
}

#[derive(Deserialize, Default)]
#[serde(default)]
pub(super) struct Node {
    pub mesh: Option<usize>,
    pub children: Vec<usize>,
    pub matrix: Option<[f64; 16]>,
    pub rotation: Option<[f64; 4]>,
    pub translation: Option<[f64; 3]>,
    pub scale: Option<[f64; 3]>,
}

#[derive(Deserialize, Default)]
#[serde(default)]
pub(super) struct GltfMesh {
    pub primitives: Vec<Primitive>,
}

#[derive(Deserialize, Default)]
#[serde(default)]
pub(super) struct Primitive {
    pub attributes: BTreeMap<String, usize>,
    pub indices: Option<usize>,
    pub material: Option<usize>,
    pub mode: Option<u32>,
}

#[derive(Deserialize, Default)]
#[serde(default)]
pub(super) struct Material {
    #[serde(rename = "pbrMetallicRoughness")]
    pub pbr: PbrMaterial,
}

#[derive(Deserialize, Default)]
#[serde(default)]
pub(super) struct PbrMaterial {
    #[serde(rename = "baseColorTexture")]
    pub base_color_texture: Option<TextureReference>,
    #[serde(rename = "baseColorFactor")]
    pub base_color_factor: Option<[f32; 4]>,
}

#[derive(Deserialize)]
pub(super) struct TextureReference {
    pub index: usize,
}

#[derive(Deserialize, Default)]
#[serde(default)]
pub(super) struct TextureSource {
    pub source: Option<usize>,
}

#[derive(Deserialize, Default)]
#[serde(rename_all = "camelCase", default)]
struct Image {
    uri: Option<String>,
    buffer_view: Option<usize>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Accessor {
    buffer_view: Option<usize>,
    #[serde(default)]
    byte_offset: usize,
    component_type: u32,
    #[serde(default)]
    normalized: bool,
    count: usize,
    #[serde(rename = "type")]
    shape: String,
    sparse: Option<serde_json::Value>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct BufferView {
    buffer: usize,
    #[serde(default)]
    byte_offset: usize,
    byte_length: usize,
    byte_stride: Option<usize>,
}

#[derive(Deserialize)]
struct Buffer {
    uri: Option<String>,
}

impl Document {
    /// Returns the nodes without a parent: those of the default scene, or of the whole file if it
    /// has none.
    pub fn roots(&self) -> Vec<usize> {
        if let Some(scene) = self.scenes.get(self.scene.unwrap_or(0)) {
            return scene.nodes.clone();
        }
        let inner: std::collections::BTreeSet<usize> =
            self.nodes.iter().flat_map(|n| n.children.iter().copied()).collect();
        (0..self.nodes.len()).filter(|n| !inner.contains(n)).collect()
    }
}

/// Bytes of all buffers, and the location of image files.
pub(super) struct Buffers<'a> {
    bytes: Vec<Vec<u8>>,
    root: &'a Utf8Path,
    file: &'a Utf8Path,
}

/// Rows of numbers within a buffer.
pub(super) struct AccessorRows<'a> {
    bytes: &'a [u8],
    stride: usize,
    count: usize,
    columns: usize,
    component: u32,
    normalized: bool,
}

impl<'a> Buffers<'a> {
    pub fn load(
        document: &Document,
        mut blob: Option<Vec<u8>>,
        root: &'a Utf8Path,
        file: &'a Utf8Path,
    ) -> Result<Self, IngestError> {
        let mut own = Self { bytes: Vec::new(), root, file };
        for buffer in &document.buffers {
            let bytes = match &buffer.uri {
                None => blob
                    .take()
                    .ok_or_else(|| IngestError::malformed(file, "its binary part is missing"))?,
                Some(uri) => own.read_uri(uri)?,
            };
            own.bytes.push(bytes);
        }
        Ok(own)
    }

    /// Returns the bytes of a data URI, or of a file next to the document.
    fn read_uri(&self, uri: &str) -> Result<Vec<u8>, IngestError> {
        if let Some(data) = uri.strip_prefix("data:") {
            let text = data.split_once(";base64,").map(|(_, text)| text);
            return text
                .and_then(decode_base64)
                .ok_or_else(|| IngestError::malformed(self.file, "a data URI is not base64"));
        }
        let name = uri.replace("%20", " ");
        let path = sibling_path(self.file, &name).ok_or_else(|| IngestError::UnsafeEntry {
            entry: name,
            reason: "points outside the upload",
        })?;
        let mut bytes = Vec::new();
        File::open(self.root.join(&path))
            .and_then(|source| source.take(MAX_BUFFER_BYTES).read_to_end(&mut bytes))
            .map_err(|source| IngestError::reading(path, source))?;
        Ok(bytes)
    }

    pub fn read_image(&self, document: &Document, number: usize) -> Result<Cow<'_, [u8]>, String> {
        let image =
            document.images.get(number).ok_or_else(|| format!("image {number} does not exist"))?;
        match (&image.uri, image.buffer_view) {
            (Some(uri), _) => self.read_uri(uri).map(Cow::Owned).map_err(|e| e.to_string()),
            (None, Some(view)) => {
                self.read_view(document, view).map(|(bytes, _)| Cow::Borrowed(bytes))
            }
            (None, None) => Err(format!("image {number} has no data")),
        }
    }

    fn read_view(
        &self,
        document: &Document,
        number: usize,
    ) -> Result<(&[u8], Option<usize>), String> {
        let view = document
            .buffer_views
            .get(number)
            .ok_or_else(|| format!("view {number} does not exist"))?;
        let buffer = self
            .bytes
            .get(view.buffer)
            .ok_or_else(|| format!("buffer {} does not exist", view.buffer))?;
        let end = view.byte_offset.checked_add(view.byte_length);
        let bytes = end.and_then(|end| buffer.get(view.byte_offset..end));
        Ok((
            bytes.ok_or_else(|| format!("view {number} is larger than its buffer"))?,
            view.byte_stride,
        ))
    }

    /// Returns numbers with at least `columns` columns.
    pub fn read_accessor(
        &self,
        document: &Document,
        number: usize,
        columns: usize,
    ) -> Result<AccessorRows<'_>, String> {
        let accessor = document
            .accessors
            .get(number)
            .ok_or_else(|| format!("accessor {number} does not exist"))?;
        if accessor.sparse.is_some() {
            return Err("sparse accessors are not supported".into());
        }
        let view = accessor.buffer_view.ok_or_else(|| format!("accessor {number} has no data"))?;
        let (bytes, stride) = self.read_view(document, view)?;
        let found = match accessor.shape.as_str() {
            "SCALAR" => 1,
            "VEC2" => 2,
            "VEC3" => 3,
            "VEC4" => 4,
            other => return Err(format!("accessor {number} has the unsupported type {other}")),
        };
        let size = match accessor.component_type {
            5120 | 5121 => 1,
            5122 | 5123 => 2,
            5125 | 5126 => 4,
            other => {
                return Err(format!(
                    "accessor {number} has the unsupported component type {other}"
                ));
            }
        };
        if found < columns {
            return Err(format!(
                "accessor {number} has {found} numbers per row; {columns} are needed"
            ));
        }
        let row = found * size;
        let stride = stride.unwrap_or(row).max(row);
        let bytes = bytes.get(accessor.byte_offset..).unwrap_or_default();
        let needed = accessor
            .count
            .checked_sub(1)
            .map_or(Some(0), |rows| rows.checked_mul(stride)?.checked_add(row));
        if needed.is_none_or(|needed| needed > bytes.len()) {
            return Err(format!("accessor {number} is larger than its buffer"));
        }
        let Accessor { count, component_type: component, normalized, .. } = *accessor;
        Ok(AccessorRows { bytes, stride, count, columns, component, normalized })
    }
}

impl AccessorRows<'_> {
    pub fn len(&self) -> usize {
        self.count
    }

    pub fn get(&self, row: usize) -> Option<[f64; 3]> {
        (row < self.count).then(|| self.row(row))
    }

    fn row(&self, row: usize) -> [f64; 3] {
        std::array::from_fn(
            |column| if column < self.columns { self.number(row, column) } else { 0.0 },
        )
    }

    fn number(&self, row: usize, column: usize) -> f64 {
        let b = |size: usize, i: usize| self.bytes[row * self.stride + column * size + i];
        let (value, largest) = match self.component {
            5120 => (f64::from(b(1, 0).cast_signed()), 127.0),
            5121 => (f64::from(b(1, 0)), 255.0),
            5122 => (f64::from(i16::from_le_bytes([b(2, 0), b(2, 1)])), 32767.0),
            5123 => (f64::from(u16::from_le_bytes([b(2, 0), b(2, 1)])), 65535.0),
            5125 => (
                f64::from(u32::from_le_bytes(std::array::from_fn(|i| b(4, i)))),
                f64::from(u32::MAX),
            ),
            _ => return f64::from(f32::from_le_bytes(std::array::from_fn(|i| b(4, i)))),
        };
        if self.normalized { (value / largest).max(-1.0) } else { value }
    }
}

/// Decodes base64 (RFC 4648), with or without padding.
fn decode_base64(text: &str) -> Option<Vec<u8>> {
    let mut bytes = Vec::with_capacity(text.len() / 4 * 3);
    let (mut bits, mut held) = (0_u32, 0);
    for c in text.trim_end_matches('=').bytes() {
        let six = match c {
            b'A'..=b'Z' => c - b'A',
            b'a'..=b'z' => c - b'a' + 26,
            b'0'..=b'9' => c - b'0' + 52,
            b'+' => 62,
            b'/' => 63,
            _ => return None,
        };
        bits = (bits << 6 | u32::from(six)) & 0xff_ffff;
        held += 6;
        if held >= 8 {
            held -= 8;
            bytes.push((bits >> held) as u8);
        }
    }
    Some(bytes)
}
