//! The MCP tools. Each parses its arguments, calls the service and returns the result.

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

/// Number of scenes per page.
const SCENES: u32 = 50;
/// Number of objects per page.
const OBJECTS: u32 = 100;

/// Returns all tools, in the order an agent needs them.
pub(super) fn all() -> Vec<Tool> {
    vec![
        tool::<ListScenes, SceneBriefs>("list_scenes", "Lists the scenes, newest first."),
        tool::<Ground, Grounded>(
            "ground",
            "Finds the object that a sentence describes and returns its 3D box: \"the black chair \
             closest to the door\". The status shows whether no object or several objects fit.",
        ),
        tool::<FindInScenes, FoundBriefs>(
            "find_in_scenes",
            "Finds the scenes that contain an object.",
        ),
        tool::<ListObjects, ObjectBriefs>(
            "list_objects",
            "Lists the objects of a scene with names, boxes and supports.",
        ),
        tool::<OneObject, InstanceView>(
            "get_object",
            "Returns all data of one object: names, colors, boxes, support and best views.",
        ),
        tool::<Relations, SceneGraph>(
            "relations",
            "Returns the relations between objects: on, inside, above, next to, parts, and zones \
             such as a kitchen.",
        ),
        tool::<Approach, Approached>(
            "approach",
            "Returns poses from which a robot can see or reach an object, with paths, or the \
             condition that excluded all poses.",
        ),
        without_output::<RenderView>(
            "render_view",
            "Renders a picture of a scene with marked objects, or returns the photograph with the \
             best view of an object.",
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

/// Calls a tool, or returns `None` for an unknown name. Errors are returned as results, so that the
/// model can correct its call.
pub(super) async fn call(
    services: &Services,
    caller: Caller,
    name: &str,
    arguments: JsonObject,
) -> Option<CallToolResult> {
    let arguments = match with_scene_id(services, arguments).await {
        Ok(arguments) => arguments,
        Err(error) => return Some(failed(error)),
    };
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
    Some(result.unwrap_or_else(failed))
}

/// Replaces the name of a scene in `scene_id` by its id.
async fn with_scene_id(
    services: &Services,
    mut arguments: JsonObject,
) -> Result<JsonObject, Error> {
    if let Some(Value::String(scene)) = arguments.get_mut("scene_id") {
        *scene = services.scene_lookup.resolve(std::mem::take(scene)).await?;
    }
    Ok(arguments)
}

fn failed(error: Error) -> CallToolResult {
    let problem = ProblemResponse::from(error).problem();
    CallToolResult::error(vec![ContentBlock::text(format!(
        "{} ({})",
        problem.detail, problem.code
    ))])
}

/// Parses the arguments of a tool.
fn parse_arguments<T: DeserializeOwned>(arguments: JsonObject) -> Result<T, Error> {
    serde_path_to_error::deserialize(Value::Object(arguments)).map_err(|error| {
        let path = error.path().to_string();
        // The path `.` means the arguments themselves.
        let pointer =
            if path == "." { "/".to_owned() } else { format!("/{}", path.replace('.', "/")) };
        Error::invalid(pointer, error.into_inner().to_string())
    })
}

/// Returns a value as structured content, and as text for clients that support only text.
fn to_result(value: &impl Serialize) -> Result<CallToolResult, Error> {
    let text = serde_json::to_string(value)?;
    to_result_with_text(value, text)
}

fn to_result_with_text(value: &impl Serialize, text: String) -> Result<CallToolResult, Error> {
    let mut result = CallToolResult::success(vec![ContentBlock::text(text)]);
    // Serialized through text, because a direct conversion would turn an f32's 0.55 into
    // 0.550000011920929.
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
    // Reads pages until enough scenes match.
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
            format!("must name at most {MAX_MARKED} instances"),
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
                "must name an instance for the view photograph",
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
