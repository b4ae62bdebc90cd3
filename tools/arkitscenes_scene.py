#!/usr/bin/env python3
"""Converts an ARKitScenes scan for uniground: VIDEO.zip, and VIDEO.scene.json with its annotated objects.

usage: arkitscenes_scene.py VIDEO_FOLDER OUT_FOLDER [--every N] [--scan-only]

VIDEO_FOLDER is 3dod/Training/VIDEO or raw/Training/VIDEO as downloaded. Required, in it or in VIDEO_frames/ below it:
    lowres_wide/  lowres_depth/  lowres_wide_intrinsics/  lowres_wide.traj, and optionally confidence/
and next to them, optionally:
    VIDEO_3dod_mesh.ply             the cloud; without it, the cloud is fused from the frames
    VIDEO_3dod_annotation.json      the objects; their ids are their places in its list, from 1

Pictures, poses and cloud keep their names, layout and world (Z up), which uniground reads; a picture without depth, camera or pose is
left out, which of raw's 60 a second are most. Boxes are segments.obbAligned: center, full extent, and the axes as rows. --scan-only is
for boxes from elsewhere (embodiedscan_boxes.py). The laser scans cannot be used as clouds, because their transform into the video's world is
not published. Needs only Python's standard library.
"""
import argparse
import math
import zipfile
from bisect import bisect_left
from pathlib import Path

from scan_files import Tally, archive, need, read_json, read_ply, write_objects

DOWNLOAD = "download_data.py of ARKitScenes fetches it: 3dod has all, raw needs --raw_dataset_assets"
POSE_WITHIN_S, NAME_WITHIN_S = 0.005, 0.0015
# A mesh can be a centimeter off the box that was annotated around it.
SLACK_M = 0.01
CELL_M = 0.5


def timed(folder, ending):
    """Returns files of a folder by the seconds in their names (VIDEO_SECONDS.ending), in order of time."""
    files = []
    for file in folder.glob(f"*.{ending}"):
        try:
            files.append((float(file.stem.rsplit("_", 1)[-1]), file))
        except ValueError:
            raise SystemExit(f"{file}: expected a name like VIDEO_SECONDS.{ending}") from None
    return sorted(files)


def nearest(times, time, within):
    at = bisect_left(times, time)
    near = min((i for i in (at - 1, at) if 0 <= i < len(times)), key=lambda i: abs(times[i] - time), default=None)
    return near if near is not None and abs(times[near] - time) <= within else None


def frames_of(root, every):
    """Returns the files of every image with depth, camera and pose, and the number of images without."""
    trajectory = need(root / "lowres_wide.traj", DOWNLOAD + " lowres_wide.traj")
    try:
        poses = sorted(float(line.split()[0]) for line in trajectory.read_text().splitlines() if line.strip())
    except ValueError as error:
        raise SystemExit(f"{trajectory}: {error}") from None
    pictures = timed(need(root / "lowres_wide", DOWNLOAD + " lowres_wide"), "png")
    partners = [timed(need(root / name, f"{DOWNLOAD} {name}"), ending)
                for name, ending in (("lowres_depth", "png"), ("lowres_wide_intrinsics", "pincam"))]
    partners.append(timed(root / "confidence", "png"))
    times = [[time for time, _ in files] for files in partners]
    frames = []
    for time, picture in pictures:
        *needed, _ = found = [nearest(of, time, NAME_WITHIN_S) for of in times]
        if nearest(poses, time, POSE_WITHIN_S) is not None and None not in needed:
            frames.append([picture] + [files[at][1] for files, at in zip(partners, found) if at is not None])
    if not frames:
        raise SystemExit(f"{root}: none of {len(pictures)} pictures has depth, a camera and a pose at its time")
    return frames[::every], len(pictures) - len(frames)


def finite(values, count):
    return isinstance(values, list) and len(values) == count and all(isinstance(v, (int, float)) and math.isfinite(v) for v in values)


