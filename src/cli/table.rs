//! Answers as tables people can read.

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

/// Scenes in which something may be, the likeliest first.
pub fn of_many(found: &ManyAnswers) -> Table {
    let mut table = empty();
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
            answer.aabb.as_ref().map(of_box).unwrap_or_default(),
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

/// The six fields, box, status and time of one answer.
pub fn of_answer(answer: &Answer) -> Table {
    let fields = &answer.answer;
    let or_none = |text: Option<String>| text.unwrap_or_else(|| "none".into());
    let names = fields
        .candidate_names
        .iter()
        .map(|(id, name)| format!("{id}: {name}"))
        .collect::<Vec<_>>()
        .join(", ");
    let matches = fields.target_name_matches.map(|yes| if yes { "yes" } else { "no" }.to_owned());
    let mut table = empty();
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
    table.add_row(vec!["Box (m, Z up)".to_owned(), or_none(answer.aabb.as_ref().map(of_box))]);
    if let Some(placed) = &answer.in_frame {
        let boxes: Vec<String> = placed.boxes.iter().map(of_placed_box).collect();
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
        (FrameChoice::Source | FrameChoice::Scene, _) => "Box in the files".into(),
    }
}

fn of_placed_box(PlacedBox { center: c, size: s, orientation: q, .. }: &PlacedBox) -> String {
    let turned =
        format!("turned by x, y, z, w = ({:.3}, {:.3}, {:.3}, {:.3})", q[0], q[1], q[2], q[3]);
    format!(
        "center ({:.2}, {:.2}, {:.2}) size {:.2} x {:.2} x {:.2}, {turned}",
        c[0], c[1], c[2], s[0], s[1], s[2]
    )
}

/// Scenes of a server, each with how far it has come.
pub fn of_scenes(scenes: &[(&Scene, String)]) -> Table {
    let mut table = empty();
    table.set_header(vec!["ID", "Name", "State", "Things", "Age"]);
    for (scene, state) in scenes {
        let things =
            scene.counts.as_ref().map_or_else(String::new, |counts| counts.instances.to_string());
        table.add_row(vec![
            scene.id.clone(),
            scene.name.clone(),
            state.clone(),
            things,
            age(&scene.created_at),
        ]);
    }
    // A part of an id that is broken in two can not be copied.
    if let Some(column) = table.column_mut(0) {
        column.set_constraint(ColumnConstraint::ContentWidth);
    }
    table
}

/// What changed in a scene, a row a thing.
pub fn of_changes(changes: &Changes) -> Table {
    let Changes { appeared, gone, moved, first_seen, not_seen, regrouped, unchanged: _ } = changes;
    let mut table = empty();
    table.set_header(vec!["Change", "ID", "Thing", "Box (m, Z up)"]);
    let lists = [
        ("appeared", appeared),
        ("gone", gone),
        ("first seen", first_seen),
        ("not seen again", not_seen),
        ("no thing of its own any more", regrouped),
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
            of_box(&after.aabb),
        ]);
    }
    for (change, things) in lists {
        for ChangedThing { id, label, aabb } in things {
            table.add_row(vec![change.to_owned(), id.to_string(), label.clone(), of_box(aabb)]);
        }
    }
    table
}

/// How long ago something was, for people; the time itself where it can not be told.
pub fn age(at: &str) -> String {
    let Ok(then) = at.parse::<Timestamp>() else { return at.to_owned() };
    match Timestamp::now().as_second() - then.as_second() {
        ..60 => "under 1 min".into(),
        s @ 60..3600 => format!("{} min", s / 60),
        s @ 3600..172_800 => format!("{} h", s / 3600),
        s => format!("{} days", s / 86_400),
    }
}

/// What is wrong with a data folder.
pub fn of_findings(findings: &[Finding]) -> Table {
    let mut table = empty();
    table.set_header(vec!["What", "Trouble", "Remedy"]);
    for Finding { trouble, detail } in findings {
        table.add_row(vec![
            trouble.to_string(),
            detail.clone(),
            trouble.remedy().unwrap_or("none").to_owned(),
        ]);
    }
    table
}

/// Keys of a server.
pub fn of_keys(keys: &[Key]) -> Table {
    let mut table = empty();
    table.set_header(vec![
        "Begins",
        "Name",
        "Scope",
        "Limits",
        "Spent today",
        "Last used",
        "State",
    ]);
    for key in keys {
        let limits = [
            key.requests_per_minute.map(|n| format!("{n} a minute")),
            key.max_scenes.map(|n| format!("{n} scenes")),
            key.daily_usd.map(|usd| format!("{usd} USD a day")),
        ];
        let state = match (&key.revoked_at, &key.expires_at) {
            (Some(at), _) => format!("revoked {}", day_of(at)),
            (None, Some(at)) => format!("until {}", day_of(at)),
            (None, None) => "good".into(),
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

/// What was kept long enough.
pub fn of_removed(removed: &[RetentionReport]) -> Table {
    let mut table = empty();
    table.set_header(vec!["Kind", "Entries", "Size", "Why"]);
    for RetentionReport { kind, entries, bytes, why } in removed {
        table.add_row(vec![(*kind).to_owned(), entries.to_string(), size(*bytes), why.clone()]);
    }
    table
}

/// What was moved from one store to another; what there was none of is left out.
pub fn of_moved(moved: &MigrationReport) -> Table {
    let mut table = empty();
    table.set_header(vec!["What", "How many", "Size", "Of it copied"]);
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
            size(*bytes),
            size(*copied_bytes),
        ]);
    }
    table
}

fn day_of(at: &str) -> &str {
    at.get(..10).unwrap_or(at)
}

/// Bytes for people.
pub fn size(bytes: u64) -> String {
    match bytes {
        0..1000 => format!("{bytes} bytes"),
        1000..1_000_000 => format!("{:.1} kB", bytes as f64 / 1e3),
        1_000_000..1_000_000_000 => format!("{:.1} MB", bytes as f64 / 1e6),
        _ => format!("{:.1} GB", bytes as f64 / 1e9),
    }
}

/// The tied objects of an ambiguous answer.
pub fn of_alternatives(alternatives: &[Alternative]) -> Table {
    let mut table = empty();
    table.set_header(vec!["Could be", "Belief", "Box (m, Z up)"]);
    for alternative in alternatives {
        table.add_row(vec![
            alternative.id.to_string(),
            format!("{:.2}", alternative.confidence),
            of_box(&alternative.aabb),
        ]);
    }
    table
}

/// The largest objects of a scene.
pub fn of_instances<'a>(instances: impl Iterator<Item = &'a InstanceView>) -> Table {
    let mut table = empty();
    table.set_header(vec!["ID", "Looks like", "Colours", "Points", "Box (m, Z up)"]);
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
            of_box(&instance.aabb),
        ]);
    }
    table
}

fn of_box(aabb: &Aabb) -> String {
    let (c, s) = (aabb.center, aabb.size);
    format!("center ({:.2}, {:.2}, {:.2}) size {:.2} x {:.2} x {:.2}", c.x, c.y, c.z, s.x, s.y, s.z)
}

fn empty() -> Table {
    let mut table = Table::new();
    table
        .load_preset(presets::UTF8_FULL_CONDENSED)
        .set_content_arrangement(ContentArrangement::Dynamic)
        .set_width(WIDTH);
    table
}
