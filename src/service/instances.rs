//! Instances as the outside sees them, and their evidence pictures.

use super::Service;
use super::parsing::view_file;
use crate::error::Error;
use crate::geometry::boxes::{Aabb, OrientedBox};
use crate::scene::{Instance, InstanceId, NameGuess, Structure, Support, View};
use crate::scene_parsing::evidence::Picture;
use camino::Utf8PathBuf;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use utoipa::ToSchema;

/// One object candidate. Lengths in metres, world frame (Z up).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct InstanceView {
    pub id: InstanceId,
    /// What the encoder would call it, without having heard a question.
    pub label: String,
    /// Axis-aligned box of the robust bounds.
    #[serde(rename = "box")]
    pub aabb: Aabb,
    /// Axis-aligned box of every point, strays included.
    pub raw_box: Aabb,
    pub oriented_box: OrientedBox,
    pub point_count: u32,
    /// Mean 8-bit sRGB.
    pub mean_rgb: [u8; 3],
    /// Share of the points per colour name, those of 10 % and more.
    pub colours: BTreeMap<String, f32>,
    /// Share of the points within 3 cm of the best plane.
    pub planarity: f32,
    /// Set for parts of the building.
    pub structure: Option<Structure>,
    pub support: Support,
    pub height_above_floor_m: f32,
    pub names: Vec<NameGuess>,
    /// What the configured vision-language model calls it, without having heard a question; `null` until it was asked.
    #[serde(default)]
    pub model_name: Option<String>,
    /// Frames that show it best; pictures at `/instances/{id}/views/{k}.jpg`, k from 0.
    pub views: Vec<View>,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct InstanceList {
    /// In order of id.
    pub instances: Vec<InstanceView>,
    /// Pass as `cursor` for the next page; `null` on the last.
    pub next_cursor: Option<u32>,
}

/// Which picture of a view.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum ViewPicture {
    /// The full frame with a red box.
    #[default]
    Frame,
    /// A tight crop.
    Crop,
}

impl From<Instance> for InstanceView {
    fn from(instance: Instance) -> Self {
        let label = instance.label().to_owned();
        let Instance {
            id,
            aabb,
            raw_box,
            oriented_box,
            point_count,
            mean_rgb,
            colours,
            planarity,
            structure,
            support,
            height_above_floor_m,
            views,
            names,
            given_name: _, // told as the label
        } = instance;
        let colours = colours.dominant().into_iter().map(|(name, share)| (name.word().to_owned(), share)).collect();
        Self {
            id,
            label,
            aabb,
            raw_box,
            oriented_box,
            point_count,
            mean_rgb,
            colours,
            planarity,
            structure,
            support,
            height_above_floor_m,
            names,
            model_name: None,
            views,
        }
    }
}

impl Service {
    /// Instances of the current parse in order of id, those after `cursor` only.
    ///
    /// # Errors
    /// [`Error::SceneNotFound`], [`Error::SceneNotReady`].
    pub async fn instances(&self, scene_id: &str, limit: u32, cursor: u32) -> Result<InstanceList, Error> {
        let (_, parse_id) = self.ready_scene(scene_id).await?;
        let (parse, mut names) = (self.loaded_parse(&parse_id).await?, self.names_of(&parse_id).await?);
        let page = parse.instances.iter().filter(|i| i.id.0 > cursor).take(limit as usize + 1).cloned();
        let named = |instance: Instance| InstanceView {
            model_name: names.remove(&instance.id.0).filter(|name| !name.is_empty()),
            ..instance.into()
        };
        let mut page: Vec<InstanceView> = page.map(named).collect();
        let more = page.len() > limit as usize;
        page.truncate(limit as usize);
        Ok(InstanceList { next_cursor: page.last().filter(|_| more).map(|i| i.id.0), instances: page })
    }

    /// # Errors
    /// [`Error::SceneNotFound`], [`Error::SceneNotReady`], [`Error::InstanceNotFound`].
    pub async fn instance(&self, scene_id: &str, id: InstanceId) -> Result<InstanceView, Error> {
        let (parse_id, instance) = self.stored_instance(scene_id, id).await?;
        let model_name = self.names_of(&parse_id).await?.remove(&id.0).filter(|name| !name.is_empty());
        Ok(InstanceView { model_name, ..instance.into() })
    }

    /// Path of an evidence picture.
    ///
    /// # Errors
    /// [`Error::ViewNotFound`] and those of [`instance`](Self::instance).
    pub async fn view_picture(&self, scene_id: &str, id: InstanceId, view: u32, picture: ViewPicture) -> Result<Utf8PathBuf, Error> {
        let (parse_id, instance) = self.stored_instance(scene_id, id).await?;
        let views = instance.views.len();
        if view as usize >= views {
            return Err(Error::ViewNotFound { id, view, views });
        }
        let picture = match picture {
            ViewPicture::Frame => Picture::Frame,
            ViewPicture::Crop => Picture::Crop,
        };
        Ok(self.store.blobs.parse(&parse_id).join("views").join(view_file(id.0, view as usize, picture)))
    }

    /// An instance of a scene's current parse, and the parse's id.
    async fn stored_instance(&self, scene_id: &str, id: InstanceId) -> Result<(String, Instance), Error> {
        let (_, parse_id) = self.ready_scene(scene_id).await?;
        match self.store.instance(&parse_id, id).await? {
            Some(instance) => Ok((parse_id, instance)),
            None => Err(Error::InstanceNotFound { scene_id: scene_id.into(), id }),
        }
    }
}
