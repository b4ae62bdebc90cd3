-- What the first fourteen migrations of SQLite's lead to; what each column means is said there (migrations/sqlite). Texts are in the order of
-- their bytes: ids and times are compared.

CREATE TABLE data_folder (
    id    TEXT COLLATE "C" NOT NULL,
    since TEXT COLLATE "C" NOT NULL
);

CREATE TABLE contents (
    hash       TEXT COLLATE "C" PRIMARY KEY,
    bytes      BIGINT NOT NULL,
    created_at TEXT COLLATE "C" NOT NULL,
    grown_from TEXT COLLATE "C"
);
CREATE INDEX contents_by_origin ON contents (grown_from);

CREATE TABLE parses (
    id             TEXT COLLATE "C" PRIMARY KEY,
    content_hash   TEXT COLLATE "C" NOT NULL REFERENCES contents (hash),
    settings_hash  TEXT COLLATE "C" NOT NULL,
    settings       TEXT NOT NULL,
    models         TEXT NOT NULL,
    import_report  TEXT NOT NULL,
    parse_report   TEXT NOT NULL,
    extent         TEXT NOT NULL,
    created_at     TEXT COLLATE "C" NOT NULL,
    record_version BIGINT NOT NULL DEFAULT 1,
    superseded_at  TEXT COLLATE "C",
    UNIQUE (content_hash, settings_hash)
);

CREATE TABLE instances (
    parse_id       TEXT COLLATE "C" NOT NULL REFERENCES parses (id) ON DELETE CASCADE,
    id             BIGINT NOT NULL,
    body           TEXT NOT NULL,
    record_version BIGINT NOT NULL DEFAULT 1,
    PRIMARY KEY (parse_id, id)
);

CREATE TABLE scenes (
    id            TEXT COLLATE "C" PRIMARY KEY,
    name          TEXT NOT NULL,
    content_hash  TEXT COLLATE "C" NOT NULL REFERENCES contents (hash),
    parse_id      TEXT COLLATE "C" REFERENCES parses (id),
    parse_version BIGINT NOT NULL DEFAULT 0,
    job_id        TEXT COLLATE "C",
    created_at    TEXT COLLATE "C" NOT NULL,
    updated_at    TEXT COLLATE "C" NOT NULL,
    key_id        TEXT COLLATE "C",
    scene_to_map  TEXT,
    map_frame_id  TEXT,
    labels        TEXT NOT NULL DEFAULT '{}'
);
CREATE INDEX scenes_by_content ON scenes (content_hash);
CREATE INDEX scenes_by_parse ON scenes (parse_id);
CREATE INDEX scenes_by_key ON scenes (key_id);
CREATE INDEX scenes_by_labels ON scenes USING gin ((labels::jsonb) jsonb_path_ops);

CREATE TABLE answers (
    id             TEXT COLLATE "C" PRIMARY KEY,
    scene_id       TEXT COLLATE "C" NOT NULL REFERENCES scenes (id) ON DELETE CASCADE,
    parse_id       TEXT COLLATE "C" NOT NULL REFERENCES parses (id),
    body           TEXT NOT NULL,
    created_at     TEXT COLLATE "C" NOT NULL,
    record_version BIGINT NOT NULL DEFAULT 1,
    -- Its own is the first "status" in an answer: what is asked stands before it, with its quotes escaped. (As JSON, a question could hold what jsonb can not.)
    status         TEXT COLLATE "C" GENERATED ALWAYS AS (substring(body FROM '"status":"([a-z_]+)"')) STORED
);
CREATE INDEX answers_by_parse ON answers (parse_id);
CREATE INDEX answers_by_scene ON answers (scene_id, id);
CREATE INDEX answers_by_status ON answers (status, id);
CREATE INDEX answers_by_time ON answers (created_at);

