//! Wavefront OBJ: vertices with or without color, faces, and the textures of its materials.
//! Without faces the vertices are the cloud.

use super::CloudBuilder;
use super::mesh::{MAX_ELEMENTS, Mesh, MeshVertex, Triangle};
use super::texture::Texture;
use crate::IngestError;
use crate::limited_reader::{read_line, read_text};
use camino::{Utf8Component, Utf8Path, Utf8PathBuf};
use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io::{BufReader, Read};
use uniground_types::findings::{Finding, FindingSubject};

const MAX_LINE_BYTES: u64 = 64 << 10;
const MAX_MATERIAL_BYTES: u64 = 4 << 20;
const MAX_TEXTURES: usize = 64;
const MAX_TEXTURE_BYTES: u64 = 128 << 20;
/// Maximum number of missing files that are counted and named, and of characters of a name.
const MAX_MISSING: usize = 1000;
const MAX_NAMED: usize = 5;
const MAX_NAME_LENGTH: usize = 80;

#[derive(Default)]
struct ObjReader {
    positions: Vec<[f64; 3]>,
    tints: Vec<[f32; 3]>,
    uvs: Vec<[f32; 2]>,
    mesh: Mesh,
    /// Texture of each material, by name.
    materials: BTreeMap<String, u32>,
    current: Option<u32>,
    /// Material files and textures that are named but missing.
    missing: BTreeSet<String>,
}

pub(super) fn read(
    root: &Utf8Path,
    file: &Utf8Path,
    mut gathered: CloudBuilder,
) -> Result<CloudBuilder, IngestError> {
    let source =
        File::open(root.join(file)).map_err(|source| IngestError::reading(file, source))?;
    let mut source = BufReader::with_capacity(1 << 20, source);
    let mut reading = ObjReader::default();
    let (mut line, mut number) = (Vec::new(), 0_usize);
    loop {
        number += 1;
        let at = |reason: String| IngestError::malformed(file, format!("line {number}: {reason}"));
        if !read_line(&mut source, &mut line, MAX_LINE_BYTES).map_err(|e| at(e.to_string()))? {
            break;
        }
        let text = String::from_utf8_lossy(&line);
        let mut words = text.split_ascii_whitespace();
        match words.next() {
            Some("v") => reading.parse_vertex(words).map_err(at)?,
            Some("vt") => reading.parse_texture_coordinates(words).map_err(at)?,
            Some("f") => reading.parse_face(words).map_err(at)?,
            Some("mtllib") => {
                reading.read_materials(root, file, text.trim_start()["mtllib".len()..].trim())?;
            }
            Some("usemtl") => {
                reading.current =
                    reading.materials.get(text.trim_start()["usemtl".len()..].trim()).copied();
            }
            _ => {}
        }
        if reading.positions.len().max(reading.uvs.len()).max(reading.mesh.triangles.len())
            > MAX_ELEMENTS
        {
            return Err(IngestError::malformed(
                file,
                format!("more than {MAX_ELEMENTS} vertices or faces: simplify it first"),
            ));
        }
    }
    let ObjReader { positions, tints, mut mesh, missing, .. } = reading;
    if !missing.is_empty() {
        let named: Vec<&str> = missing.iter().take(MAX_NAMED).map(String::as_str).collect();
        let text = format!(
            "{} of the files that it names are missing, so faces have no color: {}",
            missing.len(),
            named.join(", ")
        );
        let finding = Finding::unusual(FindingSubject::Color, text).counting(missing.len());
        gathered.add_finding(finding);
    }
    mesh.has_color |= !tints.is_empty();
    if mesh.triangles.is_empty() {
        let color = |i: usize| tints.get(i).map(|t| t.map(|c| (c * 255.0).round() as u8));
        mesh.points = positions.iter().enumerate().map(|(i, p)| (*p, color(i))).collect();
    }
    mesh.sample(file, 1.0, &mut gathered)?;
    Ok(gathered)
}

