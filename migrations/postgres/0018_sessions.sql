-- What the column means is said in SQLite's migration of the same number.
ALTER TABLE answers ADD COLUMN session TEXT COLLATE "C";
CREATE INDEX answers_by_session ON answers (session, scene_id, id) WHERE session IS NOT NULL;
