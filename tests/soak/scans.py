"""Scans to upload: the sample room with different bytes each time, so that each is new to the server."""
import io
import json
import zipfile
from pathlib import Path

SAMPLE = Path(__file__).parent.parent.parent / "examples" / "living_room.zip"


class Scans:
    """Variants of one scan. All contain the same room, so their parses must be equal."""

    def __init__(self, frames=None):
        """`frames` limits the number of frames, for faster parses."""
        with zipfile.ZipFile(SAMPLE) as sample:
            self.files = {name: sample.read(name) for name in sample.namelist()}
        if frames:
            scene = json.loads(self.files["scene.json"])
            scene["frames"] = scene["frames"][:frames]
            self.files["scene.json"] = json.dumps(scene).encode()
            kept = {path for frame in scene["frames"] for path in frame.values() if isinstance(path, str)}
            self.files = {name: data for name, data in self.files.items() if name in kept or "/" not in name}

    def variant(self, name):
        """Returns the scan as a zip archive; every name gives different bytes."""
        archive = io.BytesIO()
        # Files that are already compressed do not get smaller.
        with zipfile.ZipFile(archive, "w", zipfile.ZIP_STORED) as target:
            for path, data in self.files.items():
                target.writestr(zipfile.ZipInfo(path), data)
            target.writestr(zipfile.ZipInfo("note.txt"), name)
        return archive.getvalue()
