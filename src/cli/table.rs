//! Formats answers and lists as tables.

use comfy_table::{ColumnConstraint, ContentArrangement, Table, presets};
use jiff::Timestamp;
use uniground_core::geometry::boxes::Aabb;
use uniground_core::grounding::{Alternative, Status};
use uniground_service::{Finding, RetentionReport};
use uniground_storage::{MigratedFiles, MigrationReport};
use uniground_types::answer::Answer;
use uniground_types::changes::{ChangedThing, Changes, MovedThing};
use uniground_types::instances::InstanceView;
use uniground_types::keys::Key;
use uniground_types::many::{ManyAnswers, SceneAnswer};
use uniground_types::placement::{FrameChoice, InFrame, PlacedBox};
use uniground_types::scenes::Scene;

const WIDTH: u16 = 110;

/// Formats the scenes of a search, best first.
pub fn many_answers_table(found: &ManyAnswers) -> Table {
    let mut table = empty_table();
    table.set_header(["Scene", "Status", "ID", "What", "Box (m, Z up)"]);
    for SceneAnswer { scene_name, labels, answer } in &found.answers {
        let filed: Vec<String> =
            labels.iter().map(|(name, value)| format!("{name}={value}")).collect();
        let scene = if filed.is_empty() {
            scene_name.clone()
        } else {
            format!("{scene_name}\n{}", filed.join(", "))
        };
        let id = answer.answer.predicted_id;
        let what = id.and_then(|id| answer.answer.candidate_names.get(&id.0).cloned());
        table.add_row([
            scene,
            format!("{} ({:.2})", status_of(answer), answer.confidence),
            id.map_or_else(|| "none".into(), |id| id.to_string()),
            what.unwrap_or_default(),
            answer.aabb.as_ref().map(format_box).unwrap_or_default(),
        ]);
    }
    table
}

fn status_of(answer: &Answer) -> &'static str {
    match answer.status {
        Status::Grounded => "grounded",
        Status::Uncertain => "uncertain",
        Status::Ambiguous => "ambiguous",
        Status::NoMatch => "no match",
    }
}

/// Formats one answer: the six fields, box, status and time.
pub fn answer_table(answer: &Answer) -> Table {
    let fields = &answer.answer;
    let or_none = |text: Option<String>| text.unwrap_or_else(|| "none".into());
    let names = fields
        .candidate_names
        .iter()
        .map(|(id, name)| format!("{id}: {name}"))
        .collect::<Vec<_>>()
        .join(", ");
    let matches = fields.target_name_matches.map(|yes| if yes { "yes" } else { "no" }.to_owned());
    let mut table = empty_table();
    table.set_header(vec!["Question".to_owned(), answer.query.clone()]);
    table.add_row(vec![
        "Status".to_owned(),
        format!("{} (confidence {:.2})", status_of(answer), answer.confidence),
    ]);
    table.add_row(vec![
        "Predicted ID".to_owned(),
        or_none(fields.predicted_id.map(|id| id.to_string())),
    ]);
    table.add_row(vec!["Explanation".to_owned(), fields.explanation.clone()]);
    table.add_row(vec![
        "Candidate Names".to_owned(),
        if names.is_empty() { "none".into() } else { names },
    ]);
    table.add_row(vec!["Target name matches?".to_owned(), or_none(matches)]);
    table.add_row(vec!["Anchor ID".to_owned(), or_none(fields.anchor_id.map(|id| id.to_string()))]);
    table.add_row(vec!["Relation used".to_owned(), or_none(fields.relation_used.clone())]);
    table.add_row(vec!["Box (m, Z up)".to_owned(), or_none(answer.aabb.as_ref().map(format_box))]);
    if let Some(placed) = &answer.in_frame {
        let boxes: Vec<String> = placed.boxes.iter().map(format_placed_box).collect();
        table.add_row(vec![
            name_of_frame(placed),
            or_none(Some(boxes.join("\n")).filter(|boxes| !boxes.is_empty())),
        ]);
    }
    table.add_row(vec!["Time".to_owned(), format!("{:.2} ms", answer.timings_ms.total)]);
    table
}

