//! Annotations of a scene: its objects, their names and boxes.
//!
//! Read from `<scene>.scene.json` (`{"objects": [{"id", "name", "min", "max", "obb"?, …}]}`) or
//! `<scene>.json` (a list of `{"bbox_id", "target", "bbox_3d"}` with six or nine numbers: center,
//! full extent and, for nine, the `ZXY` Euler angles of `EmbodiedScan` in radians). Meters, world
//! frame of the scan as imported (Z up).

use super::records::{Omission, Record};
use camino::{Utf8Path, Utf8PathBuf};
use nalgebra::UnitQuaternion;
use serde::Deserialize;
use serde_json::value::RawValue;
use std::collections::BTreeMap;
use std::fs;
use uniground_geometry::boxes::Aabb;
use uniground_geometry::color::ColorName;
use uniground_geometry::rotated_box::RotatedBox;
use uniground_geometry::scene::Structure;
use uniground_geometry::{MAX_COORDINATE_M, Point3, Vector3};

/// One annotated object.
#[derive(Debug, Clone, PartialEq)]
pub struct SceneObject {
    pub id: u32,
    pub name: String,
    pub aabb: Aabb,
    /// The oriented box, if the annotation has one.
    pub rotated: Option<RotatedBox>,
    /// Number of points of the scan's cloud that belong to it, as annotated.
    pub cloud_points: u32,
    pub mean_rgb: Option<[f32; 3]>,
    /// Color names, as annotated.
    pub colors: Vec<ColorName>,
    /// Name given by an annotator who had only seen a picture of it (`<scene>.names.json`).
    pub seen_as: Option<String>,
}

/// The objects of one scene, in order of id.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Annotations {
    pub objects: Vec<SceneObject>,
    /// Object of each point of the scan's own cloud, 0 = none (`<scene>.cloud_instance.npy`).
    pub of_point: Option<Vec<u32>>,
}

#[derive(Deserialize)]
struct SceneFile<'a> {
    #[serde(borrow)]
    objects: Vec<&'a RawValue>,
}

#[derive(Deserialize)]
struct ObjectRecord {
    id: u32,
    name: String,
    min: [f32; 3],
    max: [f32; 3],
    obb: Option<TurnedRecord>,
    #[serde(default)]
    cloud_points: u32,
    mean_rgb: Option<[f32; 3]>,
    /// For example "light brown and white".
    colour: Option<String>,
}

#[derive(Deserialize)]
struct TurnedRecord {
    center: [f32; 3],
    size: [f32; 3],
    #[serde(default)]
    yaw_deg: f32,
}

#[derive(Deserialize)]
struct LookupRecord {
    #[serde(alias = "id")]
    bbox_id: u32,
    #[serde(alias = "name")]
    target: String,
    bbox_3d: Vec<f32>,
}

impl Annotations {
    /// Returns the file that describes a scene, if `folder` contains one.
    #[must_use]
    pub fn find_file(folder: &Utf8Path, scene: &str) -> Option<Utf8PathBuf> {
        [format!("{scene}.scene.json"), format!("{scene}.json")]
            .iter()
            .map(|name| folder.join(name))
            .find(|file| file.is_file())
    }

