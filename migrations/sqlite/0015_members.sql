-- Processes that use this database: one with SQLite, as many as there are with PostgreSQL.
CREATE TABLE members (
    id      TEXT PRIMARY KEY,
    -- That which holds its locks (PostgreSQL: a process id of the server's).
    session INTEGER,
    -- Seconds of Unix time, by the database's own clock.
    seen_at REAL NOT NULL
) STRICT;

-- The member at work on a job; it counts while the job is running.
ALTER TABLE jobs ADD COLUMN holder TEXT;

-- The member that receives a batch, until it is submitted.
ALTER TABLE batches ADD COLUMN receiver TEXT;

-- The member that has put money aside.
ALTER TABLE reservations ADD COLUMN member TEXT;

-- How often what is known of a parse has changed: names, corrections, what was found. What is kept in memory is of one of these.
ALTER TABLE parses ADD COLUMN changes INTEGER NOT NULL DEFAULT 0;

-- Lists of jobs in one state.
CREATE INDEX jobs_by_state ON jobs (state, id);
