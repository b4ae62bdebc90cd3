"""Scans on their way to the server: folders and numpy arrays as archives, clouds as arrays."""

from __future__ import annotations

import json
import os
import shutil
import struct
import tempfile
import zipfile
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Literal, NamedTuple, Optional, Union, cast

import numpy as np
import numpy.typing as npt

from uniground.models import UpAxis

MEDIA_TYPES = {".zip": "application/zip", ".tar": "application/x-tar", ".zst": "application/zstd"}
MILLIMETRES_PER_METRE = 1000
# Already compressed: packing them again takes time and saves nothing.
COMPRESSED = {".jpg", ".jpeg", ".png"}


@dataclass
class Scan:
    """A scan in memory: pictures with depth and poses, points, or both.

    Without points the server fuses a cloud from the frames; points alone are a scan too, without photographs.
    """

    images: Optional[Sequence[npt.ArrayLike]] = None
    """Per frame HxWx3, RGB: 8 bits, or floats in 0..1."""
    depths: Optional[Sequence[npt.ArrayLike]] = None
    """Per frame HxW: floats are metres, integers millimetres; 0 or not finite: no measurement. May be smaller than the images."""
    poses: Optional[Sequence[npt.ArrayLike]] = None
    """Per frame 4x4, metres: takes points of the camera to the world, unless `pose` says otherwise."""
    intrinsics: Optional[npt.ArrayLike] = None
    """Of the images, 3x3, pixels; or one per frame, Nx3x3."""
    depth_intrinsics: Optional[npt.ArrayLike] = None
    """Of the depths, 3x3, where they have another field of view than the images."""
    points: Optional[npt.ArrayLike] = None
    """Nx3, metres, world frame."""
    colors: Optional[npt.ArrayLike] = None
    """Of the points, Nx3, RGB: 8 bits, or floats in 0..1."""
    up: Optional[UpAxis] = None
    """The world axis that points up; left out: the one that the cameras hold up."""
    camera_axes: Literal["opencv", "opengl", "ros"] = "opencv"
    """`opencv`: x right, y down, z forward. `opengl`: x right, y up, z backward. `ros`: x forward, y left, z up."""
    pose: Literal["camera_to_world", "world_to_camera"] = "camera_to_world"
    """What a pose does."""
    name: str = "scan"

    def save(self, file: Union[str, os.PathLike[str], BinaryIO]) -> None:
        """Writes a zip archive in the service's own layout; the same arrays make the same bytes."""
        frames = list(zip(*self._frames()))
        manifest: dict[str, Any] = {
            "format": "uniground-scene/1",
            "name": self.name,
            "camera_axes": self.camera_axes,
            "pose": self.pose,
            "depth_scale_m": 1 / MILLIMETRES_PER_METRE,
            "frames": [{"color": f"color/{n}.png", "depth": f"depth/{n}.png", "pose": f"pose/{n}.txt"} for n in range(len(frames))],
        }
        if self.up:
            manifest["up"] = self.up
        with zipfile.ZipFile(file, "w") as archive:
            for n, (image, depth, pose, intrinsics) in enumerate(frames):
                pixels, millimetres = _rgb(image, f"images[{n}]"), _millimetres(depth, f"depths[{n}]")
                add(archive, f"color/{n}.png", _png(pixels))
                add(archive, f"depth/{n}.png", _png(millimetres))
                add(archive, f"pose/{n}.txt", _pose(pose, f"poses[{n}]").encode())
                manifest["frames"][n]["intrinsics"] = _camera(intrinsics, pixels.shape)
                if self.depth_intrinsics is not None:
                    manifest["depth_intrinsics"] = _camera(self.depth_intrinsics, millimetres.shape)
            if self.points is not None:
                manifest["cloud"] = "cloud.ply"
                add(archive, "cloud.ply", _ply(self.points, self.colors))
            add(archive, "scene.json", json.dumps(manifest, indent=1).encode())

    def _frames(self) -> tuple[Sequence[Any], ...]:
        given = {"images": self.images, "depths": self.depths, "poses": self.poses, "intrinsics": self.intrinsics}
        missing = [name for name, of in given.items() if of is None]
        if len(missing) == len(given) and self.points is not None:
            return (), (), (), ()
        if missing:
            raise ValueError(f"a scan wants images, depths, poses and intrinsics, or points alone; missing: {', '.join(missing)}")
        images, depths, poses = (cast("Sequence[Any]", given[name]) for name in ("images", "depths", "poses"))
        intrinsics = np.asarray(self.intrinsics, dtype=float)
        each = [intrinsics] * len(images) if intrinsics.ndim == 2 else list(intrinsics)
        if not len(images) == len(depths) == len(poses) == len(each):
            counts = f"{len(images)} images, {len(depths)} depths, {len(poses)} poses, {len(each)} intrinsics"
            raise ValueError(f"every frame wants an image, a depth and a pose; these are {counts}")
        return images, depths, poses, each


