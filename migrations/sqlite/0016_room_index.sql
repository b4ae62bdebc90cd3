-- What the things of each parse are called, with their colours: which of many rooms are worth a look. Made from the parse, and made anew when what
-- is known of it changes.
CREATE TABLE room_entries (
    parse_id TEXT NOT NULL REFERENCES parses (id) ON DELETE CASCADE,
    name     TEXT NOT NULL,
    -- Empty: none in particular.
    colour   TEXT NOT NULL,
    -- How much it is believed, 0 to 1.
    weight   REAL NOT NULL,
    PRIMARY KEY (parse_id, name, colour)
) STRICT;
CREATE INDEX room_entries_by_name ON room_entries (name, weight);
CREATE INDEX room_entries_by_colour ON room_entries (name, colour, weight);

-- Every name among them, and some that no room has any more.
CREATE TABLE room_names (name TEXT PRIMARY KEY) STRICT;

-- The number of changes of which its entries are.
ALTER TABLE parses ADD COLUMN indexed INTEGER;
CREATE INDEX parses_to_index ON parses (id) WHERE indexed IS NULL OR indexed <> changes;
