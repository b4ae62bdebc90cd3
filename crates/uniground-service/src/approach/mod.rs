//! Finds where a robot can stand to reach or see an object, and maps the floor it stands on.

use super::Caller;
use super::answers::{CoordinateFrameView, StoredScene};
use crate::error::Error;
use crate::{GroundingService, ParsedScenes, SceneLookup};
use image::codecs::png::PngEncoder;
use std::sync::Arc;
use uniground_grounding::approach::{
    Floor, Occupancy, Places, Wish, approach, approach_points, explanation,
};
use uniground_grounding::pipeline::SceneSource;
use uniground_grounding::unseen_regions;
use uniground_storage::SceneRow;
use uniground_types::answer::{Answer, CoordinateFrame, Status};
use uniground_types::approach::{
    Approach, ApproachRequest, ApproachStatus, ApproachTarget, CellCounts, FailedCondition,
    FloorMap, FloorPoint, check_map_height,
};
use uniground_types::question::{GroundRequest, ReasonerChoice};

/// Minimum distance from an unseen region, if possible, meters: a camera sees little of what is
/// right in front of the robot.
const LOOKING_DISTANCE_M: f32 = 0.5;

/// Finds poses from which a robot can reach or see an instance, or a part of the room that no camera
/// saw.
#[derive(Clone)]
pub struct ApproachService {
    pub(crate) scene_lookup: Arc<SceneLookup>,
    pub(crate) parsed_scenes: Arc<ParsedScenes>,
    pub(crate) grounding_service: Arc<GroundingService>,
}

impl ApproachService {
    /// Finds standing poses for an instance, or for the object that a question means.
    ///
    /// # Errors
    /// [`Error`] for an unknown or unparsed scene, an unknown instance or one that is not an
    /// object, an invalid request, a coordinate frame that the scene does not have, or overload.
    pub async fn approach(
        &self,
        scene_id: &str,
        request: ApproachRequest,
        caller: Caller,
    ) -> Result<Approach, Error> {
        request.check()?;
        let (answer, row, scene) = self.answer_query(scene_id, &request, caller).await?;
        let frame = CoordinateFrameView::resolve(request.frame, &row, scene.parse.source_to_scene)?;
        let mut result = Approach {
            scene_id: row.id,
            parse_version: u32::try_from(row.parse_version).unwrap_or(0),
            status: ApproachStatus::NotGrounded,
            answer_id: answer.as_ref().map(|answer| answer.id.clone()),
            answer_status: answer.as_ref().map(|answer| answer.status),
            target: None,
            unseen_region: None,
            poses: Vec::new(),
            start: None,
            failed: None,
            detail: String::new(),
            cells: None,
            floor_z_m: None,
            frame: CoordinateFrame::default(),
            in_frame: None,
        };
        if let Some(several) =
            answer.as_ref().map(|answer| answer.targets.len()).filter(|meant| *meant > 1)
        {
            result.detail = format!(
                "the question means {several} things, and one is driven to: ask with the instance_id of one of its answer's targets"
            );
            return Ok(result);
        }
        if let Some(number) = request.unseen_region {
            self.approach_unseen(&scene, number, &request, frame.as_ref(), &mut result).await?;
            result.in_frame = frame.map(|frame| frame.with_poses(&result.poses));
            return Ok(result);
        }
        let meant = match &answer {
            Some(answer) => {
                answer.answer.predicted_id.filter(|_| answer.status == Status::Grounded)
            }
            None => request.instance_id,
        };
        let Some(id) = meant else {
            result.detail = "the question has no sure answer in this room, and nothing is driven to on a guess: see its answer".into();
            return Ok(result);
        };
        let known = scene.instances().get((id.0 as usize).wrapping_sub(1));
        let instance =
            known.ok_or_else(|| Error::InstanceNotFound { scene_id: scene_id.into(), id })?;
        if instance.dismissed {
            return Err(Error::invalid(
                "/instance_id",
                format!("instance {id} is no thing: somebody has dismissed or split it"),
            ));
        }
        let (name, wish) = (instance.label().to_owned(), to_wish(&request, frame.as_ref()));
        result.target = Some(ApproachTarget {
            id,
            name: name.clone(),
            aabb: instance.aabb,
            oriented_box: instance.oriented_box,
            support: instance.support,
        });
        let (floor_z_m, places) = scene
            .compute(move |scene| {
                let occupancy = scene.occupancy()?;
                Ok((occupancy.floor_z_m(), approach(&occupancy, scene.instances(), id, &wish)))
            })
            .await?;
        let places =
            places.ok_or_else(|| Error::InstanceNotFound { scene_id: scene_id.into(), id })?;
        result.floor_z_m = Some(floor_z_m);
        set_places(places, &name, &mut result);
        result.in_frame = frame.map(|frame| frame.with_poses(&result.poses));
        Ok(result)
    }