    /// Reads a file. Invalid objects are left out and reported.
    #[must_use]
    pub fn read(file: &Utf8Path) -> (Self, Vec<Omission>) {
        let text = match fs::read_to_string(file) {
            Ok(text) => text.trim_start_matches('\u{feff}').to_owned(),
            Err(error) => {
                return (Self::default(), vec![Omission::new(file, None, error.to_string())]);
            }
        };
        let mut omissions = Vec::new();
        let mut objects: BTreeMap<u32, SceneObject> = BTreeMap::new();
        let mut take = |line: u64, object: Result<SceneObject, Omission>| match object {
            Ok(object) if objects.contains_key(&object.id) => {
                omissions.push(Omission::new(
                    file,
                    line,
                    format!("object {} is annotated twice", object.id),
                ));
            }
            Ok(object) => {
                objects.insert(object.id, object);
            }
            Err(omission) => omissions.push(omission),
        };
        let broken = |error: serde_json::Error| {
            vec![Omission::new(file, error.line() as u64, error.to_string())]
        };
        if text.trim_start().starts_with('[') {
            match Record::parse_list(&text) {
                Ok(records) => records.iter().for_each(|r| {
                    take(r.line, r.decode(file).and_then(|o| object_from_lookup(o, file, r.line)));
                }),
                Err(error) => return (Self::default(), broken(error)),
            }
        } else {
            match serde_json::from_str::<SceneFile>(&text) {
                Ok(scene) => {
                    let records = Record::with_locations(&text, &scene.objects);
                    records.iter().for_each(|r| {
                        take(
                            r.line,
                            r.decode(file).and_then(|o| object_from_record(o, file, r.line)),
                        );
                    });
                }
                Err(error) => return (Self::default(), broken(error)),
            }
        }
        let of_point = match read_point_labels(file) {
            Ok(of_point) => of_point,
            Err(omission) => {
                omissions.push(omission);
                None
            }
        };
        let mut objects: Vec<SceneObject> = objects.into_values().collect();
        omissions.extend(read_seen_names(file, &mut objects).err());
        (Self { objects, of_point }, omissions)
    }

    /// Returns boxes and their names, numbered from 1.
    #[must_use]
    pub fn from_boxes(boxes: &[(String, Aabb)]) -> Self {
        let object = |(i, (name, aabb)): (usize, &(String, Aabb))| SceneObject {
            id: i as u32 + 1,
            name: name.clone(),
            aabb: *aabb,
            rotated: None,
            cloud_points: 0,
            mean_rgb: None,
            colors: Vec::new(),
            seen_as: None,
        };
        Self { objects: boxes.iter().enumerate().map(object).collect(), of_point: None }
    }

    #[must_use]
    pub fn object(&self, id: u32) -> Option<&SceneObject> {
        self.objects.binary_search_by_key(&id, |o| o.id).ok().map(|i| &self.objects[i])
    }

    /// Returns the same objects in a world rotated about Z. Axis-aligned boxes become the bounds of
    /// the rotated ones.
    #[must_use]
    pub fn rotated(&self, deg: f32) -> Self {
        let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), deg.to_radians());
        let turned = |object: &SceneObject| {
            let own = object.rotated_box();
            let rotated = RotatedBox {
                center: turn * own.center,
                size: own.size,
                rotation: turn * own.rotation,
            };
            SceneObject { aabb: rotated.aabb(), rotated: Some(rotated), ..object.clone() }
        };
        Self { objects: self.objects.iter().map(turned).collect(), of_point: self.of_point.clone() }
    }

    /// Returns whether an object is the only one with its name.
    #[must_use]
    pub fn is_unique(&self, name: &str) -> bool {
        self.objects.iter().filter(|o| o.name == name).count() == 1
    }
}

impl SceneObject {
    /// Returns the part of the building that its name means.
    #[must_use]
    pub fn structure(&self) -> Option<Structure> {
        [Structure::Floor, Structure::Ceiling, Structure::Wall]
            .into_iter()
            .find(|s| s.as_str() == self.name)
    }

    #[must_use]
    pub fn rotated_box(&self) -> RotatedBox {
        self.rotated.unwrap_or_else(|| self.aabb.into())
    }
}

fn object_from_record(
    record: ObjectRecord,
    file: &Utf8Path,
    line: u64,
) -> Result<SceneObject, Omission> {
    let ObjectRecord { id, name, min, max, obb, cloud_points, mean_rgb, colour } = record;
    let words = colour.unwrap_or_default().replace("gray", "grey");
    let colors = ColorName::ALL
        .into_iter()
        .filter(|c| words.split_whitespace().any(|word| word == c.as_str()))
        .collect();
    let aabb = Aabb::from_corners(Point3::from(min), Point3::from(max));
    let rotated = obb.map(|TurnedRecord { center, size, yaw_deg }| RotatedBox {
        center: Point3::from(center),
        size: Vector3::from(size),
        rotation: UnitQuaternion::from_axis_angle(&Vector3::z_axis(), yaw_deg.to_radians()),
    });
    let object =
        SceneObject { id, name, aabb, rotated, cloud_points, mean_rgb, colors, seen_as: None };
    check_object(object).map_err(|what| Omission::new(file, line, format!("object {id}: {what}")))
}

