//! Scenes and their reports as resources: `uniground://scenes/{id}` and
//! `uniground://scenes/{id}/report`.

use crate::http::paging;
use rmcp::model::{ListResourcesResult, Resource, ResourceContents, ResourceTemplate};
use uniground_service::Services;
use uniground_service::error::Error;
use uniground_types::labels::Labels;

const SCENES: &str = "uniground://scenes/";
const REPORT: &str = "/report";
const JSON: &str = "application/json";
/// Number of scenes per page.
const PAGE: u32 = 50;

/// Returns the resource templates.
pub(super) fn templates() -> Vec<ResourceTemplate> {
    let template = |uri: &str, name: &str, description: &str| {
        let template = ResourceTemplate::new(format!("{SCENES}{uri}"), name);
        template.with_description(description).with_mime_type(JSON)
    };
    vec![
        template(
            "{scene_id}",
            "scene",
            "A scene: name, status, sizes, import report and map transform",
        ),
        template(
            "{scene_id}/report",
            "report",
            "Report of the import and the parse of a scene, stage by stage",
        ),
    ]
}

/// Lists a page of scenes and their reports, newest first.
pub(super) async fn list(
    services: &Services,
    cursor: Option<String>,
) -> Result<ListResourcesResult, Error> {
    let (_, cursor) = paging::validate(PAGE, cursor)?;
    let page = services.scenes.scenes(PAGE, cursor.as_deref(), Labels::new()).await?;
    let of_scene = |scene: uniground_types::scenes::Scene| {
        let uri = format!("{SCENES}{}", scene.id);
        let report = scene.counts.is_some().then(|| {
            let report =
                Resource::new(format!("{uri}{REPORT}"), format!("report of {}", scene.name));
            report.with_mime_type(JSON)
        });
        std::iter::once(Resource::new(uri, scene.name).with_mime_type(JSON)).chain(report)
    };
    let mut list =
        ListResourcesResult::with_all_items(page.scenes.into_iter().flat_map(of_scene).collect());
    list.next_cursor = page.next_cursor;
    Ok(list)
}

/// Returns the contents of a resource, or `None` for an unknown URI.
pub(super) async fn read(
    services: &Services,
    uri: &str,
) -> Result<Option<ResourceContents>, Error> {
    let Some(path) = uri.strip_prefix(SCENES) else { return Ok(None) };
    let json = match path.strip_suffix(REPORT) {
        Some(id) => serde_json::to_string(&services.parses.scene_report(id).await?)?,
        None => serde_json::to_string(&services.scene_lookup.scene(path).await?)?,
    };
    Ok(Some(ResourceContents::text(json, uri).with_mime_type(JSON)))
}
