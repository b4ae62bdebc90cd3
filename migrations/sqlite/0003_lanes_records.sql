-- Jobs wait in a queue of their own kind; a wish to stop outlives the server; a job that is tried again waits until then.
ALTER TABLE jobs ADD COLUMN cancel_requested INTEGER NOT NULL DEFAULT 0;
ALTER TABLE jobs ADD COLUMN not_before TEXT;
DROP INDEX jobs_by_state;
CREATE INDEX jobs_by_kind ON jobs (kind, state, id);

-- Which version of its record the JSON of a row is.
ALTER TABLE parses ADD COLUMN record_version INTEGER NOT NULL DEFAULT 1;
ALTER TABLE instances ADD COLUMN record_version INTEGER NOT NULL DEFAULT 1;
ALTER TABLE answers ADD COLUMN record_version INTEGER NOT NULL DEFAULT 1;
ALTER TABLE jobs ADD COLUMN record_version INTEGER NOT NULL DEFAULT 1;
