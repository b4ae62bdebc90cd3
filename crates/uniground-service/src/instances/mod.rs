//! Instances as callers of the API see them, and their evidence pictures.

mod graph;

pub use graph::write_graph;

use super::answers::StoredScene;
use super::parses::LoadedParse;
use crate::error::Error;
use crate::{MediaService, ParsedScenes, QuestionPermits, SceneLookup};
use bytes::Bytes;
use std::sync::Arc;
use uniground_geometry::scene::{Instance, InstanceId};
use uniground_parsing::evidence::Picture;
use uniground_storage::PinnedPath;
use uniground_types::instances::{InstanceList, InstanceView, Levels, ViewPicture};

/// A picture of an instance.
pub enum EvidenceFile {
    /// A stored JPEG file.
    Stored(PinnedPath),
    /// The bytes of a JPEG file that was drawn on request.
    Drawn(Bytes),
}

/// Converts an instance to the form that callers see.
fn to_view(
    instance: Instance,
    model_name: Option<String>,
    given_name: Option<String>,
    last_seen: Option<String>,
) -> InstanceView {
    let label = instance.label().to_owned();
    let Instance {
        id,
        level,
        things,
        aabb,
        raw_box,
        oriented_box,
        point_count,
        mean_rgb,
        colors,
        planarity,
        structure,
        support,
        height_above_floor_m,
        views,
        names,
        given_name: _, // returned as the label
        found_for,
        merged_from,
        dismissed,
        gone,
    } = instance;
    let colours = colors
        .dominant()
        .into_iter()
        .map(|(name, share)| (name.as_str().to_owned(), share))
        .collect();
    InstanceView {
        id,
        level,
        things,
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
        model_name: model_name.filter(|name| !name.is_empty()),
        given_name,
        dismissed,
        gone,
        merged_from,
        found_for,
        last_seen,
        views,
    }
}

/// Returns the instances of a parsed scene and their pictures.
#[derive(Clone)]
pub struct InstanceService {
    pub(crate) scene_lookup: Arc<SceneLookup>,
    pub(crate) parsed_scenes: Arc<ParsedScenes>,
    pub(crate) question_permits: QuestionPermits,
    pub(crate) media_service: Arc<MediaService>,
}

impl InstanceService {
    /// Lists the instances of the current parse at these levels in order of id, starting after
    /// `cursor`.
    ///
    /// # Errors
    /// [`Error::SceneNotFound`], [`Error::SceneNotReady`].
    pub async fn instances(
        &self,
        scene_id: &str,
        levels: Levels,
        limit: u32,
        cursor: u32,
    ) -> Result<InstanceList, Error> {
        let (_, parse_id) = self.scene_lookup.ready_scene(scene_id).await?;
        let parse = self.parsed_scenes.loaded_parse(&parse_id).await?;
        let listed = parse
            .instances
            .iter()
            .filter(|i| i.id.0 > cursor && levels.includes(i.level, i.dismissed));
        let mut page = self.to_views(&parse, listed.take(limit as usize + 1)).await?;
        let more = page.len() > limit as usize;
        page.truncate(limit as usize);
        Ok(InstanceList {
            next_cursor: page.last().filter(|_| more).map(|i| i.id.0),
            instances: page,
        })
    }

    /// Returns all instances of a parse in order of id, except those that were dismissed.
    pub(super) async fn visible_instances(
        &self,
        parse: &LoadedParse,
    ) -> Result<Vec<InstanceView>, Error> {
        self.to_views(parse, parse.instances.iter().filter(|instance| !instance.dismissed)).await
    }

    /// Converts instances to views with the names they were given.
    async fn to_views<'a>(
        &self,
        parse: &LoadedParse,
        instances: impl Iterator<Item = &'a Instance>,
    ) -> Result<Vec<InstanceView>, Error> {
        let mut names = self.parsed_scenes.names_of(&parse.id).await?;
        let view = |instance: &Instance| {
            let (name, given) =
                (names.remove(&instance.id.0), parse.renamed.get(&instance.id.0).cloned());
            to_view(instance.clone(), name, given, parse.last_seen(instance.id))
        };
        Ok(instances.map(view).collect())
    }

    /// # Errors
    /// [`Error::SceneNotFound`], [`Error::SceneNotReady`], [`Error::InstanceNotFound`].
    pub async fn instance(&self, scene_id: &str, id: InstanceId) -> Result<InstanceView, Error> {
        let (parse, instance) = self.find_instance(scene_id, id).await?;
        let name = self.parsed_scenes.names_of(&parse.id).await?.remove(&id.0);
        Ok(to_view(instance, name, parse.renamed.get(&id.0).cloned(), parse.last_seen(id)))
    }

    /// Returns an evidence picture.
    ///
    /// # Errors
    /// [`Error::ViewNotFound`] and those of [`instance`](Self::instance).
    pub async fn view_picture(
        &self,
        scene_id: &str,
        id: InstanceId,
        view: u32,
        picture: ViewPicture,
    ) -> Result<EvidenceFile, Error> {
        let (parse, instance) = self.find_instance(scene_id, id).await?;
        let views = instance.views.len();
        if view as usize >= views {
            return Err(Error::ViewNotFound { id, view, views });
        }
        let picture = match picture {
            ViewPicture::Frame => Picture::Frame,
            ViewPicture::Crop => Picture::Crop,
        };
        let scene = StoredScene::new(self.parsed_scenes.clone(), parse);
        let drawn =
            self.media_service.view_of_instance(scene, &instance, view as usize, picture).await?;
        drawn.ok_or(Error::ViewNotFound { id, view, views })
    }

    /// Returns an instance of a scene's current parse, with the parse.
    async fn find_instance(
        &self,
        scene_id: &str,
        id: InstanceId,
    ) -> Result<(Arc<LoadedParse>, Instance), Error> {
        let (_, parse_id) = self.scene_lookup.ready_scene(scene_id).await?;
        let parse = self.parsed_scenes.loaded_parse(&parse_id).await?;
        match parse.instances.get((id.0 as usize).wrapping_sub(1)).cloned() {
            Some(instance) => Ok((parse, instance)),
            None => Err(Error::InstanceNotFound { scene_id: scene_id.into(), id }),
        }
    }
}
