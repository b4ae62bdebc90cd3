-- What the column means is said in SQLite's migration of the same number.
ALTER TABLE batches ADD COLUMN defaults TEXT;
