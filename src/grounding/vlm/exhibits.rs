//! The pictures a model gets: the global render and a collage for every candidate.

use super::{Brief, EvidenceMode};
use crate::geometry::boxes::Aabb;
use crate::models::chat::Picture;
use crate::render::{Collage, GlobalView, Scenery, Shot, jpeg};
use crate::scene::InstanceId;
use image::RgbImage;
use rayon::prelude::*;
use std::collections::BTreeMap;

/// Pictures for one question. Any may be missing: a scene without points has no render.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Exhibits {
    pub global: Option<Picture>,
    /// By candidate's id.
    pub collages: BTreeMap<u32, Picture>,
}

/// How large pictures are. Pictures cost money: a provider charges by the tile.
#[derive(Debug, Clone, PartialEq)]
pub struct PictureSettings {
    pub global: GlobalView,
    pub collage: Collage,
}

impl PictureSettings {
    #[must_use]
    pub fn of(evidence: EvidenceMode) -> Self {
        match evidence {
            EvidenceMode::Full => Self::full(),
            EvidenceMode::CachedNames => Self::frugal(),
        }
    }

    /// Paper: three views of 680 x 680 pixels, collages of three pairs.
    fn full() -> Self {
        Self { global: GlobalView::default(), collage: Collage::default() }
    }

    /// Where names stand for most of the pictures: three views in three tiles, one photograph of a candidate in one.
    fn frugal() -> Self {
        let collage = Collage { max_shots: 1, ..Collage::default() };
        Self { global: GlobalView { view_px: 508, ..GlobalView::default() }, collage }
    }
}

/// The global render of a question; `None` where there are no points or no candidates.
#[must_use]
pub fn global(brief: &Brief, scenery: &Scenery, extent: &Aabb, view: &GlobalView) -> Option<Picture> {
    if scenery.cloud.is_empty() || brief.candidates.is_empty() {
        return None;
    }
    Some(encoded("global".into(), &view.draw(scenery, extent, &brief.subjects())))
}

/// A collage of each instance, from its photographs.
#[must_use]
pub fn collages(of: &[InstanceId], shots: impl Fn(InstanceId) -> Vec<Shot> + Sync, collage: Collage) -> BTreeMap<u32, Picture> {
    of.par_iter()
        .map(|&id| (id.0, encoded(format!("candidate-{id}"), &collage.draw(id.0, &shots(id)))))
        .collect()
}

pub(super) fn encoded(name: String, picture: &RgbImage) -> Picture {
    let (width, height) = picture.dimensions();
    Picture { name, jpeg: jpeg(picture).into(), width, height }
}
