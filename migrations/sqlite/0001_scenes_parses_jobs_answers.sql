-- Times are RFC 3339 UTC text; ids are UUIDv7 text, so that order of id is order of time.

-- Unpacked archives, shared by every scene uploaded from the same bytes.
CREATE TABLE contents (
    hash       TEXT PRIMARY KEY,
    bytes      INTEGER NOT NULL,
    created_at TEXT NOT NULL
) STRICT;

-- Finished parses only: a row and its instances are written in one transaction after the blobs are in place.
CREATE TABLE parses (
    id            TEXT PRIMARY KEY,
    content_hash  TEXT NOT NULL REFERENCES contents (hash),
    settings_hash TEXT NOT NULL,
    settings      TEXT NOT NULL,
    models        TEXT NOT NULL,
    import_report TEXT NOT NULL,
    parse_report  TEXT NOT NULL,
    extent        TEXT NOT NULL,
    created_at    TEXT NOT NULL,
    UNIQUE (content_hash, settings_hash)
) STRICT;

CREATE TABLE instances (
    parse_id TEXT NOT NULL REFERENCES parses (id) ON DELETE CASCADE,
    id       INTEGER NOT NULL,
    body     TEXT NOT NULL,
    PRIMARY KEY (parse_id, id)
) STRICT, WITHOUT ROWID;

CREATE TABLE scenes (
    id            TEXT PRIMARY KEY,
    name          TEXT NOT NULL,
    content_hash  TEXT NOT NULL REFERENCES contents (hash),
    parse_id      TEXT REFERENCES parses (id),
    parse_version INTEGER NOT NULL DEFAULT 0,
    job_id        TEXT,
    created_at    TEXT NOT NULL,
    updated_at    TEXT NOT NULL
) STRICT;
CREATE INDEX scenes_by_content ON scenes (content_hash);

CREATE TABLE answers (
    id         TEXT PRIMARY KEY,
    scene_id   TEXT NOT NULL REFERENCES scenes (id) ON DELETE CASCADE,
    parse_id   TEXT NOT NULL REFERENCES parses (id),
    body       TEXT NOT NULL,
    created_at TEXT NOT NULL
) STRICT;
CREATE INDEX answers_by_scene ON answers (scene_id);

CREATE TABLE jobs (
    id          TEXT PRIMARY KEY,
    kind        TEXT NOT NULL,
    -- What it works on: the scene's id.
    subject     TEXT NOT NULL,
    payload     TEXT NOT NULL,
    state       TEXT NOT NULL CHECK (state IN ('queued', 'running', 'succeeded', 'failed', 'cancelled')),
    stage       TEXT,
    progress    REAL NOT NULL DEFAULT 0,
    attempts    INTEGER NOT NULL DEFAULT 0,
    message     TEXT,
    error_code  TEXT,
    error       TEXT,
    created_at  TEXT NOT NULL,
    started_at  TEXT,
    finished_at TEXT
) STRICT;
CREATE INDEX jobs_by_state ON jobs (state, id);
CREATE INDEX jobs_by_subject ON jobs (subject);

CREATE TABLE idempotency_keys (
    key        TEXT PRIMARY KEY,
    scene_id   TEXT NOT NULL REFERENCES scenes (id) ON DELETE CASCADE,
    created_at TEXT NOT NULL
) STRICT;
