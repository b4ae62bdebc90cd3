//! Resolves a scene argument: an id, the beginning of an id, or a name.

use super::hints::quote_for_shell;
use super::table;
use anyhow::bail;
use uniground_client::{Client, ClientError};
use uniground_types::scenes::{Scene, SceneStatus};

/// Maximum page size of the API.
const PAGE: u32 = 100;
/// Maximum number of scenes listed in an error.
const MAX_LISTED: usize = 12;
/// Length of a complete id.
const ID: usize = 36;

/// Returns the id of the scene. A complete id is returned without a request; the next request
/// reports whether the scene exists.
///
/// # Errors
/// Returns an error that lists the scenes if none or several match, or a [`ClientError`].
pub async fn resolve_id(client: &Client, reference: &str) -> anyhow::Result<String> {
    if reference.len() == ID && reference.parse::<uuid::Uuid>().is_ok() {
        return Ok(reference.to_owned());
    }
    let scenes = list_scenes(client).await?;
    let found = find_matching(&scenes, reference);
    match &found[..] {
        [only] => Ok(only.id.clone()),
        [] if scenes.is_empty() => bail!(
            "there is no scene {reference:?}: the server has no scenes yet\n`uniground upload SCAN` \
             adds one"
        ),
        [] => bail!(
            "there is no scene {reference:?}; the scenes are\n{}\n`uniground scenes` shows details",
            format_list(&scenes.iter().collect::<Vec<_>>())
        ),
        several => bail!(
            "{reference:?} matches {} scenes:\n{}\ngive more of the name or of the id; `uniground \
             scenes` shows details",
            several.len(),
            format_list(several)
        ),
    }
}

/// Adds the list of existing scenes to a `scene_not_found` error.
pub async fn explain_unknown_scene(
    client: &Client,
    reference: &str,
    error: ClientError,
) -> anyhow::Error {
    match &error {
        ClientError::Problem(problem) if problem.code == "scene_not_found" => {
            match list_scenes(client).await {
                Ok(scenes) if scenes.is_empty() => {
                    anyhow::anyhow!(
                        "there is no scene {reference}: the server has no scenes yet\n`uniground \
                         upload SCAN` adds one"
                    )
                }
                Ok(scenes) => {
                    let listed = format_list(&scenes.iter().collect::<Vec<_>>());
                    anyhow::anyhow!(
                        "there is no scene {reference}; the scenes are\n{listed}\n`uniground scenes` \
                         shows details"
                    )
                }
                Err(_) => error.into(),
            }
        }
        _ => error.into(),
    }
}

/// Returns every scene of a server, newest first.
///
/// # Errors
/// [`ClientError`].
pub async fn list_scenes(client: &Client) -> Result<Vec<Scene>, ClientError> {
    let (mut scenes, mut cursor) = (Vec::new(), None);
    loop {
        let page = client.scenes(PAGE, cursor.as_deref()).await?;
        scenes.extend(page.scenes);
        cursor = page.next_cursor;
        if cursor.is_none() {
            return Ok(scenes);
        }
    }
}

/// Returns the shortest unambiguous value of `--scene` for a scene: its name, or its id if the name
/// is not unique.
pub fn shortest_reference(scenes: &[Scene], scene: &Scene) -> String {
    match find_matching(scenes, &scene.name)[..] {
        [only] if only.id == scene.id => quote_for_shell(&scene.name),
        _ => scene.id.clone(),
    }
}

/// Returns the matches of the first rule that has any: id, exact name, name without case, beginning
/// of an id or a name.
fn find_matching<'a>(scenes: &'a [Scene], reference: &str) -> Vec<&'a Scene> {
    let lower = reference.to_lowercase();
    let ways: [&dyn Fn(&Scene) -> bool; 4] = [
        &|scene| scene.id == lower,
        &|scene| scene.name == reference,
        &|scene| scene.name.to_lowercase() == lower,
        &|scene| scene.id.starts_with(&lower) || scene.name.to_lowercase().starts_with(&lower),
    ];
    if lower.is_empty() {
        return Vec::new();
    }
    let found =
        ways.iter().map(|means| scenes.iter().filter(|scene| means(scene)).collect::<Vec<_>>());
    found.into_iter().find(|found| !found.is_empty()).unwrap_or_default()
}

fn format_list(scenes: &[&Scene]) -> String {
    let line = |scene: &&Scene| {
        let state = match scene.status {
            SceneStatus::Ready => "",
            SceneStatus::Parsing => ", being parsed",
            SceneStatus::Failed => ", parse failed",
            SceneStatus::Uploaded => ", not parsed",
        };
        format!(
            "  {}  {}, {} old{state}",
            scene.id,
            scene.name,
            table::format_age(&scene.created_at)
        )
    };
    let mut lines: Vec<String> = scenes.iter().take(MAX_LISTED).map(line).collect();
    if scenes.len() > MAX_LISTED {
        lines.push(format!("  and {} more", scenes.len() - MAX_LISTED));
    }
    lines.join("\n")
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn scene(id: &str, name: &str) -> Scene {
        serde_json::from_value(json!({
            "id": id, "name": name, "status": "ready", "content_hash": "", "parse_version": 1,
            "created_at": "2026-11-23T08:00:00Z", "updated_at": "2026-11-23T08:00:00Z",
        }))
        .unwrap()
    }

    #[test]
    fn an_exact_name_wins_over_a_prefix() {
        let scenes = [
            scene("01a2-aa", "Kitchen"),
            scene("01a2-ab", "kitchen"),
            scene("01a2-b0", "kitchen upstairs"),
            scene("01b0-00", "hall"),
        ];
        let ids = |reference: &str| {
            find_matching(&scenes, reference)
                .iter()
                .map(|scene| scene.id.clone())
                .collect::<Vec<_>>()
        };
        assert_eq!(ids("kitchen"), ["01a2-ab"]);
        assert_eq!(ids("KITCHEN"), ["01a2-aa", "01a2-ab"]);
        assert_eq!(ids("kitchen u"), ["01a2-b0"]);
        assert_eq!(ids("Ha"), ["01b0-00"]);
        assert_eq!(ids("01b"), ["01b0-00"]);
        assert_eq!(ids("01a2-a").len(), 2);
        assert!(ids("cellar").is_empty() && ids("").is_empty());
    }

    #[test]
    fn an_ambiguous_name_is_referenced_by_id() {
        let scenes =
            [scene("01a2-aa", "hall"), scene("01a2-ab", "hall"), scene("01a2-ac", "living room")];
        assert_eq!(shortest_reference(&scenes, &scenes[0]), "01a2-aa");
        assert_eq!(shortest_reference(&scenes, &scenes[2]), "'living room'");
    }
}
