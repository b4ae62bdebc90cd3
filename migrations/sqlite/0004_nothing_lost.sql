-- Which data folder this database belongs to, and since when it knows what lies there: files that are older are not its to judge.
CREATE TABLE data_folder (
    id    TEXT NOT NULL,
    since TEXT NOT NULL
) STRICT;

-- What refers to a row is found without reading whole tables when that row goes.
CREATE INDEX answers_by_parse ON answers (parse_id);
CREATE INDEX scenes_by_parse ON scenes (parse_id);
CREATE INDEX idempotency_keys_by_scene ON idempotency_keys (scene_id);

-- What was asked for under a key: the same key with another request is a mistake.
ALTER TABLE idempotency_keys ADD COLUMN request TEXT;

-- How often in a row a job was interrupted without getting further than before, and how far it got.
ALTER TABLE jobs ADD COLUMN interruptions INTEGER NOT NULL DEFAULT 0;
ALTER TABLE jobs ADD COLUMN furthest REAL NOT NULL DEFAULT 0;

-- Money put aside for calls under way: what still stands here when a server starts may have been billed.
CREATE TABLE reservations (
    id  TEXT PRIMARY KEY,
    day TEXT NOT NULL,
    usd REAL NOT NULL
) STRICT;
