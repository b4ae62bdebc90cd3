//! Writes glTF 2.0 as one binary file: a node for each thing, with its points, its properties as
//! `extras`, and its box as lines.
//!
//! ```text
//! title                rotates Z up into glTF's Y up; all below is in the frame of the scene
//!   mug                extras: id, name, box, …; its points
//!     box of mug       a cube of lines, moved, rotated and scaled
//!   …
//!   rest of the scan   points that belong to no thing
//! ```
//! Positions are as measured. Colors are linear floats: bytes have too little precision for dark
//! colors, and readers misread 16-bit integers. Materials are unlit: points have no normals, and
//! their colors already include the light of the room.

use super::{EDGES, Export, ObjectDescription, REST, srgb_to_linear, unit_corners};
use serde::Serialize;
use std::io::{self, BufWriter, Write};
use uniground_geometry::Point3;
use uniground_geometry::scene::{Instance, id_color};

/// Column-major matrix that maps `(x, y, z)` to `(x, z, -y)`.
const Z_UP_TO_Y_UP: [f32; 16] =
    [1.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0];
/// Minimum extent of a drawn box, meters. A matrix with zero scale cannot be inverted.
const THINNEST_M: f32 = 0.001;
const UNLIT: &str = "KHR_materials_unlit";

// Constants of the glTF standard.
const FLOAT: u32 = 5126;
const UNSIGNED_SHORT: u32 = 5123;
const VERTICES: u32 = 34962;
const INDICES: u32 = 34963;
const POINTS: u32 = 0;
const LINES: u32 = 1;

// Indices of the items that come first in every file.
const CORNERS_VIEW: usize = 0;
const EDGES_VIEW: usize = 1;
const POSITIONS_VIEW: usize = 2;
const COLORS_VIEW: usize = 3;
const CORNERS: usize = 0;
const EDGE_INDICES: usize = 1;
const POINT_MATERIAL: usize = 0;

const CORNERS_BYTES: usize = 8 * 12;
const EDGES_BYTES: usize = 24 * 2;
const POSITION_BYTES: usize = 12;
const COLOR_BYTES: usize = 12;

/// Writes a scene as GLB.
///
/// # Errors
/// Returns errors of `out`, and an error for more than 4 GB.
pub fn write_glb(export: &Export, out: impl Write) -> io::Result<()> {
    let (things, rest) = export.group_points();
    let document = Document::from_export(export, &things, &rest);
    let mut json = serde_json::to_vec(&document)?;
    json.resize(json.len().next_multiple_of(4), b' ');
    let blob_bytes = document.buffers[0].byte_length;
    let in_header = |bytes: usize| {
        u32::try_from(bytes)
            .map_err(|_| io::Error::new(io::ErrorKind::InvalidInput, "too many points for a GLB"))
    };
    let mut out = BufWriter::new(out);
    out.write_all(b"glTF")?;
    for word in [2, in_header(12 + 8 + json.len() + 8 + blob_bytes)?, in_header(json.len())?] {
        out.write_all(&word.to_le_bytes())?;
    }
    out.write_all(b"JSON")?;
    out.write_all(&json)?;
    out.write_all(&in_header(blob_bytes)?.to_le_bytes())?;
    out.write_all(b"BIN\0")?;

    for number in unit_corners().iter().flatten() {
        out.write_all(&number.to_le_bytes())?;
    }
    for corner in EDGES.as_flattened() {
        out.write_all(&u16::from(*corner).to_le_bytes())?;
    }
    let points =
        || things.iter().flat_map(|(_, points)| points).chain(&rest).map(|point| *point as usize);
    for number in points().flat_map(|point| <[f32; 3]>::from(export.cloud.positions[point])) {
        out.write_all(&number.to_le_bytes())?;
    }
    let lights: Vec<f32> = (0..=255).map(srgb_to_linear).collect();
    for channel in points().flat_map(|point| export.cloud.colors[point]) {
        out.write_all(&lights[usize::from(channel)].to_le_bytes())?;
    }
    out.flush()
}

/// The JSON part of a file, which describes its binary part.
#[derive(Serialize)]
#[serde(rename_all = "camelCase")]
struct Document<'a> {
    asset: Asset,
    extensions_used: [&'static str; 1],
    scene: usize,
    scenes: [Scene<'a>; 1],
    nodes: Vec<Node<'a>>,
    meshes: Vec<Mesh<'a>>,
    materials: Vec<Material>,
    accessors: Vec<Accessor>,
    buffer_views: Vec<BufferView>,
    buffers: [Buffer; 1],
}

#[derive(Serialize)]
struct Asset {
    version: &'static str,
    generator: &'static str,
}

#[derive(Serialize)]
struct Scene<'a> {
    name: &'a str,
    nodes: [usize; 1],
}

