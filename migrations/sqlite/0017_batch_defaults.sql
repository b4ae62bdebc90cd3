-- Fields that all items of a batch share, as JSON: items store their own fields only. NULL in batches of before: their items store whole questions.
ALTER TABLE batches ADD COLUMN defaults TEXT;
