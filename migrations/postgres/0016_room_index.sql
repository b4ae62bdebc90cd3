-- What each column means is said in SQLite's migration of the same number.
CREATE TABLE room_entries (
    parse_id TEXT COLLATE "C" NOT NULL REFERENCES parses (id) ON DELETE CASCADE,
    name     TEXT COLLATE "C" NOT NULL,
    colour   TEXT COLLATE "C" NOT NULL,
    weight   DOUBLE PRECISION NOT NULL,
    PRIMARY KEY (parse_id, name, colour)
);
CREATE INDEX room_entries_by_name ON room_entries (name, weight);
CREATE INDEX room_entries_by_colour ON room_entries (name, colour, weight);
CREATE TABLE room_names (name TEXT COLLATE "C" PRIMARY KEY);
ALTER TABLE parses ADD COLUMN indexed BIGINT;
CREATE INDEX parses_to_index ON parses (id) WHERE indexed IS NULL OR indexed <> changes;
