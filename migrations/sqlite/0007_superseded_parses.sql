-- Since when neither a scene nor an answer has referred to a parse, as housekeeping saw it; NULL while one does.
ALTER TABLE parses ADD COLUMN superseded_at TEXT;
