//! Names that do not depend on any question: requested once, from photographs alone, and stored.

use super::reply;
use super::visual_evidence::encoded;
use crate::GivenName;
use crate::scene_source::SceneSource;
use std::collections::BTreeMap;
use uniground_geometry::scene::InstanceId;
use uniground_models::chat::{ChatRequest, Part, Picture};
use uniground_render::{Shot, Tile, draw_mosaic, mosaic_tiles};

/// Version of the naming prompt. Raising it makes models name all instances again.
pub const NAMING_VERSION: u32 = 2;

/// Returns name and version of a model as it names instances, recorded with answers.
#[must_use]
pub fn namer(model: &str) -> String {
    format!("{model} (naming {NAMING_VERSION})")
}

/// Instances on one sheet: 4 x 3 tiles of 256 pixels are four of a provider's tiles.
pub const PER_SHEET: usize = 12;
const COLUMNS: u32 = 4;
const TILE_PX: u32 = 256;

const SYSTEM: &str = "You name objects in photographs.";
/// Longer names are descriptions, and are ignored.
const MAX_NAME_CHARS: usize = 80;

/// An instance that covers fewer pixels of its best photograph cannot be named.
const LEAST_PX: f32 = 12.0 * 12.0;

/// Returns a sheet of instances to be named, and the ids on it: those that are visible enough.
/// `None` where none is.
///
/// # Errors
/// The cloud cannot be read.
pub fn sheet_of<S: SceneSource>(
    source: &S,
    number: usize,
    ids: &[InstanceId],
) -> Result<Option<(Picture, Vec<u32>)>, S::Error> {
    contact_sheet(source, format!("names-{number}"), ids)
}

/// Returns a sheet of this name with one photograph of each instance, and the ids on it.
pub(super) fn contact_sheet<S: SceneSource>(
    source: &S,
    name: String,
    ids: &[InstanceId],
) -> Result<Option<(Picture, Vec<u32>)>, S::Error> {
    if ids.is_empty() {
        return Ok(None);
    }
    let shots = shots_of(source, ids)?;
    let seen = shots.iter().map(|(id, _)| id.0).collect();
    Ok((!shots.is_empty()).then(|| (sheet(name, &shots), seen)))
}

/// Returns where the photographs are on the sheet of these instances, all of which are on it.
pub(super) fn tiles<S: SceneSource>(source: &S, ids: &[InstanceId]) -> Result<Vec<Tile>, S::Error> {
    let shots = shots_of(source, ids)?;
    let shots: Vec<&Shot> = shots.iter().map(|(_, shot)| shot).collect();
    Ok(mosaic_tiles(&shots, columns(shots.len()), TILE_PX))
}

/// Returns one photograph of each instance that is visible enough.
fn shots_of<S: SceneSource>(
    source: &S,
    ids: &[InstanceId],
) -> Result<Vec<(InstanceId, Shot)>, S::Error> {
    let render_scene = source.render_scene()?;
    let shots = ids
        .iter()
        .filter_map(|&id| Some((id, source.shots(id, 1, &render_scene).into_iter().next()?)));
    Ok(shots.filter(|(_, shot)| shot.covered_px() >= LEAST_PX).collect())
}

fn columns(tiles: usize) -> u32 {
    COLUMNS.min(tiles as u32)
}

fn sheet(name: String, shots: &[(InstanceId, Shot)]) -> Picture {
    let tiles: Vec<_> = shots.iter().map(|(id, shot)| (id.0, shot)).collect();
    encoded(name, &draw_mosaic(&tiles, columns(tiles.len()), TILE_PX))
}

/// Returns the request for one sheet.
#[must_use]
pub fn request(sheet: Picture, ids: &[u32]) -> ChatRequest {
    let list = ids.iter().map(|id| format!("ID {id}")).collect::<Vec<_>>().join(", ");
    let text = format!(
        "The image shows one object per tile, cut from pictures of a room, each under its ID: {list}. Give each a descriptive name of \
         three to eight words: the noun, with its colour, material or shape. Name what the yellow line runs around, or where there is \
         none what fills the middle; the rest of a tile only shows where it is. A wall, floor or ceiling, or a piece of one, is \
         \"structure: \" and its name. What is only a part of a thing is \"part of \" and that thing's name. Say \"unclear\" where you \
         can not tell, and \"not a thing\" where there is none. Answer with one line per object, nothing else:
ID -> name"
    );
    ChatRequest {
        system: SYSTEM.into(),
        user: vec![Part::Picture(sheet), Part::Text(text)],
        schema: None,
    }
}

/// Returns the names in a reply, of the requested ids. An id that the reply skips gets the name "":
/// the model is not asked about it again, and its photographs are shown instead.
#[must_use]
pub fn read(text: &str, ids: &[u32]) -> BTreeMap<u32, String> {
    let mut names = reply::names_in(text);
    names.retain(|id, name| ids.contains(id) && name.chars().count() <= MAX_NAME_CHARS);
    // A reply that the object is unclear is no name.
    names.values_mut().filter(|name| GivenName::read(name).is_none()).for_each(String::clear);
    if !names.is_empty() {
        for id in ids {
            names.entry(*id).or_default();
        }
    }
    names
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn naming_reply_is_read_for_requested_ids_only() {
        let text = "<think>1 -> no</think>Here you are:\n**ID 1** -> red two-seat sofa\n- 2: white door\nID 9 -> a ghost\n3 -> ";
        assert_eq!(
            read(text, &[1, 2, 3]),
            BTreeMap::from([
                (1, "red two-seat sofa".to_owned()),
                (2, "white door".to_owned()),
                (3, String::new())
            ])
        );
        assert!(read("I can not.", &[1]).is_empty());
        assert!(read(&format!("1 -> {}", "long ".repeat(40)), &[1]).is_empty());
    }
}
