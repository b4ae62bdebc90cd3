-- The answer that an idempotency key of a question stands for; written before the question is asked, so the answer may not be there yet.
CREATE TABLE question_keys (
    key TEXT PRIMARY KEY NOT NULL,
    -- SHA-256 of what was asked.
    request TEXT NOT NULL,
    answer_id TEXT NOT NULL,
    created_at TEXT NOT NULL
) STRICT;