    /// Finds poses that look at a part of the room that no camera saw.
    async fn approach_unseen(
        &self,
        scene: &Arc<StoredScene>,
        number: u32,
        request: &ApproachRequest,
        frame: Option<&CoordinateFrameView>,
        result: &mut Approach,
    ) -> Result<(), Error> {
        let wish = to_wish(request, frame);
        let found = scene.compute(move |scene| {
            let coverage = scene.coverage().ok_or_else(|| {
                Error::invalid(
                    "/unseen_region",
                    "it is not known what the cameras of this scan saw: it has no frames, or was parsed by an older version; in that case, parse it again",
                )
            })?;
            let volumes = coverage.unseen_volumes();
            let found = unseen_regions(coverage).into_iter().zip(volumes);
            let (region, volume) = found
                .into_iter()
                .find(|(region, _)| region.number == number)
                .ok_or_else(|| {
                    let detail = format!("the scene has {} unseen regions", volumes.len());
                    Error::invalid("/unseen_region", detail)
                })?;
            let (occupancy, name) = (scene.occupancy()?, format!("unseen region {number}"));
            let from_m = |least_m: f32| {
                let [asked_m, most_m] = wish.distances_m;
                let wish = Wish { distances_m: [asked_m.max(least_m).min(most_m), most_m], ..wish };
                approach_points(&occupancy, &volume.points, &name, &wish)
            };
            let places = from_m(LOOKING_DISTANCE_M)
                .filter(|places| places.poses.is_ok())
                .or_else(|| from_m(0.0));
            Ok((occupancy.floor_z_m(), region, places, name))
        });
        let (floor_z_m, region, places, name) = found.await?;
        (result.floor_z_m, result.unseen_region) = (Some(floor_z_m), Some(region));
        let places = places.unwrap_or(Places {
            poses: Err(FailedCondition::NotVisible),
            start: None,
            cells: CellCounts::default(),
        });
        set_places(places, &name, result);
        Ok(())
    }

    /// Returns the map of a scene's floor. Anything higher than `height_m` above the floor is not
    /// an obstacle.
    ///
    /// # Errors
    /// [`Error::SceneNotFound`], [`Error::SceneNotReady`], [`Error::ParseDamaged`]; an invalid
    /// height.
    pub async fn floor(&self, scene_id: &str, height_m: f32) -> Result<FloorMap, Error> {
        let scene = self.load_scene_for_map(scene_id, height_m).await?;
        scene.compute(move |scene| Ok(Floor::of(&*scene.occupancy()?, height_m).map().0)).await
    }

    /// Returns the map of a scene's floor as a PNG picture.
    ///
    /// # Errors
    /// Those of [`floor`](Self::floor).
    pub async fn floor_picture(&self, scene_id: &str, height_m: f32) -> Result<Vec<u8>, Error> {
        let scene = self.load_scene_for_map(scene_id, height_m).await?;
        let drawn = scene.compute(move |scene| {
            let (_, picture) = Floor::of(&*scene.occupancy()?, height_m).map();
            let mut png = Vec::new();
            picture.write_with_encoder(PngEncoder::new(&mut png)).map_err(std::io::Error::other)?;
            Ok(png)
        });
        drawn.await
    }

