"""With the real libraries, where they are installed: they are large, so the gate leaves them out."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from uniground import Scene, viewers


def test_names_boxes_and_colours(scene: Scene) -> None:
    answer = scene.ask("the mug on the coffee table")
    [(name, box, green), (_, _, blue)] = viewers._boxes((answer, scene.instance(25)))
    assert (name, box, green) == ("orange mug", answer.oriented_box, viewers.GREEN)
    assert blue == viewers.BLUE


def test_a_library_that_is_not_there_is_named(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(ImportError, match=r"pip install 'uniground\[open3d\]'"):
        viewers.open3d_geometries(scene.cloud())


def test_open3d(scene: Scene) -> None:
    pytest.importorskip("open3d")
    answer = scene.ask("the mug on the coffee table")
    points, box = viewers.open3d_geometries(scene.cloud(), answer)
    assert answer.oriented_box is not None
    inside = len(box.get_point_indices_within_bounding_box(points.points))
    assert inside == answer.oriented_box.contains(scene.cloud().points).sum() > 50
    ours, theirs = (np.array(sorted(map(tuple, np.round(of, 4)))) for of in (answer.oriented_box.corners(), box.get_box_points()))
    assert ours == pytest.approx(theirs, abs=1e-3)


def test_rerun(scene: Scene, tmp_path: Path) -> None:
    rerun = pytest.importorskip("rerun")
    rerun.init("uniground")
    rerun.save(tmp_path / "room.rrd")
    viewers.log_rerun(scene.cloud(), scene.ask("how many mugs are there"), scene.instance(25))
    rerun.disconnect()
    assert (tmp_path / "room.rrd").stat().st_size > 1_000_000
