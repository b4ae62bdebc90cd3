//! Masks of a slow source, stored in files: a change of stage 1 is measured in seconds.

use camino::Utf8PathBuf;
use std::fs;
use uniground_geometry::progress::Progress;
use uniground_geometry::scene::Frame;
use uniground_parsing::ParseError;
use uniground_parsing::masks::{IdImage, IdRuns, MaskSource};

/// A mask source whose masks of one room are computed once.
pub struct CachedMasks<'a> {
    pub source: &'a dyn MaskSource,
    /// The folder for the masks of this source and room.
    pub folder: Utf8PathBuf,
}

impl MaskSource for CachedMasks<'_> {
    fn name(&self) -> &str {
        self.source.name()
    }

    fn masks(&self, frame: &Frame, progress: &Progress) -> Result<Vec<IdImage>, ParseError> {
        let file = self.folder.join(format!("{}.json", frame.index.0));
        let stored = fs::read(&file).ok().and_then(|text| serde_json::from_slice(&text).ok());
        if let Some(stored) = stored {
            let stored: Vec<IdRuns> = stored;
            return Ok(stored.iter().map(IdRuns::to_image).collect());
        }
        let found = self.source.masks(frame, progress)?;
        let runs: Vec<IdRuns> = found.iter().map(IdRuns::from_image).collect();
        // What cannot be stored is computed again.
        let _stored = fs::create_dir_all(&self.folder)
            .and_then(|()| fs::write(&file, serde_json::to_vec(&runs).unwrap_or_default()));
        Ok(found)
    }
}
