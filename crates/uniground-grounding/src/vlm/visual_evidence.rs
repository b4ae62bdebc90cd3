//! Collects the pictures for a model: the global render and a collage of every candidate.

use super::{Ablation, EvidenceMode, Options, PromptContext, PromptVersion, naming};
use crate::Seen;
use crate::scene_source::SceneSource;
use image::{RgbImage, imageops};
use rayon::prelude::*;
use std::collections::BTreeMap;
use uniground_geometry::boxes::Aabb;
use uniground_geometry::scene::{FrameIndex, InstanceId};
use uniground_models::chat::Picture;
use uniground_parsing::pointed::{PhotographPoint, PixelArea};
use uniground_render::{
    Collage, GlobalView, ROOM_VIEW, RenderScene, Shot, draw_scene, encode_jpeg,
};

/// Pictures for one question. Any may be missing: a scene without points has no render.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct VisualEvidence {
    /// The global render: all views in one picture. `None` without points or candidates, or where an
    /// ablation leaves it out.
    pub global: Option<Picture>,
    /// Collages by id, of candidates and of anchors that are shown beside them.
    pub collages: BTreeMap<u32, Picture>,
    /// Contact sheets, each with the ids on it; sent instead of collages.
    pub sheets: Vec<(Picture, Vec<u32>)>,
    /// Photographs in which the target may be visible, where the candidates do not fit it.
    pub photographs: Vec<Photograph>,
}

/// An original photograph that is offered because it may show the target.
#[derive(Debug, Clone, PartialEq)]
pub struct Photograph {
    /// The frame of the photograph.
    pub frame: FrameIndex,
    /// Width and height of the frame's picture, pixels.
    pub taken_px: (u32, u32),
    /// The same picture, or a smaller copy.
    pub picture: Picture,
}

/// Sizes of pictures. Pictures cost money: a provider charges by the tile.
#[derive(Debug, Clone, PartialEq)]
pub struct PictureSettings {
    /// The picture of the whole room.
    pub global: Global,
    /// Size and number of photographs of a candidate's collage; `None` where contact sheets replace
    /// collages.
    pub collage: Option<Collage>,
}

/// A picture of the whole room.
#[derive(Debug, Clone, PartialEq)]
pub enum Global {
    /// Views from several sides with boxes, IDs and direction words.
    Views(GlobalView),
    /// One view without annotations.
    Raw,
}

impl PictureSettings {
    /// Returns large pictures where a model has nothing else, smaller and fewer ones where names
    /// help.
    #[must_use]
    pub fn of(options: Options) -> Self {
        let settings = match options.evidence {
            EvidenceMode::Full | EvidenceMode::TwoStep | EvidenceMode::Photographs => Sizes::full(),
            EvidenceMode::CachedNames => Sizes::frugal(),
            EvidenceMode::Sheet => Sizes { collage: None, ..Sizes::full() },
        };
        let global = match (options.ablation, options.prompt) {
            (Ablation::RawRender, _) => Global::Raw,
            (_, PromptVersion::Paper) => {
                Global::Views(GlobalView { view_px: settings.strip_px, ..GlobalView::default() })
            }
            (_, PromptVersion::Revised) => Global::Views(GlobalView::square(settings.square_px)),
        };
        Self { global, collage: settings.collage }
    }
}

/// Sizes of an evidence mode.
struct Sizes {
    /// Side of each of the paper's three views.
    strip_px: u32,
    /// Side of each of four views in two rows.
    square_px: u32,
    collage: Option<Collage>,
}

impl Sizes {
    /// Paper: three views of 680 x 680 pixels, collages of three pairs.
    fn full() -> Self {
        Self { strip_px: 680, square_px: 560, collage: Some(Collage::default()) }
    }

    /// For use with names: small views, and one photograph of a candidate.
    fn frugal() -> Self {
        let collage = Some(Collage { max_shots: 1, ..Collage::default() });
        Self { strip_px: 508, square_px: 380, collage }
    }
}

/// Returns all pictures that a question may need; cached ones are not rendered again.
///
/// # Errors
/// The cloud cannot be read.
pub fn collect<S: SceneSource>(
    source: &S,
    context: &PromptContext,
    settings: &PictureSettings,
) -> Result<VisualEvidence, S::Error> {
    let (cache, scene) = source.pictures();
    let key_of_global = match &settings.global {
        Global::Views(view) => format!("{scene} {view:?} {:?}", context.subjects()),
        Global::Raw => format!("{scene} raw"),
    };
    // The key has the box too: an instance found for one question alone may have the same id as one
    // found for another.
    let key = |id: u32| {
        format!("{scene} {id} {:?} {:?}", context.boxes.get(id as usize - 1), settings.collage)
    };
    let mut evidence =
        VisualEvidence { global: cache.globals.get(&key_of_global), ..VisualEvidence::default() };
    let mut missing = Vec::new();
    for id in context.shown() {
        match cache.collages.get(&key(id.0)).filter(|_| settings.collage.is_some()) {
            Some(known) => drop(evidence.collages.insert(id.0, known)),
            None => missing.push(id),
        }
    }
    if evidence.global.is_some() && missing.is_empty() {
        return Ok(evidence);
    }
    let render_scene = source.render_scene()?;
    let (global, drawn) = rayon::join(
        || match evidence.global.take() {
            None => draw_global(context, &render_scene, &source.extent(), &settings.global),
            known => known,
        },
        || match settings.collage {
            Some(collage) => Ok((
                draw_collages(
                    &missing,
                    |id| source.shots(id, collage.max_shots, &render_scene),
                    collage,
                ),
                Vec::new(),
            )),
            None => contact_sheets(source, &missing).map(|sheets| (BTreeMap::new(), sheets)),
        },
    );
    let (collages, sheets) = drawn?;
    evidence.sheets = sheets;
    if let Some(picture) = &global {
        cache.globals.put(key_of_global, picture.clone(), picture.jpeg.len());
    }
    evidence.global = global;
    for (id, collage) in collages {
        cache.collages.put(key(id), collage.clone(), collage.jpeg.len());
        evidence.collages.insert(id, collage);
    }
    Ok(evidence)
}

