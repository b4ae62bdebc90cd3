"""Folders and arrays on their way to the server."""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image

from uniground import Client, Scan, Scene, boxes
from uniground._scan import _png, packed, read_ply


def in_memory(file: Path) -> Scan:
    with zipfile.ZipFile(file) as archive:
        manifest = json.loads(archive.read("scene.json"))
        frames = manifest["frames"]
        k = manifest["intrinsics"]

        def picture(name: str) -> npt.NDArray[Any]:
            return np.asarray(Image.open(io.BytesIO(archive.read(name))))

        return Scan(
            images=[picture(frame["color"]) for frame in frames],
            depths=[picture(frame["depth"]).astype(float) / 1000 for frame in frames],
            poses=[np.array(archive.read(frame["pose"]).split(), dtype=float).reshape(4, 4) for frame in frames],
            intrinsics=[[k["fx"], 0, k["cx"]], [0, k["fy"], k["cy"]], [0, 0, 1]],
            up=manifest.get("up"),
        )


def test_arrays_are_the_scan_that_they_came_from(client: Client, few_frames: Path) -> None:
    arrays, file = (client.upload(scan).wait() for scan in (in_memory(few_frames), few_frames))
    # JPEG decoders differ in single bits, so instances differ a little; geometry does not.
    [ours, theirs] = (one.info.import_ for one in (arrays, file))
    assert ours is not None
    assert theirs is not None
    assert ours.reprojection_agreement == pytest.approx(theirs.reprojection_agreement, abs=0.01)
    assert (ours.frames, ours.pose, ours.camera_axes, ours.warnings) == (5, "camera_to_world", "opencv", theirs.warnings)
    [box, same] = (one.ask("the white bookcase").boxes() for one in (arrays, file))
    assert box == pytest.approx(same, abs=0.05)
    assert len(box) == 1


def test_points_alone_are_a_scan(client: Client, scene: Scene, tmp_path: Path) -> None:
    cloud = scene.cloud()
    Scan(points=cloud.points, colors=cloud.colors, up="z").save(tmp_path / "points.zip")
    with zipfile.ZipFile(tmp_path / "points.zip") as archive:
        (tmp_path / "points.ply").write_bytes(archive.read("cloud.ply"))
    assert np.array_equal(read_ply((tmp_path / "points.ply").read_bytes()).points, cloud.points)
    [whole, bare] = [client.upload(tmp_path / name, up="z") for name in ("points.zip", "points.ply")]
    assert np.array_equal(boxes(whole.wait().instances()), boxes(bare.wait().instances()))
    assert len(whole.instances()) > 50


def test_a_folder_is_packed_the_same_each_time(client: Client, few_frames: Path, tmp_path: Path) -> None:
    with zipfile.ZipFile(few_frames) as archive:
        archive.extractall(tmp_path / "room")
    (tmp_path / "room/.DS_Store").write_bytes(b"not for you")
    [one, two] = [packed(tmp_path / "room") for _ in range(2)]
    with one.file, two.file:
        assert zipfile.ZipFile(one.file).namelist()[:2] == ["color/0.jpg", "color/12.jpg"]
        for file in (one.file, two.file):
            file.seek(0)
        assert one.file.read() == two.file.read()
    [first, second] = [client.upload(tmp_path / "room", parse=False, idempotency_key="folder") for _ in range(2)]
    assert first.id == second.id
    assert first.status == "uploaded"


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_pictures_are_read_as_they_were_written(kind: type) -> None:
    shape = (7, 5, 3) if kind is np.uint8 else (7, 5)
    pixels: npt.NDArray[Any] = np.random.default_rng(1).integers(0, np.iinfo(kind).max, shape).astype(kind)
    assert np.array_equal(np.asarray(Image.open(io.BytesIO(_png(pixels)))), pixels)


def test_depth_without_a_measurement_is_nought(tmp_path: Path) -> None:
    depth = np.array([[np.nan, np.inf], [-1.0, 1.234], [65.6, 0.0]])
    frame = {"images": [np.zeros((3, 2, 3))], "poses": [np.eye(4)], "intrinsics": np.eye(3)}
    for depths, expected in ((depth, 1234), (np.full((3, 2), 1234, np.int32), 1234)):
        Scan(depths=[depths], **frame).save(tmp_path / "scan.zip")  # type: ignore[arg-type]
        with zipfile.ZipFile(tmp_path / "scan.zip") as archive:
            written = np.asarray(Image.open(io.BytesIO(archive.read("depth/0.png"))))
        assert written[1, 1] == expected
    assert (written > 0).sum() == 6


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"poses": []}, "1 images, 1 depths, 0 poses, 1 intrinsics"),
        ({"depths": None}, "missing: depths"),
        ({"images": [np.zeros((2, 2))]}, r"images\[0\] must be HxWx3"),
        ({"images": [np.zeros((2, 2, 3), np.int64)]}, "8-bit or floats"),
        ({"depths": [np.zeros(2)]}, r"depths\[0\] must be HxW"),
        ({"poses": [np.eye(3)]}, r"poses\[0\] must be 4x4"),
        ({"intrinsics": np.eye(2)}, "intrinsics must be 3x3"),
        ({"points": np.zeros((2, 2))}, "points must be Nx3"),
        ({"points": np.zeros((2, 3)), "colors": np.zeros((1, 3))}, "2 points, 1 colors"),
    ],
)
def test_arrays_of_a_wrong_shape_are_named(wrong: dict[str, object], said: str) -> None:
    right = {"images": [np.zeros((2, 2, 3))], "depths": [np.zeros((2, 2))], "poses": [np.eye(4)], "intrinsics": np.eye(3)}
    with pytest.raises(ValueError, match=said):
        Scan(**{**right, **wrong}).save(io.BytesIO())  # type: ignore[arg-type]


def test_what_is_no_scan_is_refused_here(client: Client, tmp_path: Path) -> None:
    (tmp_path / "room.las").write_bytes(b"")
    (tmp_path / "empty").mkdir()
    for name, error in (("room.las", "neither a folder nor"), ("empty", "is empty"), ("nowhere", "there is no")):
        with pytest.raises((ValueError, FileNotFoundError), match=error):
            client.upload(tmp_path / name)
