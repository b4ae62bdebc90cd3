//! Computes what changed in a scene: since an earlier version, or between two scans of one room.

use crate::answers::StoredScene;
use crate::error::Error;
use crate::parses::read_frames;
use crate::{MAX_COMPARISONS, ParsedScenes, SceneLookup};
use std::sync::Arc;
use std::time::{Duration, Instant};
use tokio::sync::Semaphore;
use tokio::task::spawn_blocking;
use tokio_util::sync::CancellationToken;
use uniground_geometry::progress::Progress;
use uniground_geometry::scene::{FrameRef, InstanceId, Owners};
use uniground_geometry::{Isometry3, Vector3};
use uniground_grounding::pipeline::SceneSource;
use uniground_parsing::ParseError;
use uniground_parsing::changes::{
    Alignment, Counterparts, RoomState, SAME_PLACE_M, align, compare, match_things,
};
use uniground_render::RenderScene;
use uniground_storage::{PinnedPath, SceneRepository, SceneRow};
use uniground_types::changes::{Changes, ScanAlignment, SceneChanges, SceneVersion};
use uniground_types::placement::SceneToFrame;

/// The timeout of a comparison of two scans.
const COMPARISON_TIMEOUT: Duration = Duration::from_mins(1);
/// The smallest share of the first scan's points that must lie on the second.
const MIN_OVERLAP: f32 = 0.2;

/// Compares two states of a room.
#[derive(Clone)]
pub struct ChangeService {
    pub(crate) scene_repository: SceneRepository,
    pub(crate) scene_lookup: Arc<SceneLookup>,
    pub(crate) comparison_permits: Arc<Semaphore>,
    pub(crate) parsed_scenes: Arc<ParsedScenes>,
}

impl ChangeService {
    /// Returns what changed in a scene that grew, from its version `since` to its current version.
    ///
    /// # Errors
    /// [`Error::SceneNotFound`], [`Error::SceneNotReady`], [`Error::NoVersion`],
    /// [`Error::VersionsApart`] if the scene was parsed again in between and its instances have new
    /// ids.
    pub async fn changes_since(&self, scene_id: &str, since: u32) -> Result<SceneChanges, Error> {
        let (scene, _) = self.scene_lookup.ready_scene(scene_id).await?;
        let now = version(&scene);
        if since == 0 || since > now.version {
            return Err(Error::NoVersion {
                id: scene_id.to_owned(),
                asked: since,
                version: now.version,
            });
        }
        let known = self.scene_repository.scene_changes(scene_id, since).await?;
        let (mut changes, mut next) = (Changes::default(), now.version);
        // Walks back from the newest version. Where a version has no stored changes, the instances
        // of earlier versions have other ids.
        for (version, _) in known.iter().rev() {
            if *version != next {
                break;
            }
            next -= 1;
        }
        if next > since {
            return Err(Error::VersionsApart { since, renumbered: next });
        }
        for (_, later) in known {
            changes = changes.followed_by(later);
        }
        Ok(SceneChanges {
            from: SceneVersion { scene_id: scene_id.to_owned(), version: since },
            to: now,
            alignment: None,
            changes,
        })
    }

    /// Returns what differs between a scene and another scan of the same room.
    ///
    /// The initial alignment comes from the poses of both scenes in the same map. Without a shared
    /// map, both scans are assumed to use the same world coordinates. `refine` aligns the two
    /// clouds, starting from there.
    ///
    /// The number of concurrent comparisons and their duration are limited. A comparison is
    /// cancelled when the caller disconnects.
    ///
    /// # Errors
    /// [`Error::SceneNotFound`], [`Error::SceneNotReady`], [`Error::ScansApart`];
    /// [`Error::TooMany`], [`Error::ComparisonTimedOut`].
    pub async fn changes_to(
        &self,
        scene_id: &str,
        to_id: &str,
        refine: bool,
    ) -> Result<SceneChanges, Error> {
        let permit = self.comparison_permits.clone().try_acquire_owned();
        let permit = permit
            .map_err(|_| Error::TooMany { what: "comparisons of scans", most: MAX_COMPARISONS })?;
        let (from_row, from) = self.stored_scene(scene_id).await?;
        let (to_row, to) = self.stored_scene(to_id).await?;
        let guess = transform_between_maps(&from_row, &to_row);
        let (caller_left, deadline) =
            (CancellationToken::new(), Instant::now() + COMPARISON_TIMEOUT);
        let _caller = caller_left.clone().drop_guard();
        let progress = Progress::new(
            |_, _| {},
            move || caller_left.is_cancelled() || Instant::now() >= deadline,
        );
        let compared = spawn_blocking(move || {
            let _permit = permit;
            compare_scenes(&from, &to, &guess, refine, &progress)
        });
        let (alignment, changes) = match compared.await? {
            Ok(compared) => compared,
            Err(Error::Parse(ParseError::Cancelled(_))) => {
                return Err(Error::ComparisonTimedOut { seconds: COMPARISON_TIMEOUT.as_secs() });
            }
            Err(error) => return Err(self.parsed_scenes.retire_if_damaged(error).await),
        };
        Ok(SceneChanges {
            from: version(&from_row),
            to: version(&to_row),
            alignment: Some(alignment),
            changes,
        })
    }