impl ObjReader {
    fn parse_vertex<'a>(&mut self, words: impl Iterator<Item = &'a str>) -> Result<(), String> {
        let values: Vec<f64> = words
            .take(8)
            .map(|w| w.parse().map_err(|_| format!("{w:?} is not a number")))
            .collect::<Result<_, _>>()?;
        let [x, y, z, rest @ ..] = &values[..] else {
            return Err("a vertex needs three numbers".into());
        };
        self.positions.push([*x, *y, *z]);
        // Colors are usually in `0..=1`; some writers use bytes. A single fourth number is a
        // weight.
        if let [r, g, b] = rest {
            let scale = if r.max(*g).max(*b) > 1.0 { 1.0 / 255.0 } else { 1.0 };
            self.tints.resize(self.positions.len() - 1, [0.5; 3]);
            self.tints.push([r, g, b].map(|c| (c * scale).clamp(0.0, 1.0) as f32));
        }
        Ok(())
    }

    fn parse_texture_coordinates<'a>(
        &mut self,
        words: impl Iterator<Item = &'a str>,
    ) -> Result<(), String> {
        let values: Vec<f32> = words
            .take(2)
            .map(|w| w.parse().map_err(|_| format!("{w:?} is not a number")))
            .collect::<Result<_, _>>()?;
        // V grows upwards in the file, downwards in pictures.
        self.uvs.push([
            values.first().copied().unwrap_or(0.0),
            1.0 - values.get(1).copied().unwrap_or(0.0),
        ]);
        Ok(())
    }

    /// Parses `f v`, `f v/vt`, `f v/vt/vn` or `f v//vn`. Indices count from 1, or backwards from
    /// the last. Polygons are split into fans.
    fn parse_face<'a>(&mut self, words: impl Iterator<Item = &'a str>) -> Result<(), String> {
        let mut corners = Vec::new();
        for word in words.take(256) {
            let mut parts = word.split('/');
            let index = |part: Option<&str>, count: usize| -> Result<Option<usize>, String> {
                let Some(part) = part.filter(|p| !p.is_empty()) else { return Ok(None) };
                let number: i64 =
                    part.parse().map_err(|_| format!("{word:?} is not a face corner"))?;
                let at = if number < 0 {
                    number.checked_add(count as i64)
                } else {
                    number.checked_sub(1)
                };
                let at = at.and_then(|at| usize::try_from(at).ok()).filter(|at| *at < count);
                at.map(Some).ok_or_else(|| format!("{word:?} names a vertex that does not exist"))
            };
            let at = index(parts.next(), self.positions.len())?
                .ok_or_else(|| format!("{word:?} is not a face corner"))?;
            let uv = index(parts.next(), self.uvs.len())?;
            corners.push(MeshVertex {
                at: self.positions[at],
                tint: self.tints.get(at).copied().unwrap_or([1.0; 3]),
                uv: uv.map(|uv| self.uvs[uv]),
            });
        }
        for pair in corners.windows(2).skip(1) {
            self.mesh
                .triangles
                .push(Triangle { corners: [corners[0], pair[0], pair[1]], texture: self.current });
        }
        Ok(())
    }

    fn note_missing(&mut self, path: &str) {
        if self.missing.len() < MAX_MISSING {
            // Paths are often those of another computer.
            let name = path.rsplit(['/', '\\']).next().unwrap_or(path);
            self.missing.insert(name.chars().take(MAX_NAME_LENGTH).collect());
        }
    }

    fn read_materials(
        &mut self,
        root: &Utf8Path,
        file: &Utf8Path,
        name: &str,
    ) -> Result<(), IngestError> {
        // Without its material file, a mesh is read without color.
        let Some(library) = sibling_path(file, name).filter(|path| root.join(path).is_file())
        else {
            self.note_missing(name);
            return Ok(());
        };
        let text = read_text(root, &library, MAX_MATERIAL_BYTES)?;
        let mut material = String::new();
        for line in text.lines().map(str::trim) {
            if let Some(name) = line.strip_prefix("newmtl ") {
                name.trim().clone_into(&mut material);
            } else if let Some(picture) = line.strip_prefix("map_Kd ") {
                // Options come before the name. Names with spaces are rare.
                let picture = if picture.trim_start().starts_with('-') {
                    picture.rsplit(' ').next().unwrap_or_default()
                } else {
                    picture.trim()
                };
                if self.mesh.textures.len() >= MAX_TEXTURES {
                    return Err(IngestError::malformed(
                        library,
                        format!("more than {MAX_TEXTURES} textures"),
                    ));
                }
                let Some(picture) =
                    sibling_path(&library, picture).filter(|p| root.join(p).is_file())
                else {
                    self.note_missing(picture);
                    continue;
                };
                let mut bytes = Vec::new();
                File::open(root.join(&picture))
                    .and_then(|f| f.take(MAX_TEXTURE_BYTES).read_to_end(&mut bytes))
                    .map_err(|e| IngestError::reading(&picture, e))?;
                let texture = Texture::decode(&bytes).map_err(|e| {
                    IngestError::malformed(&picture, format!("not a readable picture: {e}"))
                })?;
                self.materials.insert(material.clone(), self.mesh.textures.len() as u32);
                self.mesh.textures.push(texture);
                self.mesh.has_color = true;
            }
        }
        Ok(())
    }
}

