//! The tools: each decodes, calls one use case, and tells.

use super::schema;
use super::values::{
    Approach, FindInScenes, FoundBriefs, Ground, Grounded, ListObjects, ListScenes, MAX_MARKED,
    ObjectBrief, ObjectBriefs, OneObject, Relations, RenderView, SceneBrief, SceneBriefs, ViewKind,
};
use crate::http::paging;
use crate::http::problem::ProblemResponse;
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use rmcp::model::{CallToolResult, ContentBlock, JsonObject, Tool, ToolAnnotations};
use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::Value;
use uniground_service::error::Error;
use uniground_service::{Caller, EvidenceFile, Services, write_graph};
use uniground_types::approach::Approach as Approached;
use uniground_types::graph::{GraphFormat, SceneGraph};
use uniground_types::instances::{InstanceView, Levels, ViewPicture};
use uniground_types::labels::Labels;
use uniground_types::scene::InstanceId;
use utoipa::ToSchema;

/// Scenes a page.
const SCENES: u32 = 50;
/// Objects a page.
const OBJECTS: u32 = 100;

/// All tools, in the order an agent needs them.
pub(super) fn all() -> Vec<Tool> {
    vec![
        tool::<ListScenes, SceneBriefs>(
            "list_scenes",
            "Scans of rooms that can be asked about, newest first.",
        ),
        tool::<Ground, Grounded>(
            "ground",
            "Finds what a sentence means in a scene, and gives its 3D box: \"the black chair closest to the door\". Says so where nothing or several things fit.",
        ),
        tool::<FindInScenes, FoundBriefs>(
            "find_in_scenes",
            "Finds out in which of all scenes something is.",
        ),
        tool::<ListObjects, ObjectBriefs>(
            "list_objects",
            "What was found in a scene: names, boxes, and what stands on what.",
        ),
        tool::<OneObject, InstanceView>(
            "get_object",
            "Everything known of one thing: names, colours, boxes, support, and the photograph that shows it best.",
        ),
        tool::<Relations, SceneGraph>(
            "relations",
            "How things stand to each other: what is on, inside, above and next to what, parts, and zones such as a kitchen.",
        ),
        tool::<Approach, Approached>(
            "approach",
            "Where a robot can stand to see a thing, or to reach it, with the way there; or which condition left no place.",
        ),
        without_output::<RenderView>(
            "render_view",
            "A picture of a scene with things marked, or the photograph that shows a thing best.",
        ),
    ]
}

fn tool<I: ToSchema, O: ToSchema>(name: &'static str, description: &'static str) -> Tool {
    without_output::<I>(name, description).with_raw_output_schema(schema::schema_of::<O>())
}

fn without_output<I: ToSchema>(name: &'static str, description: &'static str) -> Tool {
    let hints = ToolAnnotations::new().read_only(true).open_world(false);
    Tool::new(name, description, schema::schema_of::<I>()).with_annotations(hints)
}

/// Calls a tool; `None` where there is none of that name. What goes wrong is told as a result, so
/// that whoever called can do better.
pub(super) async fn call(
    services: &Services,
    caller: Caller,
    name: &str,
    arguments: JsonObject,
) -> Option<CallToolResult> {
    let result = match name {
        "list_scenes" => list_scenes(services, arguments).await,
        "ground" => ground(services, caller, arguments).await,
        "find_in_scenes" => find_in_scenes(services, caller, arguments).await,
        "list_objects" => list_objects(services, arguments).await,
        "get_object" => get_object(services, arguments).await,
        "relations" => relations(services, arguments).await,
        "approach" => approach(services, caller, arguments).await,
        "render_view" => render_view(services, arguments).await,
        _ => return None,
    };
    Some(result.unwrap_or_else(|error| {
        let problem = ProblemResponse::from(error).problem();
        CallToolResult::error(vec![ContentBlock::text(format!(
            "{} ({})",
            problem.detail, problem.code
        ))])
    }))
}

/// The arguments of a tool.
fn parse_arguments<T: DeserializeOwned>(arguments: JsonObject) -> Result<T, Error> {
    serde_path_to_error::deserialize(Value::Object(arguments)).map_err(|error| {
        let path = error.path().to_string();
        // The arguments themselves are a dot.
        let pointer =
            if path == "." { "/".to_owned() } else { format!("/{}", path.replace('.', "/")) };
        Error::invalid(pointer, error.into_inner().to_string())
    })
}

/// A value as it is, and as text for clients that read nothing else.
fn to_result(value: &impl Serialize) -> Result<CallToolResult, Error> {
    let text = serde_json::to_string(value)?;
    to_result_with_text(value, text)
}

fn to_result_with_text(value: &impl Serialize, text: String) -> Result<CallToolResult, Error> {
    let mut result = CallToolResult::success(vec![ContentBlock::text(text)]);
    // By way of text: a value would tell an f32's 0.55 as 0.550000011920929.
    result.structured_content = Some(serde_json::from_str(&serde_json::to_string(value)?)?);
    Ok(result)
}