    async fn load_scene_for_map(
        &self,
        scene_id: &str,
        height_m: f32,
    ) -> Result<Arc<StoredScene>, Error> {
        check_map_height(height_m)?;
        let (_, parse_id) = self.scene_lookup.ready_scene(scene_id).await?;
        Ok(StoredScene::new(
            self.parsed_scenes.clone(),
            self.parsed_scenes.loaded_parse(&parse_id).await?,
        ))
    }

    /// Answers the request's question, if it has one. Also returns the parse that the answer's ids
    /// belong to.
    async fn answer_query(
        &self,
        scene_id: &str,
        request: &ApproachRequest,
        caller: Caller,
    ) -> Result<(Option<Answer>, SceneRow, Arc<StoredScene>), Error> {
        loop {
            let answer = match &request.query {
                Some(query) => Some(
                    self.grounding_service
                        .ground(
                            scene_id,
                            builtin_question(query, request.min_confidence),
                            caller.clone(),
                        )
                        .await?,
                ),
                None => None,
            };
            let (row, parse_id) = self.scene_lookup.ready_scene(scene_id).await?;
            // A new parse with other ids may have been stored in the meantime. The question is then
            // asked again for that parse.
            if answer
                .as_ref()
                .is_none_or(|answer| i64::from(answer.parse_version) == row.parse_version)
            {
                return Ok((
                    answer,
                    row,
                    StoredScene::new(
                        self.parsed_scenes.clone(),
                        self.parsed_scenes.loaded_parse(&parse_id).await?,
                    ),
                ));
            }
        }
    }
}

/// Sets the poses of a result, or why there are none.
fn set_places(Places { poses, start, cells }: Places, name: &str, result: &mut Approach) {
    (result.start, result.cells) = (start, Some(cells));
    match poses {
        Ok(poses) => {
            result.detail = poses.first().map(|best| best.why.clone()).unwrap_or_default();
            (result.status, result.poses) = (ApproachStatus::Found, poses);
        }
        Err(failed) => {
            result.detail = explanation(failed, name, &cells);
            (result.status, result.failed) = (ApproachStatus::NonePossible, Some(failed));
        }
    }
}

/// Returns a question for the built-in reasoner: it costs nothing, and a robot does not wait for a
/// model.
fn builtin_question(query: &str, min_confidence: Option<f32>) -> GroundRequest {
    GroundRequest {
        min_confidence,
        reasoner: ReasonerChoice::Builtin,
        allow_builtin: true,
        ..GroundRequest::new(query)
    }
}

/// Converts the request. `frame` is the frame of the robot's pose, or `None` for the scene's own.
fn to_wish(request: &ApproachRequest, frame: Option<&CoordinateFrameView>) -> Wish {
    let ApproachRequest {
        instance_id: _,
        query: _,
        unseen_region: _,
        min_confidence: _,
        robot,
        from,
        frame: _,
        min_distance_m,
        max_distance_m,
        max_poses,
    } = request;
    let in_scene = |FloorPoint { x, y, z }| {
        let [x, y, z] = frame.map_or([x, y, z], |frame| frame.from_scene.invert([x, y, z]));
        FloorPoint { x, y, z }
    };
    Wish {
        robot: *robot,
        from: from.map(in_scene),
        distances_m: [*min_distance_m, *max_distance_m],
        max_poses: *max_poses as usize,
    }
}

impl StoredScene {
    /// Returns the occupied space of the room. It is computed once and then cached.
    fn occupancy(&self) -> Result<Arc<Occupancy>, Error> {
        let known = self.known_occupancies();
        if let Some(occupancy) = known.get(&self.parse.id) {
            return Ok(occupancy);
        }
        let (render_scene, of_point) = (self.render_scene()?, self.instance_of_point()?);
        let occupancy =
            Arc::new(Occupancy::of(&render_scene.cloud.positions, &of_point, self.instances()));
        known.put(self.parse.id.clone(), occupancy.clone(), occupancy.bytes());
        Ok(occupancy)
    }
}