fn name_of_frame(InFrame { frame, frame_id, .. }: &InFrame) -> String {
    match (frame, frame_id) {
        (FrameChoice::Map, Some(id)) => format!("Box in {id} (m)"),
        (FrameChoice::Map, None) => "Box in the map (m)".into(),
        (FrameChoice::Source | FrameChoice::Scene, _) => "Box (source frame)".into(),
    }
}

fn format_placed_box(PlacedBox { center: c, size: s, orientation: q, .. }: &PlacedBox) -> String {
    let turned =
        format!("turned by x, y, z, w = ({:.3}, {:.3}, {:.3}, {:.3})", q[0], q[1], q[2], q[3]);
    format!(
        "center ({:.2}, {:.2}, {:.2}) size {:.2} x {:.2} x {:.2}, {turned}",
        c[0], c[1], c[2], s[0], s[1], s[2]
    )
}

/// Formats the scenes of a server with their state.
pub fn scenes_table(scenes: &[(&Scene, String)]) -> Table {
    let mut table = empty_table();
    table.set_header(vec!["ID", "Name", "State", "Objects", "Age"]);
    for (scene, state) in scenes {
        let things =
            scene.counts.as_ref().map_or_else(String::new, |counts| counts.instances.to_string());
        table.add_row(vec![
            scene.id.clone(),
            scene.name.clone(),
            state.clone(),
            things,
            format_age(&scene.created_at),
        ]);
    }
    // The id stays on one line, so that it can be copied.
    if let Some(column) = table.column_mut(0) {
        column.set_constraint(ColumnConstraint::ContentWidth);
    }
    table
}

/// Formats the changes of a scene, one row per object.
pub fn changes_table(changes: &Changes) -> Table {
    let Changes { appeared, gone, moved, first_seen, not_seen, regrouped, unchanged: _ } = changes;
    let mut table = empty_table();
    table.set_header(vec!["Change", "ID", "Object", "Box (m, Z up)"]);
    let lists = [
        ("appeared", appeared),
        ("gone", gone),
        ("first seen", first_seen),
        ("not observed", not_seen),
        ("regrouped", regrouped),
    ];
    for MovedThing { before, after, distance_m } in moved {
        let ids = if before.id == after.id {
            before.id.to_string()
        } else {
            format!("{} -> {}", before.id, after.id)
        };
        table.add_row(vec![
            format!("moved by {distance_m:.2} m"),
            ids,
            after.label.clone(),
            format_box(&after.aabb),
        ]);
    }
    for (change, things) in lists {
        for ChangedThing { id, label, aabb } in things {
            table.add_row(vec![change.to_owned(), id.to_string(), label.clone(), format_box(aabb)]);
        }
    }
    table
}

/// Formats how long ago a time was. Returns the text unchanged if it is not a timestamp.
pub fn format_age(at: &str) -> String {
    let Ok(then) = at.parse::<Timestamp>() else { return at.to_owned() };
    match Timestamp::now().as_second() - then.as_second() {
        ..60 => "under 1 min".into(),
        s @ 60..3600 => format!("{} min", s / 60),
        s @ 3600..172_800 => format!("{} h", s / 3600),
        s => format!("{} days", s / 86_400),
    }
}

/// Formats the findings of the doctor.
pub fn findings_table(findings: &[Finding]) -> Table {
    let mut table = empty_table();
    table.set_header(vec!["Problem", "Details", "Remedy"]);
    for Finding { trouble, detail } in findings {
        table.add_row(vec![
            trouble.to_string(),
            detail.clone(),
            trouble.remedy().unwrap_or("none").to_owned(),
        ]);
    }
    table
}

/// Formats the keys of a server.
pub fn keys_table(keys: &[Key]) -> Table {
    let mut table = empty_table();
    table.set_header(vec![
        "Prefix",
        "Name",
        "Scope",
        "Limits",
        "Spent today",
        "Last used",
        "State",
    ]);
    for key in keys {
        let limits = [
            key.requests_per_minute.map(|n| format!("{n}/min")),
            key.max_scenes.map(|n| format!("{n} scenes")),
            key.daily_usd.map(|usd| format!("{usd} USD/day")),
        ];
        let state = match (&key.revoked_at, &key.expires_at) {
            (Some(at), _) => format!("revoked {}", date_of(at)),
            (None, Some(at)) => format!("until {}", date_of(at)),
            (None, None) => "active".into(),
        };
        table.add_row(vec![
            key.prefix.clone(),
            key.name.clone(),
            key.scope.as_str().to_owned(),
            limits.into_iter().flatten().collect::<Vec<_>>().join(", "),
            format!("{:.4} USD", key.spent_today_usd),
            key.last_used_at
                .as_deref()
                .map_or_else(|| "never".into(), |at| at.chars().take(16).collect()),
            state,
        ]);
    }
    table
}