fn name_matches(name: &str, part: Option<&str>) -> bool {
    part.is_none_or(|part| name.to_lowercase().contains(&part.to_lowercase()))
}

async fn list_scenes(services: &Services, arguments: JsonObject) -> Result<CallToolResult, Error> {
    let ListScenes { name, cursor } = parse_arguments(arguments)?;
    let (_, mut cursor) = paging::validate(SCENES, cursor)?;
    let mut scenes = Vec::new();
    // A page of those that are meant, or all there are.
    loop {
        let page = services.scenes.scenes(SCENES, cursor.as_deref(), Labels::new()).await?;
        scenes.extend(
            page.scenes
                .into_iter()
                .filter(|scene| name_matches(&scene.name, name.as_deref()))
                .map(SceneBrief::from),
        );
        cursor = page.next_cursor;
        if cursor.is_none() || !scenes.is_empty() {
            return to_result(&SceneBriefs { scenes, next_cursor: cursor });
        }
    }
}

async fn ground(
    services: &Services,
    caller: Caller,
    arguments: JsonObject,
) -> Result<CallToolResult, Error> {
    let (scene_id, request) = parse_arguments::<Ground>(arguments)?.into_request();
    to_result(&Grounded::from(services.grounding.ground(&scene_id, request, caller).await?))
}

async fn find_in_scenes(
    services: &Services,
    caller: Caller,
    arguments: JsonObject,
) -> Result<CallToolResult, Error> {
    let request = parse_arguments::<FindInScenes>(arguments)?.into_request();
    to_result(&FoundBriefs::from(services.grounding.ground_many(request, caller).await?))
}

async fn list_objects(services: &Services, arguments: JsonObject) -> Result<CallToolResult, Error> {
    let ListObjects { scene_id, name, level, mut cursor } = parse_arguments(arguments)?;
    let mut objects = Vec::new();
    loop {
        let page = services.instances.instances(&scene_id, level, OBJECTS, cursor).await?;
        objects.extend(
            page.instances
                .into_iter()
                .map(ObjectBrief::from)
                .filter(|object| name_matches(&object.name, name.as_deref())),
        );
        match page.next_cursor {
            Some(next) if objects.is_empty() => cursor = next,
            next_cursor => return to_result(&ObjectBriefs { objects, next_cursor }),
        }
    }
}

async fn get_object(services: &Services, arguments: JsonObject) -> Result<CallToolResult, Error> {
    let OneObject { scene_id, instance_id } = parse_arguments(arguments)?;
    let instance = services.instances.instance(&scene_id, InstanceId(instance_id)).await?;
    let mut result = to_result(&instance)?;
    if !instance.views.is_empty() {
        let file = services
            .instances
            .view_picture(&scene_id, InstanceId(instance_id), 0, ViewPicture::Crop)
            .await?;
        result.content.push(picture_content(read_picture(file).await?));
    }
    Ok(result)
}

async fn relations(services: &Services, arguments: JsonObject) -> Result<CallToolResult, Error> {
    let Relations { scene_id, instance_id } = parse_arguments(arguments)?;
    let graph =
        services.instances.graph(&scene_id, Levels::Things, instance_id.map(InstanceId)).await?;
    let (_, text) = write_graph(&graph, GraphFormat::Text)?;
    to_result_with_text(&graph, text)
}

async fn approach(
    services: &Services,
    caller: Caller,
    arguments: JsonObject,
) -> Result<CallToolResult, Error> {
    let (scene_id, request) = parse_arguments::<Approach>(arguments)?.into_request();
    to_result(&services.approach.approach(&scene_id, request, caller).await?)
}

async fn render_view(services: &Services, arguments: JsonObject) -> Result<CallToolResult, Error> {
    let RenderView { scene_id, instance_ids, view } = parse_arguments(arguments)?;
    if instance_ids.len() > MAX_MARKED {
        return Err(Error::invalid(
            "/instance_ids",
            format!("at most {MAX_MARKED} are marked in one picture"),
        ));
    }
    let ids: Vec<InstanceId> = instance_ids.into_iter().map(InstanceId).collect();
    let jpeg = match (view, ids.first()) {
        (ViewKind::Room, _) => services.answers.room_picture(&scene_id, ids).await?,
        (ViewKind::Photograph, Some(&id)) => {
            read_picture(
                services.instances.view_picture(&scene_id, id, 0, ViewPicture::Frame).await?,
            )
            .await?
        }
        (ViewKind::Photograph, None) => {
            return Err(Error::invalid(
                "/instance_ids",
                "a photograph is of an instance: name one",
            ));
        }
    };
    Ok(CallToolResult::success(vec![picture_content(jpeg)]))
}

fn picture_content(jpeg: Vec<u8>) -> ContentBlock {
    ContentBlock::image(STANDARD.encode(jpeg), "image/jpeg")
}

async fn read_picture(picture: EvidenceFile) -> Result<Vec<u8>, Error> {
    match picture {
        EvidenceFile::Stored(file) => Ok(tokio::fs::read(file).await?),
        EvidenceFile::Drawn(jpeg) => Ok(jpeg.into()),
    }
}
