-- Conversation that an answer belongs to: the id of the caller's key, if it has one, and the id that the client chose. NULL without a conversation.
ALTER TABLE answers ADD COLUMN session TEXT;
CREATE INDEX answers_by_session ON answers (session, scene_id, id) WHERE session IS NOT NULL;
