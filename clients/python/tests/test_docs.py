"""Every block of Python in the documentation runs as printed, one after the other, in a folder with `examples` in it."""

from __future__ import annotations

import io
import json
import re
import zipfile
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from served import ROOT, SAMPLE

from uniground import Scene


def recording(file: Path) -> list[SimpleNamespace]:
    """What stands for a reader's own camera."""
    with zipfile.ZipFile(file) as archive:
        manifest = json.loads(archive.read("scene.json"))
        k = manifest["intrinsics"]
        return [
            SimpleNamespace(
                rgb=np.asarray(Image.open(io.BytesIO(archive.read(frame["color"])))),
                depth=np.asarray(Image.open(io.BytesIO(archive.read(frame["depth"])))),
                pose=np.array(archive.read(frame["pose"]).split(), dtype=float).reshape(4, 4),
                intrinsics=np.array([[k["fx"], 0, k["cx"]], [0, k["fy"], k["cy"]], [0, 0, 1]]),
            )
            for frame in manifest["frames"]
        ]


@pytest.mark.parametrize("page", ["clients/python/README.md", "docs/guides/python.md"])
@pytest.mark.usefixtures("scene")
def test_blocks_run_as_printed(
    page: str, few_frames: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "examples").mkdir()
    (tmp_path / "examples" / SAMPLE.name).write_bytes(SAMPLE.read_bytes())
    (tmp_path / "questions.txt").write_text("the sofa\nthe desk\n")
    text = (ROOT / page).read_text()
    blocks = re.findall(r"^```python\n(.*?)^```$", text, re.DOTALL | re.MULTILINE)
    assert len(blocks) >= 3
    names: dict[str, object] = {"__name__": page, "recording": recording(few_frames)}
    for block in blocks:
        exec(compile(block, page, "exec"), names)
    assert (tmp_path / "answer.jpg").read_bytes().startswith(b"\xff\xd8")
    for printed in re.findall(r"^```text\n(.*?)^```$", text, re.DOTALL | re.MULTILINE):
        assert printed in capsys.readouterr().out
    if "results.jsonl" in text:
        assert len((tmp_path / "results.jsonl").read_text().splitlines()) == 2


def test_help_shows_how_to_begin(scene: Scene) -> None:
    import uniground

    assert "Client().upload" in (uniground.__doc__ or "")
    assert repr(scene) == f"Scene('living room', {scene.id}, ready)"
