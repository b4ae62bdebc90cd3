-- Uploads that come in parts. Their bytes are a file of their id, in `uploads/`.
CREATE TABLE uploads (
    id         TEXT PRIMARY KEY NOT NULL,
    -- Whose it is: nobody else is told of it.
    key_id     TEXT,
    -- What is to be made of it, as JSON.
    wanted     TEXT NOT NULL,
    -- Bytes it will have; those that are on the disk. Written after the bytes: what a file has beyond them was promised to nobody.
    length     INTEGER NOT NULL,
    received   INTEGER NOT NULL DEFAULT 0,
    -- What came of it: a scene with its first job, or why there is none, as JSON.
    scene_id   TEXT,
    job_id     TEXT,
    problem    TEXT,
    created_at TEXT NOT NULL,
    -- When the last of its bytes came, or what came of it.
    updated_at TEXT NOT NULL
) STRICT, WITHOUT ROWID;
CREATE INDEX unfinished_uploads ON uploads (updated_at) WHERE scene_id IS NULL AND problem IS NULL;