/// Formats the entries that retention removed.
pub fn removed_table(removed: &[RetentionReport]) -> Table {
    let mut table = empty_table();
    table.set_header(vec!["Kind", "Entries", "Size", "Why"]);
    for RetentionReport { kind, entries, bytes, why } in removed {
        table.add_row(vec![
            (*kind).to_owned(),
            entries.to_string(),
            format_bytes(*bytes),
            why.clone(),
        ]);
    }
    table
}

/// Formats the result of a migration, without empty kinds.
pub fn migration_table(moved: &MigrationReport) -> Table {
    let mut table = empty_table();
    table.set_header(vec!["What", "Count", "Size", "Copied"]);
    for (name, rows) in moved.rows.iter().filter(|(_, rows)| *rows > 0) {
        table.add_row(vec![
            format!("rows of {name}"),
            rows.to_string(),
            String::new(),
            String::new(),
        ]);
    }
    for MigratedFiles { kind, folders, bytes, copied_bytes } in
        moved.files.iter().filter(|kind| kind.folders > 0)
    {
        table.add_row(vec![
            format!("files of {kind}"),
            folders.to_string(),
            format_bytes(*bytes),
            format_bytes(*copied_bytes),
        ]);
    }
    table
}

fn date_of(at: &str) -> &str {
    at.get(..10).unwrap_or(at)
}

/// Formats a number of bytes.
pub fn format_bytes(bytes: u64) -> String {
    match bytes {
        0..1000 => format!("{bytes} bytes"),
        1000..1_000_000 => format!("{:.1} kB", bytes as f64 / 1e3),
        1_000_000..1_000_000_000 => format!("{:.1} MB", bytes as f64 / 1e6),
        _ => format!("{:.1} GB", bytes as f64 / 1e9),
    }
}

/// Formats the tied objects of an ambiguous answer.
pub fn alternatives_table(alternatives: &[Alternative]) -> Table {
    let mut table = empty_table();
    table.set_header(vec!["Candidate", "Confidence", "Box (m, Z up)"]);
    for alternative in alternatives {
        table.add_row(vec![
            alternative.id.to_string(),
            format!("{:.2}", alternative.confidence),
            format_box(&alternative.aabb),
        ]);
    }
    table
}

/// Formats the largest objects of a scene.
pub fn instances_table<'a>(instances: impl Iterator<Item = &'a InstanceView>) -> Table {
    let mut table = empty_table();
    table.set_header(vec!["ID", "Name", "Colors", "Points", "Box (m, Z up)"]);
    for instance in instances {
        let mut colours: Vec<_> = instance.colours.iter().collect();
        colours.sort_by(|a, b| b.1.total_cmp(a.1));
        let colours = colours
            .iter()
            .take(2)
            .map(|(name, share)| format!("{name} {:.0}%", *share * 100.0))
            .collect::<Vec<_>>()
            .join(", ");
        table.add_row(vec![
            instance.id.to_string(),
            instance.label.clone(),
            colours,
            instance.point_count.to_string(),
            format_box(&instance.aabb),
        ]);
    }
    table
}

fn format_box(aabb: &Aabb) -> String {
    let (c, s) = (aabb.center, aabb.size);
    format!("center ({:.2}, {:.2}, {:.2}) size {:.2} x {:.2} x {:.2}", c.x, c.y, c.z, s.x, s.y, s.z)
}

fn empty_table() -> Table {
    let mut table = Table::new();
    table
        .load_preset(presets::UTF8_FULL_CONDENSED)
        .set_content_arrangement(ContentArrangement::Dynamic)
        .set_width(WIDTH);
    table
}
