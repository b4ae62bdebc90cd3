-- A model has been shown everything of a parse that can be seen: from then on the names it gave are the same for every question.
CREATE TABLE name_indexes (
    parse_id       TEXT NOT NULL REFERENCES parses (id) ON DELETE CASCADE,
    model          TEXT NOT NULL,
    prompt_version INTEGER NOT NULL,
    created_at     TEXT NOT NULL,
    PRIMARY KEY (parse_id, model, prompt_version)
) STRICT;