#[derive(Serialize)]
struct Node<'a> {
    name: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    mesh: Option<usize>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    children: Vec<usize>,
    #[serde(flatten)]
    place: Option<NodePlacement>,
    #[serde(skip_serializing_if = "Option::is_none")]
    extras: Option<ObjectDescription<'a>>,
}

#[derive(Serialize)]
#[serde(untagged)]
enum NodePlacement {
    Turned { matrix: [f32; 16] },
    Box { translation: Point3<f32>, rotation: [f32; 4], scale: [f32; 3] },
}

#[derive(Serialize)]
struct Mesh<'a> {
    name: &'a str,
    primitives: [Primitive; 1],
}

#[derive(Serialize)]
struct Primitive {
    attributes: Attributes,
    #[serde(skip_serializing_if = "Option::is_none")]
    indices: Option<usize>,
    material: usize,
    mode: u32,
}

#[derive(Serialize)]
#[serde(rename_all = "SCREAMING_SNAKE_CASE")]
struct Attributes {
    position: usize,
    #[serde(rename = "COLOR_0", skip_serializing_if = "Option::is_none")]
    color: Option<usize>,
}

#[derive(Serialize)]
#[serde(rename_all = "camelCase")]
struct Material {
    name: String,
    pbr_metallic_roughness: PbrSurface,
    extensions: Unlit,
}

/// Fallback for readers without support for the extension.
#[derive(Serialize)]
struct PbrSurface {
    #[serde(rename = "baseColorFactor")]
    color: [f32; 4],
    #[serde(rename = "metallicFactor")]
    metallic: f32,
    #[serde(rename = "roughnessFactor")]
    rough: f32,
}

#[derive(Serialize)]
struct Unlit {
    #[serde(rename = "KHR_materials_unlit")]
    unlit: EmptyExtension,
}

#[derive(Serialize)]
struct EmptyExtension {}

#[derive(Serialize)]
#[serde(rename_all = "camelCase")]
struct Accessor {
    buffer_view: usize,
    byte_offset: usize,
    component_type: u32,
    count: usize,
    #[serde(rename = "type")]
    shape: &'static str,
    #[serde(skip_serializing_if = "Option::is_none")]
    min: Option<[f32; 3]>,
    #[serde(skip_serializing_if = "Option::is_none")]
    max: Option<[f32; 3]>,
}

#[derive(Serialize)]
#[serde(rename_all = "camelCase")]
struct BufferView {
    buffer: usize,
    byte_offset: usize,
    byte_length: usize,
    #[serde(skip_serializing_if = "Option::is_none")]
    byte_stride: Option<usize>,
    target: u32,
}

#[derive(Serialize)]
#[serde(rename_all = "camelCase")]
struct Buffer {
    byte_length: usize,
}

