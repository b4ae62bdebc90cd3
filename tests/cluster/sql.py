"""Queries PostgreSQL with psql."""
import csv
import io
import subprocess


class Database:
    """A database at a URL."""

    def __init__(self, address):
        self.address = address

    def rows(self, statement):
        """Returns the rows of a statement by column name; every value is text."""
        return list(csv.DictReader(io.StringIO(self.run(statement, "--csv"))))

    def value(self, statement):
        return next(iter(self.rows(statement)[0].values()))

    def run(self, statement, *flags):
        command = ["psql", "--no-psqlrc", "--quiet", "--set", "ON_ERROR_STOP=1", *flags, "--command", statement, self.address]
        done = subprocess.run(command, capture_output=True, text=True, timeout=120)
        if done.returncode:
            raise RuntimeError(f"{statement[:200]}: {done.stderr.strip()}")
        return done.stdout


# Recorded by triggers of the database, so that no process can omit it: how often each job finished or was reopened, how often each batch item was
# closed, and when each answer was stored.
WITNESS = """
CREATE TABLE witness (what TEXT, id TEXT, change TEXT, at TIMESTAMPTZ NOT NULL DEFAULT clock_timestamp());
CREATE FUNCTION witness_job() RETURNS trigger LANGUAGE plpgsql AS
'BEGIN INSERT INTO witness (what, id, change) VALUES (''job'', NEW.id, OLD.state || '' '' || NEW.state); RETURN NULL; END';
CREATE TRIGGER witness_job AFTER UPDATE OF state ON jobs FOR EACH ROW
WHEN (OLD.state IS DISTINCT FROM NEW.state) EXECUTE FUNCTION witness_job();
CREATE FUNCTION witness_item() RETURNS trigger LANGUAGE plpgsql AS
'BEGIN INSERT INTO witness (what, id, change) VALUES (''item'', NEW.batch_id || '' '' || NEW.item, NEW.status); RETURN NULL; END';
CREATE TRIGGER witness_item AFTER UPDATE OF status ON batch_items FOR EACH ROW EXECUTE FUNCTION witness_item();
CREATE FUNCTION witness_answer() RETURNS trigger LANGUAGE plpgsql AS
'BEGIN INSERT INTO witness (what, id, change) VALUES (''answer'', NEW.id, (NEW.body::json) ->> ''query''); RETURN NULL; END';
CREATE TRIGGER witness_answer AFTER INSERT ON answers FOR EACH ROW EXECUTE FUNCTION witness_answer();
"""