    async fn stored_scene(&self, id: &str) -> Result<(SceneRow, Arc<StoredScene>), Error> {
        let (row, parse_id) = self.scene_lookup.ready_scene(id).await?;
        Ok((
            row,
            StoredScene::new(
                self.parsed_scenes.clone(),
                self.parsed_scenes.loaded_parse(&parse_id).await?,
            ),
        ))
    }
}

fn version(scene: &SceneRow) -> SceneVersion {
    SceneVersion {
        scene_id: scene.id.clone(),
        version: u32::try_from(scene.parse_version).unwrap_or(0),
    }
}

/// Returns the transform from one scene to another by their poses in the same map. Returns the
/// identity if they share no map: both scans are then assumed to use the same world coordinates.
fn transform_between_maps(from: &SceneRow, to: &SceneRow) -> Isometry3<f32> {
    let (Some(from_place), Some(to_place)) = (&from.scene_to_map, &to.scene_to_map) else {
        return Isometry3::identity();
    };
    if from.map_frame_id != to.map_frame_id {
        return Isometry3::identity();
    }
    let (out, back) =
        (SceneToFrame::scene_to_map(from_place), SceneToFrame::scene_to_map(to_place));
    let through = |p: [f64; 3]| Vector3::from(back.invert(out.apply(p)));
    let origin = through([0.0; 3]);
    let axes = [
        through([1.0, 0.0, 0.0]) - origin,
        through([0.0, 1.0, 0.0]) - origin,
        through([0.0, 0.0, 1.0]) - origin,
    ];
    let rotation =
        nalgebra::Rotation3::from_matrix_unchecked(nalgebra::Matrix3::from_columns(&axes));
    Isometry3::from_parts(
        origin.cast::<f32>().into(),
        nalgebra::UnitQuaternion::from_rotation_matrix(&rotation).cast(),
    )
}

fn compare_scenes(
    from: &StoredScene,
    to: &StoredScene,
    guess: &Isometry3<f32>,
    refine: bool,
    progress: &Progress,
) -> Result<(ScanAlignment, Changes), Error> {
    let (before, after) = (ComparedParse::from_scene(from)?, ComparedParse::from_scene(to)?);
    let aligned = align(&before.scene.cloud, &after.scene.cloud, guess, refine, progress);
    let Alignment { place, overlap, rms_m } = aligned.map_err(ParseError::from)?;
    if overlap < MIN_OVERLAP {
        return Err(Error::ScansApart { overlap });
    }
    let (positions_before, positions_after) =
        (&before.scene.cloud.positions, &after.scene.cloud.positions);
    let counterparts = Counterparts::match_nearest(
        positions_before,
        positions_after,
        &place,
        SAME_PLACE_M,
        progress,
    );
    let counterparts = counterparts.map_err(ParseError::from)?;
    let same = match_things(&before.owner_of_point, &after.owner_of_point, &counterparts);
    let changes = compare(
        &before.as_room_state(from),
        &after.as_room_state(to),
        &same,
        &counterparts,
        &place,
        progress,
    )?;
    let turn = place.rotation.cast::<f64>();
    let alignment = ScanAlignment {
        rotation: [turn.i, turn.j, turn.k, turn.w],
        translation_m: place.translation.vector.cast::<f64>().into(),
        refined: refine,
        overlap,
        rms_m,
    };
    Ok((alignment, changes))
}

/// A stored parse, loaded for a comparison.
struct ComparedParse {
    scene: Arc<RenderScene>,
    owner_of_point: Vec<InstanceId>,
    frames: Vec<FrameRef>,
    /// The pinned scan folder that the frames are read from.
    _scan: PinnedPath,
}

impl ComparedParse {
    fn from_scene(scene: &StoredScene) -> Result<Self, Error> {
        let (render_scene, of_point) = (scene.render_scene()?, scene.instance_of_point()?);
        let owners = Owners::new(&of_point, scene.instances());
        let owned = of_point
            .iter()
            .zip(&render_scene.cloud.positions)
            .map(|(found, p)| owners.owner_of(*found, p));
        let owner_of_point = owned.collect();
        let blobs = scene.blobs();
        let scan = blobs.pin_folder(&scene.parse.content)?;
        let frames = read_frames(blobs, &scene.folder(), &scene.parse.content)?.unwrap_or_default();
        Ok(Self { scene: render_scene, owner_of_point, frames, _scan: scan })
    }

    fn as_room_state<'a>(&'a self, scene: &'a StoredScene) -> RoomState<'a> {
        RoomState {
            cloud: &self.scene.cloud,
            owner_of_point: &self.owner_of_point,
            instances: scene.instances(),
            frames: &self.frames,
        }
    }
}