impl<'a> Document<'a> {
    fn from_export(export: &Export<'a>, things: &[(&'a Instance, Vec<u32>)], rest: &[u32]) -> Self {
        let count = export.points.len();
        let mut document = Self {
            asset: Asset { version: "2.0", generator: "uniground" },
            extensions_used: [UNLIT],
            scene: 0,
            scenes: [Scene { name: export.title, nodes: [0] }],
            nodes: vec![Node {
                name: export.title.to_owned(),
                mesh: None,
                children: Vec::new(),
                place: Some(NodePlacement::Turned { matrix: Z_UP_TO_Y_UP }),
                extras: None,
            }],
            meshes: Vec::new(),
            materials: vec![Material::new("points".into(), [u8::MAX; 3])],
            accessors: box_accessors(),
            buffer_views: buffer_views(count),
            buffers: [Buffer {
                byte_length: CORNERS_BYTES + EDGES_BYTES + count * (POSITION_BYTES + COLOR_BYTES),
            }],
        };
        let mut before = 0;
        for (thing, points) in things {
            let mesh = document.add_points(export, thing.label(), points, before);
            before += points.len();
            document.add_object(thing, mesh);
        }
        if let Some(mesh) = document.add_points(export, REST, rest, before) {
            let node = Node {
                name: REST.into(),
                mesh: Some(mesh),
                children: Vec::new(),
                place: None,
                extras: None,
            };
            let added = document.add_node(node);
            document.nodes[0].children.push(added);
        }
        document
    }

    /// Returns the mesh of points that are stored after `before` other points. `None` if there are
    /// none.
    fn add_points(
        &mut self,
        export: &Export,
        name: &'a str,
        points: &[u32],
        before: usize,
    ) -> Option<usize> {
        let positions = points.iter().map(|point| export.cloud.positions[*point as usize]);
        let (min, max) = positions.fold(None, |around, p| {
            Some(around.map_or((p, p), |(min, max): (Point3<f32>, _)| (min.inf(&p), p.sup(&max))))
        })?;
        let (position, color) = (self.accessors.len(), self.accessors.len() + 1);
        self.accessors.push(Accessor {
            buffer_view: POSITIONS_VIEW,
            byte_offset: before * POSITION_BYTES,
            component_type: FLOAT,
            count: points.len(),
            shape: "VEC3",
            min: Some(min.into()),
            max: Some(max.into()),
        });
        self.accessors.push(Accessor {
            buffer_view: COLORS_VIEW,
            byte_offset: before * COLOR_BYTES,
            component_type: FLOAT,
            count: points.len(),
            shape: "VEC3",
            min: None,
            max: None,
        });
        let attributes = Attributes { position, color: Some(color) };
        self.meshes.push(Mesh {
            name,
            primitives: [Primitive {
                attributes,
                indices: None,
                material: POINT_MATERIAL,
                mode: POINTS,
            }],
        });
        Some(self.meshes.len() - 1)
    }

    /// Adds a thing with its box, below the root.
    fn add_object(&mut self, thing: &'a Instance, mesh: Option<usize>) {
        let name = thing.label();
        let material = self.materials.len();
        self.materials.push(Material::new(format!("box of {name}"), id_color(thing.id.0)));
        let attributes = Attributes { position: CORNERS, color: None };
        let lines = Primitive { attributes, indices: Some(EDGE_INDICES), material, mode: LINES };
        self.meshes.push(Mesh { name: "box", primitives: [lines] });
        let (half_sin, half_cos) = (thing.oriented_box.yaw_rad / 2.0).sin_cos();
        let place = NodePlacement::Box {
            translation: thing.oriented_box.center,
            rotation: [0.0, 0.0, half_sin, half_cos],
            scale: thing.oriented_box.size.map(|side| side.max(THINNEST_M)).into(),
        };
        let lines = Some(self.meshes.len() - 1);
        let outline = self.add_node(Node {
            name: format!("box of {name}"),
            mesh: lines,
            children: Vec::new(),
            place: Some(place),
            extras: None,
        });
        let extras = Some(ObjectDescription::from_instance(thing));
        let added = self.add_node(Node {
            name: name.to_owned(),
            mesh,
            children: vec![outline],
            place: None,
            extras,
        });
        self.nodes[0].children.push(added);
    }

    fn add_node(&mut self, node: Node<'a>) -> usize {
        self.nodes.push(node);
        self.nodes.len() - 1
    }
}

impl Material {
    fn new(name: String, color: [u8; 3]) -> Self {
        let [red, green, blue] = color.map(srgb_to_linear);
        let surface = PbrSurface { color: [red, green, blue, 1.0], metallic: 0.0, rough: 1.0 };
        Self {
            name,
            pbr_metallic_roughness: surface,
            extensions: Unlit { unlit: EmptyExtension {} },
        }
    }
}

fn box_accessors() -> Vec<Accessor> {
    let accessor = |buffer_view, component_type, count, shape, around: Option<f32>| Accessor {
        buffer_view,
        byte_offset: 0,
        component_type,
        count,
        shape,
        min: around.map(|side| [-side; 3]),
        max: around.map(|side| [side; 3]),
    };
    vec![
        accessor(CORNERS_VIEW, FLOAT, 8, "VEC3", Some(0.5)),
        accessor(EDGES_VIEW, UNSIGNED_SHORT, 24, "SCALAR", None),
    ]
}