fn object_from_lookup(
    LookupRecord { bbox_id: id, target: name, bbox_3d }: LookupRecord,
    file: &Utf8Path,
    line: u64,
) -> Result<SceneObject, Omission> {
    parse_box(&bbox_3d)
        .map(|rotated| SceneObject {
            id,
            name: name.replace('_', " "),
            aabb: rotated.aabb(),
            rotated: (bbox_3d.len() == 9).then_some(rotated),
            cloud_points: 0,
            mean_rgb: None,
            colors: Vec::new(),
            seen_as: None,
        })
        .and_then(check_object)
        .map_err(|what| Omission::new(file, line, format!("object {id}: {what}")))
}

/// Parses center, full extent and, with nine numbers, `ZXY` Euler angles in radians.
fn parse_box(numbers: &[f32]) -> Result<RotatedBox, String> {
    let (center, size, turn) = match *numbers {
        [x, y, z, dx, dy, dz] => ([x, y, z], [dx, dy, dz], [0.0; 3]),
        [x, y, z, dx, dy, dz, a, b, c] => ([x, y, z], [dx, dy, dz], [a, b, c]),
        _ => return Err(format!("the box has {} numbers, expected 6 or 9", numbers.len())),
    };
    let about = |axis, angle| UnitQuaternion::from_axis_angle(&axis, angle);
    let rotation = about(Vector3::z_axis(), turn[0])
        * about(Vector3::x_axis(), turn[1])
        * about(Vector3::y_axis(), turn[2]);
    Ok(RotatedBox { center: Point3::from(center), size: Vector3::from(size), rotation })
}

fn check_object(object: SceneObject) -> Result<SceneObject, String> {
    check_box(&object.aabb)?;
    object.rotated.map_or(Ok(()), |b| check_box(&Aabb { center: b.center, size: b.size }))?;
    if object.rotated.is_some_and(|b| !b.rotation.coords.iter().all(|v| v.is_finite())) {
        return Err("the rotation of the box is not a number".into());
    }
    Ok(object)
}

/// Checks that a box can be scored against. Returns the reason if not. Flat boxes cannot: their
/// overlap with any box is 0.
pub(super) fn check_box(aabb: &Aabb) -> Result<(), String> {
    let within = |v: &f32| v.is_finite() && v.abs() <= MAX_COORDINATE_M;
    if !aabb.center.iter().chain(aabb.size.iter()).all(within) {
        Err(format!("the box is not within {MAX_COORDINATE_M} meters of the origin"))
    } else if aabb.size.iter().any(|&edge| edge <= 0.0) {
        Err(format!(
            "the box has no volume ({} x {} x {} m)",
            aabb.size.x, aabb.size.y, aabb.size.z
        ))
    } else {
        Ok(())
    }
}

#[derive(Deserialize)]
struct SeenNames {
    names: BTreeMap<u32, String>,
}

/// Adds the names of `<scene>.names.json`, if it exists next to the annotations.
fn read_seen_names(file: &Utf8Path, objects: &mut [SceneObject]) -> Result<(), Omission> {
    let Some(stem) = file.as_str().strip_suffix(".scene.json") else { return Ok(()) };
    let file = Utf8PathBuf::from(format!("{stem}.names.json"));
    if !file.exists() {
        return Ok(());
    }
    let broken = |error: String| Omission::new(&file, None, error);
    let text = fs::read_to_string(&file).map_err(|error| broken(error.to_string()))?;
    let SeenNames { mut names } =
        serde_json::from_str(&text).map_err(|error| broken(error.to_string()))?;
    objects.iter_mut().for_each(|object| object.seen_as = names.remove(&object.id));
    Ok(())
}

