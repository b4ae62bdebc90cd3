//! Exports a scene with its instances as a file.

use crate::answers::StoredScene;
use crate::error::Error;
use crate::{InstanceService, MediaService, ParsedScenes, SceneLookup};
use sha2::{Digest, Sha256};
use std::io::Cursor;
use std::sync::Arc;
use uniground_export::{Export, write_glb, write_ply, write_usdz};
use uniground_grounding::pipeline::SceneSource;
use uniground_types::answer::CoordinateFrame;
use uniground_types::export::{ExportFormat, ExportedScene, MAX_POINTS};

/// An exported scene.
pub struct ExportFile {
    /// The file name. Contains only letters, digits and `-_.`.
    pub name: String,
    pub bytes: Vec<u8>,
    /// A hash of the bytes. Different bytes have a different fingerprint.
    pub fingerprint: String,
}

/// Exports scenes in the formats of other programs.
#[derive(Clone)]
pub struct ExportService {
    pub(crate) scene_lookup: Arc<SceneLookup>,
    pub(crate) parsed_scenes: Arc<ParsedScenes>,
    pub(crate) instance_service: Arc<InstanceService>,
    pub(crate) media_service: Arc<MediaService>,
}

impl ExportService {
    /// Exports a scene's current parse, with corrections applied and at most `points` points.
    ///
    /// # Errors
    /// [`Error::SceneNotFound`], [`Error::SceneNotReady`], [`Error::ParseDamaged`];
    /// [`Error::Invalid`] if `points` is out of range.
    pub async fn export(
        &self,
        scene_id: &str,
        format: ExportFormat,
        points: u32,
    ) -> Result<ExportFile, Error> {
        if !(1..=MAX_POINTS).contains(&points) {
            return Err(Error::invalid("points", format!("must be 1 to {MAX_POINTS}")));
        }
        let (row, parse_id) = self.scene_lookup.ready_scene(scene_id).await?;
        let parse = self.parsed_scenes.loaded_parse(&parse_id).await?;
        let name = file_name(&row.name, format);
        let listed = ExportedScene {
            scene_id: row.id,
            name: row.name,
            parse_version: u32::try_from(row.parse_version).unwrap_or(0),
            frame: CoordinateFrame::default(),
            instances: match format {
                ExportFormat::Json => self.instance_service.visible_instances(&parse).await?,
                ExportFormat::Glb | ExportFormat::Ply | ExportFormat::Usdz => Vec::new(),
            },
        };
        let scene = StoredScene::new(self.parsed_scenes.clone(), parse);
        // Exports run one at a time, so that only one file is built in memory.
        let made = self.media_service.draw(scene, move |_, scene| {
            let bytes = match format {
                ExportFormat::Json => serde_json::to_vec(&listed)?,
                ExportFormat::Glb | ExportFormat::Ply | ExportFormat::Usdz => {
                    scene.write_export(&listed.name, format, points as usize)?
                }
            };
            let fingerprint =
                Sha256::digest(&bytes).iter().take(12).map(|byte| format!("{byte:02x}")).collect();
            Ok(ExportFile { name, bytes, fingerprint })
        });
        made.await
    }
}

impl StoredScene {
    fn write_export(
        &self,
        title: &str,
        format: ExportFormat,
        points: usize,
    ) -> Result<Vec<u8>, Error> {
        let (render_scene, of_point) = (self.render_scene()?, self.instance_of_point()?);
        let export = Export::new(title, &render_scene.cloud, &of_point, self.instances(), points);
        let mut file = Cursor::new(Vec::new());
        match format {
            ExportFormat::Glb => write_glb(&export, &mut file)?,
            ExportFormat::Ply => write_ply(&export, &mut file)?,
            ExportFormat::Usdz => write_usdz(&export, &mut file)?,
            ExportFormat::Json => {}
        }
        Ok(file.into_inner())
    }
}

/// Returns a scene's name as a file name that is valid on every system.
fn file_name(scene: &str, format: ExportFormat) -> String {
    const MAX_CHARS: usize = 80;
    let safe = |c: char| if c.is_ascii_alphanumeric() || "-_.".contains(c) { c } else { '_' };
    let name: String = scene.chars().take(MAX_CHARS).map(safe).collect();
    // Strips what would make the file hidden, leave only an extension, or look like an option.
    let name = name.trim_matches(['.', '_', '-']);
    format!("{}.{}", if name.is_empty() { "scene" } else { name }, format.extension())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_scene_name_yields_a_valid_file_name() {
        for (name, expected) in [
            ("living room", "living_room.glb"),
            ("../../etc/passwd", "etc_passwd.glb"),
            ("a\"; filename=\"b", "a___filename__b.glb"),
            ("K\u{fc}che 2.1", "K_che_2.1.glb"),
            ("\u{53a8}\u{623f}", "scene.glb"),
        ] {
            assert_eq!(file_name(name, ExportFormat::Glb), expected);
        }
        assert_eq!(file_name(&"x".repeat(500), ExportFormat::Json).len(), 85);
    }
}