impl VisualEvidence {
    /// Converts a place in a picture that the model was shown to a place in a photograph; `None`
    /// where the picture shows no photograph there.
    ///
    /// # Errors
    /// The cloud cannot be read.
    pub fn place<S: SceneSource>(
        &self,
        source: &S,
        seen: &Seen,
        settings: &PictureSettings,
    ) -> Result<Option<PhotographPoint>, S::Error> {
        let share =
            |(width, height): (u32, u32)| (seen.at[0] * width as f32, seen.at[1] * height as f32);
        if let Some(Photograph { frame, taken_px, .. }) =
            self.photographs.iter().find(|offered| offered.picture.name == seen.picture)
        {
            let (width, height) = (taken_px.0 as f32, taken_px.1 as f32);
            let area = seen.area.map(|[left, top, right, bottom]| PixelArea {
                left: left * width,
                top: top * height,
                right: right * width,
                bottom: bottom * height,
            });
            return Ok(Some(PhotographPoint { frame: *frame, at: share(*taken_px), area }));
        }
        let of_candidate = self.collages.iter().find(|(_, picture)| picture.name == seen.picture);
        let of_sheet = self.sheets.iter().find(|(picture, _)| picture.name == seen.picture);
        let (picture, tiles) = match (of_candidate, settings.collage, of_sheet) {
            (Some((&id, picture)), Some(collage), _) => {
                let shots =
                    source.shots(InstanceId(id), collage.max_shots, &*source.render_scene()?);
                (picture, collage.tiles(&shots))
            }
            (_, _, Some((picture, ids))) => {
                let ids: Vec<InstanceId> = ids.iter().copied().map(InstanceId).collect();
                (picture, naming::tiles(source, &ids)?)
            }
            _ => return Ok(None),
        };
        let (width, height) = (picture.width as f32, picture.height as f32);
        let at = share((picture.width, picture.height));
        Ok(tiles.iter().find_map(|tile| {
            let area = seen.area.map(|[left, top, right, bottom]| {
                let corner = |x: f32, y: f32| tile.nearest_in_photograph((x * width, y * height));
                let ((left, top), (right, bottom)) = (corner(left, top), corner(right, bottom));
                PixelArea { left, top, right, bottom }
            });
            Some(PhotographPoint { frame: tile.frame, at: tile.to_photograph(at)?, area })
        }))
    }
}

/// Renders the global picture of a question; `None` where there are no points or no candidates.
fn draw_global(
    context: &PromptContext,
    render_scene: &RenderScene,
    extent: &Aabb,
    global: &Global,
) -> Option<Picture> {
    if render_scene.cloud.is_empty() || context.candidates.is_empty() {
        return None;
    }
    let picture = match global {
        Global::Views(view) => view.draw(render_scene, extent, &context.subjects()),
        Global::Raw => draw_scene(render_scene, extent, &ROOM_VIEW, &[]),
    };
    Some(encoded("global".into(), &picture))
}

/// Returns one photograph of each instance, on as few sheets as possible.
///
/// # Errors
/// The cloud cannot be read.
pub fn contact_sheets<S: SceneSource>(
    source: &S,
    ids: &[InstanceId],
) -> Result<Vec<(Picture, Vec<u32>)>, S::Error> {
    let sheets = ids.chunks(naming::PER_SHEET).zip(1..);
    sheets
        .filter_map(|(ids, number)| {
            naming::contact_sheet(source, format!("sheet-{number}"), ids).transpose()
        })
        .collect()
}

/// Returns a collage of each instance, from its photographs.
fn draw_collages(
    of: &[InstanceId],
    shots: impl Fn(InstanceId) -> Vec<Shot> + Sync,
    collage: Collage,
) -> BTreeMap<u32, Picture> {
    of.par_iter()
        .map(|&id| (id.0, encoded(format!("candidate-{id}"), &collage.draw(id.0, &shots(id)))))
        .collect()
}

/// Returns a picture of at most `most_px` along its longer side.
pub(super) fn shrink(picture: RgbImage, most_px: u32) -> RgbImage {
    let (width, height) = picture.dimensions();
    let longer = width.max(height);
    if longer <= most_px {
        return picture;
    }
    let scaled = |length: u32| (length * most_px).div_ceil(longer).max(1);
    imageops::resize(&picture, scaled(width), scaled(height), imageops::FilterType::Triangle)
}

pub(super) fn encoded(name: String, picture: &RgbImage) -> Picture {
    let (width, height) = picture.dimensions();
    Picture { name, jpeg: encode_jpeg(picture).into(), width, height }
}
