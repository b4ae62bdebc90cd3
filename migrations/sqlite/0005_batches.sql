-- Lists of questions. A batch is asked by a job of the kind "batch"; what is finished stays finished, whatever becomes of the job.
CREATE TABLE batches (
    id           TEXT PRIMARY KEY,
    label        TEXT,
    -- 'receiving': its items are still coming in; nobody is told of it yet.
    state        TEXT NOT NULL CHECK (state IN ('receiving', 'running', 'paused', 'succeeded', 'cancelled')),
    -- Why it is paused, where nobody asked for that.
    reason       TEXT,
    items        INTEGER NOT NULL DEFAULT 0,
    concurrency  INTEGER,
    max_cost_usd REAL,
    job_id       TEXT,
    -- The idempotency key it was submitted under, and SHA-256 of what was submitted.
    key          TEXT UNIQUE,
    request      TEXT,
    created_at   TEXT NOT NULL,
    finished_at  TEXT
) STRICT;

CREATE TABLE batch_items (
    batch_id   TEXT NOT NULL REFERENCES batches (id) ON DELETE CASCADE,
    -- From 0, in the order they were submitted in.
    item       INTEGER NOT NULL,
    scene_id   TEXT NOT NULL,
    request    TEXT NOT NULL,
    -- Of the answer it will get: a server that is killed after the answer was kept, and before the item was closed, knows it again.
    answer_id  TEXT NOT NULL,
    -- Status of its answer, or 'failed'; none while it waits.
    status     TEXT,
    cost_usd   REAL NOT NULL DEFAULT 0,
    error_code TEXT,
    error      TEXT,
    PRIMARY KEY (batch_id, item)
) STRICT, WITHOUT ROWID;
CREATE INDEX batch_items_open ON batch_items (batch_id, item) WHERE status IS NULL;