fn read_point_labels(file: &Utf8Path) -> Result<Option<Vec<u32>>, Omission> {
    let Some(stem) = file.as_str().strip_suffix(".scene.json") else { return Ok(None) };
    let file = Utf8PathBuf::from(format!("{stem}.cloud_instance.npy"));
    if !file.is_file() {
        return Ok(None);
    }
    let told = |reason: String| Omission::new(&file, None, reason);
    let bytes = fs::read(&file).map_err(|error| told(error.to_string()))?;
    read_npy(&bytes).map(Some).map_err(|reason| told(reason.into()))
}

/// Reads a one-dimensional array of little-endian `u16` in numpy's format. The annotations use no
/// other arrays.
fn read_npy(bytes: &[u8]) -> Result<Vec<u32>, &'static str> {
    if !bytes.starts_with(b"\x93NUMPY\x01") || bytes.len() < 10 {
        return Err("not an .npy file of version 1");
    }
    let data = 10 + usize::from(u16::from_le_bytes([bytes[8], bytes[9]]));
    let header =
        bytes.get(10..data).map(String::from_utf8_lossy).ok_or("the header is truncated")?;
    if !header.contains("'<u2'") {
        return Err("expected u16 values");
    }
    Ok(bytes[data..].chunks_exact(2).map(|b| u32::from(u16::from_le_bytes([b[0], b[1]]))).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(name: &str, text: &str) -> (Annotations, Vec<Omission>) {
        let folder = tempfile::tempdir().unwrap();
        let file = Utf8Path::from_path(folder.path()).unwrap().join(name);
        fs::write(&file, text).unwrap();
        Annotations::read(&file)
    }

    #[test]
    fn malformed_boxes_are_reported_and_valid_ones_kept() {
        let (annotations, omissions) = read(
            "a.scene.json",
            r#"{"name": "a", "objects": [
                {"id": 7, "name": "sofa", "min": [0, 0, 0], "max": [2, 1, 0.8], "obb": {"center": [1, 0.5, 0.4], "size": [2, 1, 0.8], "yaw_deg": 0}},
                {"id": 7, "name": "sofa", "min": [0, 0, 0], "max": [2, 1, 0.8]},
                {"id": 8, "name": "mug", "min": [0, 0, 1], "max": [0.1, 0.1, 0.9]},
                {"id": 9, "name": "lamp", "min": [0, 0], "max": [1, 1, 1]},
                {"id": 3, "name": "wall", "min": [0, 0, 0], "max": [0.1, 4, 2.5]}
            ]}"#,
        );
        assert_eq!(annotations.objects.iter().map(|o| o.id).collect::<Vec<_>>(), [3, 7]);
        assert!(
            annotations.object(7).unwrap().rotated.is_some() && annotations.object(8).is_none()
        );
        assert_eq!(annotations.object(3).unwrap().structure(), Some(Structure::Wall));
        let told: Vec<_> = omissions.iter().map(|o| (o.line, o.reason.as_str())).collect();
        assert_eq!(told[0], (Some(3), "object 7 is annotated twice"));
        assert!(
            told[1].0 == Some(4) && told[1].1.contains("object 8: the box has no volume"),
            "{told:?}"
        );
        assert!(told[2].0 == Some(5) && told[2].1.contains("min"), "{told:?}");
    }

    #[test]
    fn annotation_boxes_have_six_or_nine_numbers() {
        let (annotations, omissions) = read(
            "47333462.json",
            r#"[{"bbox_id": 0, "target": "coffee_table", "bbox_3d": [1, 2, 0.5, 2, 1, 0.4]},
                {"bbox_id": 1, "target": "bed", "bbox_3d": [0, 0, 0, 2, 1, 0.5, 1.5707963, 0, 0]},
                {"bbox_id": 2, "target": "lamp", "bbox_3d": [0, 0, 0, 1]}]"#,
        );
        assert_eq!(annotations.objects[0].name, "coffee table");
        assert!(
            (annotations.objects[1].aabb.size - Vector3::new(1.0, 2.0, 0.5)).norm() < 1e-5,
            "{annotations:?}"
        );
        assert_eq!(
            omissions[0].to_string().split_once(".json").unwrap().1,
            ":3: object 2: the box has 4 numbers, expected 6 or 9"
        );
    }
}