Source = Union[str, "os.PathLike[str]", Scan]


class Archive(NamedTuple):
    """An archive that is open for reading."""

    file: Any
    size: int
    media_type: str


def packed(source: Source) -> Archive:
    """A scan as an archive: an archive's file as it is, a folder, a PLY file or arrays packed into a file that vanishes when closed."""
    path = None if isinstance(source, Scan) else Path(source)
    if path is not None and path.suffix.lower() in MEDIA_TYPES and path.is_file():
        file: Any = path.open("rb")
        return Archive(file, path.stat().st_size, MEDIA_TYPES[path.suffix.lower()])
    if path is not None and not path.exists():
        raise FileNotFoundError(f"there is no {path}")
    file = tempfile.TemporaryFile()  # noqa: SIM115, closed by the caller
    try:
        if isinstance(source, Scan):
            source.save(cast(BinaryIO, file))
        else:
            _pack(cast(Path, path), cast(BinaryIO, file))
    except BaseException:
        file.close()
        raise
    return Archive(file, file.tell(), MEDIA_TYPES[".zip"])


def _pack(path: Path, file: BinaryIO) -> None:
    if path.is_dir():
        # Hidden files are the file manager's and git's. Sorted, and without times: the same folder is the same archive.
        inside = sorted(found for found in path.rglob("*") if found.is_file())
        names = {found.relative_to(path): found for found in inside}
        files = {name.as_posix(): found for name, found in names.items() if not any(part.startswith(".") for part in name.parts)}
    elif path.suffix.lower() == ".ply":
        files = {"cloud.ply": path}
    else:
        raise ValueError(f"{path} is neither a folder nor one of {', '.join(MEDIA_TYPES)}, .ply")
    if not files:
        raise ValueError(f"{path} is empty")
    with zipfile.ZipFile(file, "w", allowZip64=True) as archive:
        for name, found in files.items():
            with found.open("rb") as content, archive.open(entry(name), "w", force_zip64=True) as into:
                shutil.copyfileobj(content, into)


def add(archive: zipfile.ZipFile, name: str, content: bytes) -> None:
    archive.writestr(entry(name), content)


def entry(name: str) -> zipfile.ZipInfo:
    info = zipfile.ZipInfo(name)
    info.compress_type = zipfile.ZIP_STORED if Path(name).suffix.lower() in COMPRESSED else zipfile.ZIP_DEFLATED
    return info


class Cloud(NamedTuple):
    """Points of a scene, world frame: metres, Z up."""

    points: npt.NDArray[np.float32]
    """Nx3, metres."""
    colors: npt.NDArray[np.uint8]
    """Nx3, RGB."""
    instances: Optional[npt.NDArray[np.int32]]
    """Id of the thing that each point belongs to, 0: none; `None` unless asked for."""


PLY_TYPES = {"float": "<f4", "double": "<f8", "uchar": "u1", "int": "<i4"}


def read_ply(content: bytes) -> Cloud:
    """A cloud as the service sends it: binary, vertices only."""
    head, _, body = content.partition(b"end_header\n")
    words = [line.split() for line in head.decode().splitlines()]
    count = next(int(line[2]) for line in words if line[:2] == ["element", "vertex"])
    fields = [(line[2], PLY_TYPES[line[1]]) for line in words if line[0] == "property"]
    vertices = np.frombuffer(body, dtype=np.dtype(fields), count=count)

    def columns(*names: str) -> Any:
        return np.stack([vertices[name] for name in names], axis=1)

    ids = vertices["instance"] if "instance" in (vertices.dtype.names or ()) else None
    return Cloud(columns("x", "y", "z"), columns("red", "green", "blue"), ids)


