"""Reads the database of a stopped or killed server. Opens only a copy, so that reading does not clean up what the next server must handle."""
import json
import shutil
import sqlite3
import tempfile
from contextlib import closing
from pathlib import Path


class Records:
    """A copy of the database as it was on the disk."""

    def __init__(self, data):
        self.folder = tempfile.TemporaryDirectory()
        for suffix in ("", "-wal"):
            file = Path(data) / f"uniground.sqlite{suffix}"
            if file.exists():
                shutil.copy(file, self.folder.name)
        self.database = sqlite3.connect(Path(self.folder.name) / "uniground.sqlite")

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.database.close()
        self.folder.cleanup()

    def rows(self, sql, *values):
        with closing(self.database.execute(sql, values)) as found:
            names = [column[0] for column in found.description]
            return [dict(zip(names, row)) for row in found]

    def value(self, sql, *values):
        return next(iter(self.rows(sql, *values)[0].values()))

    def kept_items(self):
        """Returns the batch items with a stored answer, closed or not: batch and item number."""
        return {(row["batch_id"], row["item"]) for row in
                self.rows("SELECT batch_id, item FROM batch_items JOIN answers ON answers.id = answer_id")}

    def reserved_usd(self):
        return self.value("SELECT total(usd) FROM reservations")

    def spent_usd(self):
        return self.value("SELECT total(usd) FROM spending")

    def open_items(self):
        return self.value("SELECT count(*) FROM batch_items WHERE status IS NULL")

    def jobs(self):
        return self.rows("SELECT id, kind, state, progress, attempts, interruptions, furthest, not_before, error_code, error FROM jobs")

    def answers_by_query(self):
        """Returns the number of answers to each question."""
        numbers = {}
        for row in self.rows("SELECT body FROM answers"):
            query = json.loads(row["body"])["query"]
            numbers[query] = numbers.get(query, 0) + 1
        return numbers
