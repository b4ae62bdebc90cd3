-- Where a scene lies in somebody's map (JSON), and what that map's frame is called.
ALTER TABLE scenes ADD COLUMN scene_to_map TEXT;
ALTER TABLE scenes ADD COLUMN map_frame_id TEXT;
