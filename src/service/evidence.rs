//! The pictures a model is shown of a stored parse.

use super::cache::{Caches, LoadedParse};
use super::parsing::view_file;
use crate::error::Error;
use crate::grounding::vlm::{self, Brief, Exhibits, PictureSettings, collages, naming};
use crate::ingest;
use crate::models::chat::Picture as ChatPicture;
use crate::render::{Scenery, Shot, close_ups};
use crate::scene::{Instance, InstanceId};
use crate::scene_parsing::evidence::Picture;
use camino::{Utf8Path, Utf8PathBuf};
use std::fs;
use std::sync::Arc;

/// A parse and where its files lie.
pub(super) struct Stored<'a> {
    pub parse_id: &'a str,
    pub parse: &'a LoadedParse,
    pub folder: Utf8PathBuf,
    pub caches: &'a Caches,
}

/// Photographs per candidate. Paper: 3.
const MAX_SHOTS: usize = 3;

impl Stored<'_> {
    /// All pictures a question may need; what was drawn before is not drawn again.
    pub fn exhibits(&self, brief: &Brief, settings: &PictureSettings) -> Result<Exhibits, Error> {
        let key = format!("{} {} {:?}", self.parse_id, settings.global.view_px, brief.subjects());
        let mut global = self.caches.globals.get(&key);
        if global.is_none() {
            global = vlm::global(brief, &*self.scenery()?, &self.parse.extent, &settings.global);
            if let Some(picture) = &global {
                self.caches.globals.put(key, picture.clone(), picture.jpeg.len());
            }
        }
        let key = |id: u32| format!("{} {id} {:?}", self.parse_id, settings.collage);
        let mut exhibits = Exhibits { global, ..Exhibits::default() };
        let mut missing = Vec::new();
        for candidate in &brief.candidates {
            match self.caches.collages.get(&key(candidate.id.0)) {
                Some(known) => drop(exhibits.collages.insert(candidate.id.0, known)),
                None => missing.push(candidate.id),
            }
        }
        if missing.is_empty() {
            return Ok(exhibits);
        }
        let scenery = self.scenery()?;
        for (id, collage) in collages(&missing, |id| self.shots(id, &scenery), settings.collage) {
            self.caches.collages.put(key(id), collage.clone(), collage.jpeg.len());
            exhibits.collages.insert(id, collage);
        }
        Ok(exhibits)
    }

    /// A sheet of up to [`naming::PER_SHEET`] instances to be named.
    pub fn sheet(&self, number: usize, ids: &[InstanceId]) -> Result<ChatPicture, Error> {
        let scenery = self.scenery()?;
        let shots: Vec<_> = ids.iter().filter_map(|&id| Some((id, self.shots(id, &scenery).into_iter().next()?))).collect();
        Ok(naming::sheet(number, &shots))
    }

    fn instance(&self, id: InstanceId) -> Option<&Instance> {
        self.parse.instances.get((id.0 as usize).checked_sub(1)?)
    }

    /// Photographs of an instance, or views of the cloud where there are none.
    fn shots(&self, id: InstanceId, scenery: &Scenery) -> Vec<Shot> {
        let Some(instance) = self.instance(id) else { return Vec::new() };
        let views = instance.views.iter().take(MAX_SHOTS).enumerate();
        let shots: Vec<Shot> = views.filter_map(|(k, view)| shot(&self.folder.join("views"), id, k, view.box_px)).collect();
        if shots.is_empty() { close_ups(scenery, &instance.aabb) } else { shots }
    }

    pub fn scenery(&self) -> Result<Arc<Scenery>, Error> {
        if let Some(known) = self.caches.sceneries.get(self.parse_id) {
            return Ok(known);
        }
        let scenery = Arc::new(Scenery::of(ingest::read_cloud(&self.folder.join("cloud.ply"))?));
        self.caches.sceneries.put(self.parse_id.to_owned(), scenery.clone(), scenery.cloud.len());
        Ok(scenery)
    }
}

/// A stored view. One that can not be read is left out: the others still show the thing.
fn shot(views: &Utf8Path, id: InstanceId, view: usize, box_px: [u32; 4]) -> Option<Shot> {
    let read = |picture| {
        let file = views.join(view_file(id.0, view, picture));
        let decoded = fs::read(&file)
            .map_err(|e| e.to_string())
            .and_then(|bytes| image::load_from_memory(&bytes).map_err(|e| e.to_string()));
        decoded
            .map(image::DynamicImage::into_rgb8)
            .inspect_err(|error| tracing::warn!(%file, error, "an evidence picture can not be read"))
            .ok()
    };
    Some(Shot::new(read(Picture::Crop)?, read(Picture::Frame)?, box_px))
}
