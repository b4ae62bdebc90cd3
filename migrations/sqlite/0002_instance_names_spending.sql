-- Names that a vision-language model gave to instances without regard to any question.
CREATE TABLE instance_names (
    parse_id       TEXT NOT NULL REFERENCES parses (id) ON DELETE CASCADE,
    model          TEXT NOT NULL,
    prompt_version INTEGER NOT NULL,
    instance_id    INTEGER NOT NULL,
    name           TEXT NOT NULL,
    created_at     TEXT NOT NULL,
    PRIMARY KEY (parse_id, model, prompt_version, instance_id)
) WITHOUT ROWID;

-- What was paid to models, by day (UTC).
CREATE TABLE spending (
    day TEXT PRIMARY KEY,
    usd REAL NOT NULL
) WITHOUT ROWID;