fn buffer_views(count: usize) -> Vec<BufferView> {
    let view = |byte_offset, byte_length, byte_stride, target| BufferView {
        buffer: 0,
        byte_offset,
        byte_length,
        byte_stride,
        target,
    };
    let mut views = vec![
        view(0, CORNERS_BYTES, Some(POSITION_BYTES), VERTICES),
        view(CORNERS_BYTES, EDGES_BYTES, None, INDICES),
    ];
    // A buffer view must hold at least one byte.
    if count > 0 {
        let positions = CORNERS_BYTES + EDGES_BYTES;
        views.push(view(positions, count * POSITION_BYTES, Some(POSITION_BYTES), VERTICES));
        views.push(view(
            positions + count * POSITION_BYTES,
            count * COLOR_BYTES,
            Some(COLOR_BYTES),
            VERTICES,
        ));
    }
    views
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tests::{Room, room};
    use camino::Utf8Path;
    use serde_json::{Value, json};

    fn written(room: &Room, most: usize) -> Vec<u8> {
        let mut bytes = Vec::new();
        write_glb(
            &Export::new("my room", &room.cloud, &room.of_point, &room.instances, most),
            &mut bytes,
        )
        .unwrap();
        bytes
    }

    fn document(bytes: &[u8]) -> Value {
        let word = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap()) as usize;
        assert_eq!(
            (&bytes[..4], word(4), word(8), &bytes[16..20]),
            (&b"glTF"[..], 2, bytes.len(), &b"JSON"[..])
        );
        let blob = 20 + word(12);
        assert_eq!(
            (blob % 4, &bytes[blob + 4..blob + 8], blob + 8 + word(blob)),
            (0, &b"BIN\0"[..], bytes.len())
        );
        serde_json::from_slice(&bytes[20..blob]).unwrap()
    }

    #[test]
    fn every_thing_is_a_node_with_its_points_and_properties() {
        let document = document(&written(&room(), usize::MAX));
        let nodes = document["nodes"].as_array().unwrap();
        let children: Vec<&Value> = nodes[0]["children"]
            .as_array()
            .unwrap()
            .iter()
            .map(|at| &nodes[at.as_u64().unwrap() as usize])
            .collect();
        assert_eq!(nodes[0]["name"], "my room");
        let names: Vec<&str> = children.iter().map(|node| node["name"].as_str().unwrap()).collect();
        assert_eq!(names, ["floor", "coffee table", "mug", "rest of the scan"]);
        let points = |node: &Value| {
            let primitive =
                &document["meshes"][node["mesh"].as_u64().unwrap() as usize]["primitives"][0];
            assert_eq!(primitive["mode"], 0);
            document["accessors"][primitive["attributes"]["POSITION"].as_u64().unwrap() as usize]["count"]
                .as_u64()
                .unwrap()
        };
        assert_eq!(children.iter().map(|node| points(node)).collect::<Vec<_>>(), [4, 3, 1, 2]);
        assert!(children[3].get("extras").is_none());
        let mug = &children[2]["extras"];
        assert_eq!(
            (&mug["id"], &mug["name"], &mug["label"], &mug["level"]),
            (&json!(3), &json!("mug"), &json!("mug"), &json!("thing"))
        );
        assert_eq!(mug["support"], json!({"on": "instance", "id": 2}));
        assert_eq!(mug["box"]["center"], json!([1.0, 2.0, 0.55]));
        assert_eq!(
            (&mug["oriented_box"]["yaw_rad"], &mug["confidence"]),
            (&json!(0.5), &json!(0.75))
        );
        assert_eq!(children[0]["extras"]["structure"], "floor");
        let outline = &nodes[children[2]["children"][0].as_u64().unwrap() as usize];
        assert_eq!(
            (&outline["translation"], &outline["scale"]),
            (&json!([1.0, 2.0, 0.55]), &json!([0.1, 0.1, 0.1]))
        );
        assert_eq!(
            document["meshes"][outline["mesh"].as_u64().unwrap() as usize]["primitives"][0]["mode"],
            1
        );
    }

    /// Read with the importer of uploads: up stays up, nothing is mirrored, colors are unchanged.
    #[test]
    fn exported_file_can_be_imported_unchanged() {
        let room = room();
        let folder = tempfile::tempdir().unwrap();
        let file = Utf8Path::from_path(folder.path()).unwrap().join("room.glb");
        std::fs::write(&file, written(&room, usize::MAX)).unwrap();
        let read = uniground_ingest::read_cloud(&file).unwrap();
        let sorted = |mut points: Vec<([f32; 3], [u8; 3])>| {
            points.sort_by(|a, b| a.partial_cmp(b).unwrap());
            points
        };
        let turned = |p: &Point3<f32>| [p.x, p.z, -p.y];
        let expected =
            room.cloud.positions.iter().map(turned).zip(room.cloud.colors.iter().copied());
        let read = read.positions.iter().map(|p| [p.x, p.y, p.z]).zip(read.colors.iter().copied());
        assert_eq!(sorted(read.collect()), sorted(expected.collect()));
    }

    #[test]
    fn scene_without_points_is_a_valid_file() {
        let room = room();
        let document = document(&written(&room, 0));
        assert_eq!(document["bufferViews"].as_array().unwrap().len(), 2);
        assert_eq!(document["nodes"].as_array().unwrap().len(), 1 + 2 * 3);
        assert_eq!(written(&room, 5), written(&room, 5));
    }
}