/// Returns the path of a file that another one names, if it stays inside the upload.
pub(super) fn sibling_path(file: &Utf8Path, name: &str) -> Option<Utf8PathBuf> {
    let name = Utf8Path::new(name);
    let plain =
        name.components().all(|c| matches!(c, Utf8Component::Normal(_) | Utf8Component::CurDir));
    (plain && !name.as_str().is_empty())
        .then(|| file.parent().unwrap_or(Utf8Path::new("")).join(name))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::clouds::{self, CloudBounds, CoordinateOrigin, LoadedCloud};
    use proptest::prelude::*;

    fn read_files(files: &[(&str, &[u8])]) -> Result<LoadedCloud, IngestError> {
        let folder = tempfile::tempdir().unwrap();
        let root = Utf8Path::from_path(folder.path()).unwrap();
        files.iter().for_each(|(name, bytes)| std::fs::write(root.join(name), bytes).unwrap());
        clouds::read(
            root,
            Utf8Path::new("a.obj"),
            &CloudBounds { announced: 1 << 30, kept: 1 << 30 },
            CoordinateOrigin::Free,
        )
    }

    const SQUARE: &str = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n";

    #[test]
    fn a_square_meter_is_sampled_with_ten_thousand_even_points() {
        let loaded = read_files(&[("a.obj", format!("{SQUARE}f 1 2 3 4\n").as_bytes())]).unwrap();
        assert_eq!((loaded.cloud.len(), loaded.has_color), (10_000, false));
        for corner in 0..4 {
            let inside = |p: &&uniground_geometry::Point3<f32>| {
                (p.x > 0.5) == (corner % 2 == 1) && (p.y > 0.5) == (corner / 2 == 1)
            };
            let count = loaded.cloud.positions.iter().filter(inside).count();
            assert!((2350..2650).contains(&count), "{count} in one quarter");
        }
    }

    #[test]
    fn missing_materials_and_textures_are_named() {
        let obj =
            format!("mtllib a.mtl\nmtllib gone.mtl\nusemtl wood\n{SQUARE}f 1/1 2/2 3/3 4/4\n");
        let material = b"newmtl wood\nmap_Kd C:\\Users\\me\\oak.jpg\n";
        let loaded = read_files(&[("a.obj", obj.as_bytes()), ("a.mtl", material)]).unwrap();
        let text = &loaded.findings[0].text;
        assert!(text.starts_with("2 of") && text.ends_with("gone.mtl, oak.jpg"), "{text}");
    }

    #[test]
    fn textures_color_the_sampled_points() {
        let mut png = std::io::Cursor::new(Vec::new());
        let picture = image::RgbImage::from_fn(2, 2, |x, y| {
            if (x, y) == (0, 0) { image::Rgb([255, 0, 0]) } else { image::Rgb([0, 0, 255]) }
        });
        image::DynamicImage::from(picture).write_to(&mut png, image::ImageFormat::Png).unwrap();
        let obj = format!("mtllib a.mtl\nusemtl wood\n{SQUARE}f 1/1 2/2 3/3 4/4\n");
        let loaded = read_files(&[
            ("a.obj", obj.as_bytes()),
            ("a.mtl", b"newmtl wood\nmap_Kd t.png\n"),
            ("t.png", png.get_ref()),
        ])
        .unwrap();
        assert_eq!(loaded.findings, []);
        for (p, c) in loaded.cloud.positions.iter().zip(&loaded.cloud.colors) {
            // The picture's first row is at the top: high y.
            assert_eq!(*c, if p.x < 0.5 && p.y > 0.5 { [255, 0, 0] } else { [0, 0, 255] }, "{p}");
        }
    }

    #[test]
    fn invalid_files_are_refused_with_the_reason() {
        for (text, expected) in [
            ("v 1 2\n", "line 1"),
            ("v 1 2 3\nf 1 2 3\n", "line 2"),
            ("v 0 0 0\nf 1 1 1\n", "no area"),
            ("# nothing\n", "no points"),
        ] {
            let message = read_files(&[("a.obj", text.as_bytes())]).unwrap_err().to_string();
            assert!(message.contains(expected), "{message}");
        }
        let outside =
            read_files(&[("a.obj", format!("mtllib ../../etc/passwd\n{SQUARE}").as_bytes())])
                .unwrap();
        assert_eq!(outside.cloud.len(), 4, "material files outside the upload are ignored");
    }

    proptest! {
        #[test]
        fn random_text_never_panics(text in "(v|vt|f|usemtl|mtllib)?[-0-9 ./a\\n]{0,200}") {
            let _ = read_files(&[("a.obj", text.as_bytes())]);
        }
    }
}
