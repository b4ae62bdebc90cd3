//! Migrations of the database schema. `migrations/` holds them for each engine.

use super::database::Engine;
use sqlx::SqlSafeStr;
use sqlx::migrate::{Migration, MigrationType, Migrator};

/// Migrations that update a SQLite database of any version, in order. A released file is never
/// changed.
pub(super) const MIGRATIONS: [(i64, &str, &str); 18] = [
    (
        1,
        "scenes parses jobs answers",
        include_str!("../../../migrations/sqlite/0001_scenes_parses_jobs_answers.sql"),
    ),
    (
        2,
        "instance names spending",
        include_str!("../../../migrations/sqlite/0002_instance_names_spending.sql"),
    ),
    (3, "lanes records", include_str!("../../../migrations/sqlite/0003_lanes_records.sql")),
    (4, "nothing lost", include_str!("../../../migrations/sqlite/0004_nothing_lost.sql")),
    (5, "batches", include_str!("../../../migrations/sqlite/0005_batches.sql")),
    (
        6,
        "keys audit lists webhooks",
        include_str!("../../../migrations/sqlite/0006_keys_audit_lists_webhooks.sql"),
    ),
    (7, "superseded parses", include_str!("../../../migrations/sqlite/0007_superseded_parses.sql")),
    (8, "name indexes", include_str!("../../../migrations/sqlite/0008_name_indexes.sql")),
    (9, "corrections", include_str!("../../../migrations/sqlite/0009_corrections.sql")),
    (10, "scene to map", include_str!("../../../migrations/sqlite/0010_scene_to_map.sql")),
    (11, "question keys", include_str!("../../../migrations/sqlite/0011_question_keys.sql")),
    (12, "uploads", include_str!("../../../migrations/sqlite/0012_uploads.sql")),
    (13, "scene changes", include_str!("../../../migrations/sqlite/0013_scene_changes.sql")),
    (14, "labels", include_str!("../../../migrations/sqlite/0014_labels.sql")),
    (15, "members", include_str!("../../../migrations/sqlite/0015_members.sql")),
    (16, "room index", include_str!("../../../migrations/sqlite/0016_room_index.sql")),
    (17, "batch defaults", include_str!("../../../migrations/sqlite/0017_batch_defaults.sql")),
    (18, "sessions", include_str!("../../../migrations/sqlite/0018_sessions.sql")),
];

/// The same for PostgreSQL. Its first migration equals the result of SQLite's first fourteen.
const MIGRATIONS_OF_POSTGRES: [(i64, &str, &str); 5] = [
    (
        14,
        "everything so far",
        include_str!("../../../migrations/postgres/0014_everything_so_far.sql"),
    ),
    (15, "members", include_str!("../../../migrations/postgres/0015_members.sql")),
    (16, "room index", include_str!("../../../migrations/postgres/0016_room_index.sql")),
    (17, "batch defaults", include_str!("../../../migrations/postgres/0017_batch_defaults.sql")),
    (18, "sessions", include_str!("../../../migrations/postgres/0018_sessions.sql")),
];

pub(super) fn migrations(engine: Engine) -> Migrator {
    let migration = |&(version, name, sql): &(i64, &'static str, &'static str)| {
        Migration::new(version, name.into(), MigrationType::Simple, sql.into_sql_str(), false)
    };
    let all: &[_] = match engine {
        Engine::Sqlite => &MIGRATIONS,
        Engine::Postgres => &MIGRATIONS_OF_POSTGRES,
    };
    Migrator::with_migrations(all.iter().map(migration).collect())
}
