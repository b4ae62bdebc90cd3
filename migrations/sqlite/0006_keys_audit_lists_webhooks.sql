-- Keys of callers. Of a key itself only its SHA-256 is kept: it is long and random, so that nobody can guess it from that.
CREATE TABLE keys (
    id                  TEXT PRIMARY KEY,
    name                TEXT NOT NULL,
    prefix              TEXT NOT NULL UNIQUE,
    hash                TEXT NOT NULL,
    scope               TEXT NOT NULL CHECK (scope IN ('read', 'write', 'admin')),
    expires_at          TEXT,
    requests_per_minute INTEGER,
    max_scenes          INTEGER,
    daily_usd           REAL,
    created_at          TEXT NOT NULL,
    last_used_at        TEXT,
    revoked_at          TEXT
) STRICT;

-- What is whose: scenes for quotas, jobs for turns, batches and calls under way for money. Keys are never removed, so these always mean somebody.
ALTER TABLE scenes ADD COLUMN key_id TEXT;
CREATE INDEX scenes_by_key ON scenes (key_id);
ALTER TABLE jobs ADD COLUMN key_id TEXT;
CREATE INDEX jobs_by_key ON jobs (kind, key_id, started_at);
ALTER TABLE batches ADD COLUMN key_id TEXT;
ALTER TABLE reservations ADD COLUMN key_id TEXT;

-- What was paid for questions of a key, by day (UTC): a part of what `spending` says.
CREATE TABLE key_spending (
    key_id TEXT NOT NULL,
    day    TEXT NOT NULL,
    usd    REAL NOT NULL,
    PRIMARY KEY (key_id, day)
) STRICT, WITHOUT ROWID;

-- Requests that change what is stored: who, what, when, and what came of it.
CREATE TABLE audit (
    id         TEXT PRIMARY KEY,
    at         TEXT NOT NULL,
    key_id     TEXT,
    method     TEXT NOT NULL,
    path       TEXT NOT NULL,
    status     INTEGER NOT NULL,
    request_id TEXT
) STRICT, WITHOUT ROWID;

-- Lists of answers, newest first: of a scene, of a status, of a batch.
ALTER TABLE answers ADD COLUMN status TEXT GENERATED ALWAYS AS (json_extract(body, '$.status')) VIRTUAL;
DROP INDEX answers_by_scene;
CREATE INDEX answers_by_scene ON answers (scene_id, id);
CREATE INDEX answers_by_status ON answers (status, id);
CREATE INDEX answers_by_time ON answers (created_at);
CREATE INDEX batch_items_by_answer ON batch_items (batch_id, answer_id);
CREATE INDEX jobs_by_subject_and_time ON jobs (subject, id);
DROP INDEX jobs_by_subject;

-- How often in a row a job failed in a way that may pass, without getting further than before.
ALTER TABLE jobs ADD COLUMN failures INTEGER NOT NULL DEFAULT 0;

-- Ends of jobs that somebody wants to be told of: what stands here was not taken yet. A trigger writes them, where a webhook is configured.
CREATE TABLE announcements (
    job_id     TEXT PRIMARY KEY REFERENCES jobs (id) ON DELETE CASCADE,
    attempts   INTEGER NOT NULL DEFAULT 0,
    not_before TEXT
) STRICT, WITHOUT ROWID;