class Box:
    """An annotated object: `axes` are three unit rows, `half` the half extents along them."""

    def __init__(self, identity, record):
        box = record["segments"]["obbAligned"]
        self.center, lengths, axes = box["centroid"], box["axesLengths"], box["normalizedAxes"]
        if not (finite(self.center, 3) and finite(lengths, 3) and finite(axes, 9) and min(lengths) > 0):
            raise ValueError("obbAligned is not centroid, axesLengths and normalizedAxes of 3, 3 and 9 numbers, lengths above 0")
        self.axes = [axes[0:3], axes[3:6], axes[6:9]]
        dots = [sum(a * b for a, b in zip(self.axes[i], self.axes[j])) - (i == j) for i in range(3) for j in range(3)]
        if max(map(abs, dots)) > 1e-3:
            raise ValueError("the rows of normalizedAxes are not at right angles to each other and one long")
        self.identity, self.name, self.uid = identity, record["label"].replace("_", " "), record.get("uid")
        self.half, self.tally = [length / 2 for length in lengths], Tally()
        reach = [sum(abs(axis[k]) * half for axis, half in zip(self.axes, self.half)) for k in range(3)]
        self.low, self.high = [c - r for c, r in zip(self.center, reach)], [c + r for c, r in zip(self.center, reach)]

    def holds(self, point):
        off = [p - c for p, c in zip(point, self.center)]
        return all(abs(sum(o * a for o, a in zip(off, axis))) <= half + SLACK_M for axis, half in zip(self.axes, self.half))

    def record(self):
        rounded = lambda values: [round(v, 4) for v in values]  # noqa: E731
        record = {"id": self.identity, "name": self.name, "min": rounded(self.low), "max": rounded(self.high)}
        upright = max(range(3), key=lambda i: abs(self.axes[i][2]))
        along, across = (i for i in range(3) if i != upright)
        # Boxes are upright. A tilted one keeps only its axis-aligned box, because the format has no other rotations.
        if abs(self.axes[upright][2]) > math.cos(math.radians(1)):
            yaw = math.degrees(math.atan2(self.axes[along][1], self.axes[along][0]))
            size = [2 * self.half[i] for i in (along, across, upright)]
            record["obb"] = {"center": rounded(self.center), "size": rounded(size), "yaw_deg": round(yaw, 3)}
        else:
            print(f"object {self.identity} ({self.name}) is tilted: only its axis-aligned box is written")
        return {**record, **self.tally.facts(), "uid": self.uid}


def objects_of(file):
    annotation, boxes = read_json(file), []
    if not isinstance(annotation, dict) or not isinstance(annotation.get("data"), list):
        raise SystemExit(f"{file}: no annotation of ARKitScenes: it has no list called data")
    if annotation.get("skipped"):
        print(f"{file}: the annotators skipped this video")
    for place, record in enumerate(annotation["data"], 1):
        try:
            boxes.append(Box(place, record))
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            print(f"{file}: object {place} is left out: {error!r}")
    return boxes


def tally(mesh, boxes):
    """Counts the points of each box. A point in several boxes belongs to the smallest: to the cushion and not to the sofa."""
    cells = {}
    for box in sorted(boxes, key=lambda box: math.prod(box.half)):
        low, high = ([math.floor((v + slack) / CELL_M) for v in corner] for corner, slack in ((box.low, -SLACK_M), (box.high, SLACK_M)))
        for cell in ((x, y, z) for x in range(low[0], high[0] + 1) for y in range(low[1], high[1] + 1) for z in range(low[2], high[2] + 1)):
            cells.setdefault(cell, []).append(box)
    count, vertices = read_ply(mesh)
    for point, color in vertices:
        near = cells.get(tuple(math.floor(v / CELL_M) for v in point), ())
        owner = next((box for box in near if box.holds(point)), None)
        if owner:
            owner.tally.add(point, color)
    if boxes and not any(box.tally.count for box in boxes):
        raise SystemExit(f"{mesh}: not one of its points lies in an annotated box: do mesh and annotation belong to one video?")
    return count


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scan", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--every", type=int, default=1, help="take every N-th picture that has depth, camera and pose")
    parser.add_argument("--scan-only", action="store_true", help="leave the objects out: boxes come from elsewhere")
    args = parser.parse_args()
    folder, video = args.scan.resolve(), args.scan.resolve().name
    root = folder / f"{video}_frames" if (folder / f"{video}_frames").is_dir() else folder
    frames, left_out = frames_of(root, max(1, args.every))
    mesh, annotation = folder / f"{video}_3dod_mesh.ply", folder / f"{video}_3dod_annotation.json"
    annotated = annotation.is_file() and not args.scan_only
    if not annotated and not args.scan_only:
        print(f"{annotation}: missing, the scan is written without its objects; {DOWNLOAD} annotation")
    if not mesh.is_file():
        print(f"{mesh}: missing, the cloud is fused from the frames; {DOWNLOAD} mesh")
    boxes = objects_of(annotation) if annotated else []
    points = tally(mesh, boxes) if mesh.is_file() else 0
    args.out.mkdir(parents=True, exist_ok=True)
    with archive(args.out / f"{video}.zip") as out:
        out.write(root / "lowres_wide.traj", "lowres_wide.traj", zipfile.ZIP_DEFLATED)
        if mesh.is_file():
            out.write(mesh, mesh.name, zipfile.ZIP_DEFLATED)
        for file in (file for files in frames for file in files):
            out.write(file, f"{file.parent.name}/{file.name}")
    if annotated:
        write_objects(args.out / f"{video}.scene.json", video, [box.record() for box in boxes])
    print(f"{video}: {len(frames)} frames, {left_out} pictures left out, {points} points, {len(boxes)} objects")


if __name__ == "__main__":
    main()
