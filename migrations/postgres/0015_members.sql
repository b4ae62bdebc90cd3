-- What each column means is said in SQLite's migration of the same number.
CREATE TABLE members (
    id      TEXT COLLATE "C" PRIMARY KEY,
    session BIGINT,
    seen_at DOUBLE PRECISION NOT NULL
);

ALTER TABLE jobs ADD COLUMN holder TEXT COLLATE "C";
ALTER TABLE batches ADD COLUMN receiver TEXT COLLATE "C";
ALTER TABLE reservations ADD COLUMN member TEXT COLLATE "C";
ALTER TABLE parses ADD COLUMN changes BIGINT NOT NULL DEFAULT 0;
CREATE INDEX jobs_by_state ON jobs (state, id);

-- Processes that wait are woken: a job that waits by its kind, a key that was made or revoked.
CREATE FUNCTION tell_of_job() RETURNS trigger LANGUAGE plpgsql AS
'BEGIN PERFORM pg_notify(''uniground_job'', NEW.kind); RETURN NULL; END';
CREATE TRIGGER jobs_that_wait AFTER INSERT OR UPDATE OF state ON jobs FOR EACH ROW
WHEN (NEW.state = 'queued') EXECUTE FUNCTION tell_of_job();

CREATE FUNCTION tell_of_keys() RETURNS trigger LANGUAGE plpgsql AS
'BEGIN PERFORM pg_notify(''uniground_keys'', ''''); RETURN NULL; END';
CREATE TRIGGER keys_that_change AFTER INSERT OR UPDATE OF revoked_at ON keys FOR EACH STATEMENT EXECUTE FUNCTION tell_of_keys();

-- Requests of keys that may not come as often as they like: when all of what they may is there again, seconds of Unix time. Only here: a single
-- process counts in memory.
CREATE UNLOGGED TABLE key_rates (
    key_id  TEXT COLLATE "C" PRIMARY KEY,
    full_at DOUBLE PRECISION NOT NULL
);