CREATE TABLE jobs (
    id               TEXT COLLATE "C" PRIMARY KEY,
    kind             TEXT COLLATE "C" NOT NULL,
    subject          TEXT COLLATE "C" NOT NULL,
    payload          TEXT NOT NULL,
    state            TEXT COLLATE "C" NOT NULL CHECK (state IN ('queued', 'running', 'succeeded', 'failed', 'cancelled')),
    stage            TEXT,
    progress         DOUBLE PRECISION NOT NULL DEFAULT 0,
    attempts         BIGINT NOT NULL DEFAULT 0,
    message          TEXT,
    error_code       TEXT,
    error            TEXT,
    created_at       TEXT COLLATE "C" NOT NULL,
    started_at       TEXT COLLATE "C",
    finished_at      TEXT COLLATE "C",
    cancel_requested BIGINT NOT NULL DEFAULT 0,
    not_before       TEXT COLLATE "C",
    record_version   BIGINT NOT NULL DEFAULT 1,
    interruptions    BIGINT NOT NULL DEFAULT 0,
    furthest         DOUBLE PRECISION NOT NULL DEFAULT 0,
    key_id           TEXT COLLATE "C",
    failures         BIGINT NOT NULL DEFAULT 0
);
CREATE INDEX jobs_by_kind ON jobs (kind, state, id);
CREATE INDEX jobs_by_key ON jobs (kind, key_id, started_at);
CREATE INDEX jobs_by_subject_and_time ON jobs (subject, id);

CREATE TABLE idempotency_keys (
    key        TEXT COLLATE "C" PRIMARY KEY,
    scene_id   TEXT COLLATE "C" NOT NULL REFERENCES scenes (id) ON DELETE CASCADE,
    created_at TEXT COLLATE "C" NOT NULL,
    request    TEXT
);
CREATE INDEX idempotency_keys_by_scene ON idempotency_keys (scene_id);

CREATE TABLE question_keys (
    key        TEXT COLLATE "C" PRIMARY KEY,
    request    TEXT NOT NULL,
    answer_id  TEXT COLLATE "C" NOT NULL,
    created_at TEXT COLLATE "C" NOT NULL
);

CREATE TABLE instance_names (
    parse_id       TEXT COLLATE "C" NOT NULL REFERENCES parses (id) ON DELETE CASCADE,
    model          TEXT COLLATE "C" NOT NULL,
    prompt_version BIGINT NOT NULL,
    instance_id    BIGINT NOT NULL,
    name           TEXT NOT NULL,
    created_at     TEXT COLLATE "C" NOT NULL,
    PRIMARY KEY (parse_id, model, prompt_version, instance_id)
);

CREATE TABLE name_indexes (
    parse_id       TEXT COLLATE "C" NOT NULL REFERENCES parses (id) ON DELETE CASCADE,
    model          TEXT COLLATE "C" NOT NULL,
    prompt_version BIGINT NOT NULL,
    created_at     TEXT COLLATE "C" NOT NULL,
    PRIMARY KEY (parse_id, model, prompt_version)
);

CREATE TABLE spending (
    day TEXT COLLATE "C" PRIMARY KEY,
    usd DOUBLE PRECISION NOT NULL
);

CREATE TABLE reservations (
    id     TEXT COLLATE "C" PRIMARY KEY,
    day    TEXT COLLATE "C" NOT NULL,
    usd    DOUBLE PRECISION NOT NULL,
    key_id TEXT COLLATE "C"
);

CREATE TABLE key_spending (
    key_id TEXT COLLATE "C" NOT NULL,
    day    TEXT COLLATE "C" NOT NULL,
    usd    DOUBLE PRECISION NOT NULL,
    PRIMARY KEY (key_id, day)
);

CREATE TABLE batches (
    id           TEXT COLLATE "C" PRIMARY KEY,
    label        TEXT,
    state        TEXT COLLATE "C" NOT NULL CHECK (state IN ('receiving', 'running', 'paused', 'succeeded', 'cancelled')),
    reason       TEXT,
    items        BIGINT NOT NULL DEFAULT 0,
    concurrency  BIGINT,
    max_cost_usd DOUBLE PRECISION,
    job_id       TEXT COLLATE "C",
    key          TEXT COLLATE "C" UNIQUE,
    request      TEXT,
    created_at   TEXT COLLATE "C" NOT NULL,
    finished_at  TEXT COLLATE "C",
    key_id       TEXT COLLATE "C"
);

