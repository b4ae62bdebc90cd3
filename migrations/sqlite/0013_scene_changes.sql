-- What changed in a scene that has grown, from one parse of it to the next. Kept when the parses themselves are not any more.
CREATE TABLE scene_changes (
    scene_id    TEXT NOT NULL REFERENCES scenes (id) ON DELETE CASCADE,
    parse_id    TEXT NOT NULL,
    from_parse  TEXT NOT NULL,
    -- That of the scene with this parse; NULL until the scene has it.
    version     INTEGER,
    body        TEXT NOT NULL,
    created_at  TEXT NOT NULL,
    PRIMARY KEY (scene_id, parse_id)
) STRICT;

-- What a scene was made of before frames were added to it; NULL for what was uploaded.
ALTER TABLE contents ADD COLUMN grown_from TEXT;
