-- What people say of a parse that is wrong, in the order they said it; a row is never removed, only taken back.
CREATE TABLE corrections (
    id         TEXT PRIMARY KEY,
    parse_id   TEXT NOT NULL REFERENCES parses (id) ON DELETE CASCADE,
    change     TEXT NOT NULL,
    -- The instance a merge has made.
    made       INTEGER,
    -- Name of the key it was made with.
    author     TEXT,
    created_at TEXT NOT NULL,
    undone_at  TEXT
) STRICT;
CREATE INDEX corrections_by_parse ON corrections (parse_id);