CREATE TABLE batch_items (
    batch_id   TEXT COLLATE "C" NOT NULL REFERENCES batches (id) ON DELETE CASCADE,
    item       BIGINT NOT NULL,
    scene_id   TEXT COLLATE "C" NOT NULL,
    request    TEXT NOT NULL,
    answer_id  TEXT COLLATE "C" NOT NULL,
    status     TEXT,
    cost_usd   DOUBLE PRECISION NOT NULL DEFAULT 0,
    error_code TEXT,
    error      TEXT,
    PRIMARY KEY (batch_id, item)
);
CREATE INDEX batch_items_open ON batch_items (batch_id, item) WHERE status IS NULL;
CREATE INDEX batch_items_by_answer ON batch_items (batch_id, answer_id);

CREATE TABLE keys (
    id                  TEXT COLLATE "C" PRIMARY KEY,
    name                TEXT NOT NULL,
    prefix              TEXT COLLATE "C" NOT NULL UNIQUE,
    hash                TEXT NOT NULL,
    scope               TEXT NOT NULL CHECK (scope IN ('read', 'write', 'admin')),
    expires_at          TEXT COLLATE "C",
    requests_per_minute BIGINT,
    max_scenes          BIGINT,
    daily_usd           DOUBLE PRECISION,
    created_at          TEXT COLLATE "C" NOT NULL,
    last_used_at        TEXT COLLATE "C",
    revoked_at          TEXT COLLATE "C"
);

CREATE TABLE audit (
    id         TEXT COLLATE "C" PRIMARY KEY,
    at         TEXT COLLATE "C" NOT NULL,
    key_id     TEXT COLLATE "C",
    method     TEXT NOT NULL,
    path       TEXT NOT NULL,
    status     BIGINT NOT NULL,
    request_id TEXT
);

CREATE TABLE announcements (
    job_id     TEXT COLLATE "C" PRIMARY KEY REFERENCES jobs (id) ON DELETE CASCADE,
    attempts   BIGINT NOT NULL DEFAULT 0,
    not_before TEXT COLLATE "C"
);

CREATE TABLE corrections (
    id         TEXT COLLATE "C" PRIMARY KEY,
    parse_id   TEXT COLLATE "C" NOT NULL REFERENCES parses (id) ON DELETE CASCADE,
    change     TEXT NOT NULL,
    made       BIGINT,
    author     TEXT,
    created_at TEXT COLLATE "C" NOT NULL,
    undone_at  TEXT COLLATE "C"
);
CREATE INDEX corrections_by_parse ON corrections (parse_id);

CREATE TABLE uploads (
    id         TEXT COLLATE "C" PRIMARY KEY,
    key_id     TEXT COLLATE "C",
    wanted     TEXT NOT NULL,
    length     BIGINT NOT NULL,
    received   BIGINT NOT NULL DEFAULT 0,
    scene_id   TEXT COLLATE "C",
    job_id     TEXT COLLATE "C",
    problem    TEXT,
    created_at TEXT COLLATE "C" NOT NULL,
    updated_at TEXT COLLATE "C" NOT NULL
);
CREATE INDEX unfinished_uploads ON uploads (updated_at) WHERE scene_id IS NULL AND problem IS NULL;

CREATE TABLE scene_changes (
    scene_id   TEXT COLLATE "C" NOT NULL REFERENCES scenes (id) ON DELETE CASCADE,
    parse_id   TEXT COLLATE "C" NOT NULL,
    from_parse TEXT COLLATE "C" NOT NULL,
    version    BIGINT,
    body       TEXT NOT NULL,
    created_at TEXT COLLATE "C" NOT NULL,
    PRIMARY KEY (scene_id, parse_id)
);