def _ply(points: npt.ArrayLike, colors: Optional[npt.ArrayLike]) -> bytes:
    xyz = np.asarray(points, dtype="<f4")
    if xyz.ndim != 2 or xyz.shape[1] != 3:
        raise ValueError(f"points must be Nx3, not {xyz.shape}")
    fields = [(axis, "<f4") for axis in "xyz"]
    values: dict[str, Any] = {axis: xyz[:, n] for n, axis in enumerate("xyz")}
    if colors is not None:
        rgb = _rgb(np.asarray(colors)[None], "colors")[0]
        if len(rgb) != len(xyz):
            raise ValueError(f"every point wants a colour; these are {len(xyz)} points, {len(rgb)} colors")
        fields += [(name, "u1") for name in ("red", "green", "blue")]
        values.update(zip(("red", "green", "blue"), rgb.T))
    vertices = np.empty(len(xyz), dtype=np.dtype(fields))
    for name, column in values.items():
        vertices[name] = column
    kinds = {"<f4": "float", "u1": "uchar"}
    properties = "".join(f"property {kinds[kind]} {name}\n" for name, kind in fields)
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(xyz)}\n{properties}end_header\n"
    return head.encode() + vertices.tobytes()


def _rgb(image: npt.ArrayLike, name: str) -> npt.NDArray[np.uint8]:
    pixels = np.asarray(image)
    if pixels.ndim != 3 or pixels.shape[2] != 3:
        raise ValueError(f"{name} must be HxWx3 (RGB), not {pixels.shape}")
    if np.issubdtype(pixels.dtype, np.floating):
        pixels = np.round(np.clip(pixels, 0, 1) * 255)
    elif pixels.dtype != np.uint8:
        raise ValueError(f"{name} must be 8-bit or floats in 0..1, not {pixels.dtype}")
    return pixels.astype(np.uint8)


def _millimetres(depth: npt.ArrayLike, name: str) -> npt.NDArray[np.uint16]:
    measured = np.asarray(depth)
    if measured.ndim != 2:
        raise ValueError(f"{name} must be HxW, not {measured.shape}")
    if np.issubdtype(measured.dtype, np.floating):
        measured = np.round(np.where(np.isfinite(measured), measured, 0) * MILLIMETRES_PER_METRE)
    # What 16 bits do not hold is farther than 65 m: no measurement of a room.
    return np.where((measured > 0) & (measured < 1 << 16), measured, 0).astype(np.uint16)


def _pose(pose: npt.ArrayLike, name: str) -> str:
    matrix = np.asarray(pose, dtype=float)
    if matrix.shape != (4, 4):
        raise ValueError(f"{name} must be 4x4, not {matrix.shape}")
    return "\n".join(" ".join(repr(float(value)) for value in line) for line in matrix)


def _camera(matrix: npt.ArrayLike, shape: tuple[int, ...]) -> dict[str, float]:
    k = np.asarray(matrix, dtype=float)
    if k.shape not in ((3, 3), (4, 4)):
        raise ValueError(f"intrinsics must be 3x3, not {k.shape}")
    focal = {"fx": float(k[0, 0]), "fy": float(k[1, 1]), "cx": float(k[0, 2]), "cy": float(k[1, 2])}
    return {"width": shape[1], "height": shape[0], **focal}


def _png(pixels: npt.NDArray[Any]) -> bytes:
    """8-bit RGB or 16-bit grey. Written here so that no library of pictures is needed."""
    height, width = pixels.shape[:2]
    depth, kind = (8, 2) if pixels.ndim == 3 else (16, 0)
    lines = pixels.astype(pixels.dtype.newbyteorder(">")).view(np.uint8).reshape(height, -1)
    # Filter 2, the difference to the line above, packs photographs and depth well.
    above = np.vstack([np.zeros_like(lines[:1]), lines[:-1]])
    filtered = np.hstack([np.full((height, 1), 2, np.uint8), lines - above])

    def chunk(name: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content))

    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, depth, kind, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", zlib.compress(filtered.tobytes(), 6)) + chunk(b"IEND", b"")
