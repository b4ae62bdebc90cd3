#!/usr/bin/env python3
"""Converts a ScanNet scene for uniground: SCENE.zip, and SCENE.scene.json with its annotated objects.

usage: scannet_scene.py SCAN_FOLDER OUT_FOLDER [--every N] [--scan-only]

SCAN_FOLDER is scans/sceneXXXX_YY as downloaded:
    sceneXXXX_YY.sens, or what SensReader exports from it: color/0.jpg …  depth/0.png …  pose/0.txt …
        intrinsic/intrinsic_color.txt  intrinsic/intrinsic_depth.txt
    sceneXXXX_YY_vh_clean_2.ply                                             the cloud; without it, the cloud is fused from the frames
    sceneXXXX_YY_vh_clean_2.0.010000.segs.json  sceneXXXX_YY.aggregation.json          the objects
    sceneXXXX_YY.txt                                                        the axis alignment

Cloud, poses and boxes are brought into the axis-aligned world of the benchmarks. A box holds the aligned vertices of its
segments, as ScanRefer makes them; an object's id is its objectId. Scenes without annotations (the test set) and --scan-only, for
boxes from elsewhere (embodiedscan_boxes.py), give SCENE.zip alone. Needs only Python's standard library.
"""
import argparse
import json
import math
import re
import struct
import zipfile
from pathlib import Path

from scan_files import Tally, archive, moved, need, numbers_of, product, read_json, read_ply, rows, write_objects
from sens import Sens, camera


def axis_alignment(file):
    """Returns the world-to-aligned matrix; identity if the scene has none."""
    found = re.search(r"axisAlignment\s*=\s*(.+)", file.read_text()) if file.is_file() else None
    numbers = [float(word) for word in found.group(1).split()] if found else []
    if len(numbers) != 16:
        print(f"{file}: no axisAlignment, the scene stays as it is")
        return [[float(i == j) for j in range(4)] for i in range(4)]
    return rows(numbers)


def annotations(folder, scene):
    """Returns the name of each object and the objects of each vertex; None if the scene is not annotated."""
    files = [folder / f"{scene}_vh_clean_2.0.010000.segs.json", folder / f"{scene}.aggregation.json"]
    missing = [file.name for file in files if not file.is_file()]
    if missing:
        print(f"{folder}: no {' and no '.join(missing)}: the scan is written without its objects")
        return None
    segments, groups = (read_json(file) for file in files)
    names, objects_of = {}, {}
    try:
        for group in groups["segGroups"]:
            names[group["objectId"]] = group["label"]
            for segment in group["segments"]:
                objects_of.setdefault(segment, []).append(group["objectId"])
        return names, [objects_of.get(segment, ()) for segment in segments["segIndices"]]
    except (KeyError, TypeError) as error:
        raise SystemExit(f"{folder}: {' or '.join(file.name for file in files)} is no annotation of ScanNet: {error!r}") from None


def picture_size(file):
    """Returns width and height of a JPEG or PNG."""
    data = file.read_bytes()
    if data[:8] == b"\x89PNG\r\n\x1a\n":
        return struct.unpack(">II", data[16:24])
    at = 2
    while at + 9 < len(data):
        marker, length = struct.unpack(">xBH", data[at:at + 4])
        if marker in (0xC0, 0xC1, 0xC2):
            height, width = struct.unpack(">HH", data[at + 5:at + 9])
            return width, height
        at += 2 + length
    raise SystemExit(f"{file}: neither JPEG nor PNG")


class Exported:
    """The folders that ScanNet's SensReader writes."""
    ending = "jpg"

    def __init__(self, folder, every):
        self.folder = folder
        self.numbers = sorted(int(file.stem) for file in (folder / "color").glob("*.jpg"))[::every]
        if not self.numbers:
            raise SystemExit(f"{folder / 'color'}: no pictures")
        first = self.numbers[0]
        self.cameras = {"depth_scale_m": 0.001}
        for key, name, picture in (("intrinsics", "color", f"color/{first}.jpg"), ("depth_intrinsics", "depth", f"depth/{first}.png")):
            file, picture = folder / f"intrinsic/intrinsic_{name}.txt", need(folder / picture, "export the .sens file again")
            self.cameras[key] = camera(rows(numbers_of(need(file, "export the .sens file again"), 16)), *picture_size(picture))

    def frames(self):
        for number in self.numbers:
            files = [self.folder / f"color/{number}.jpg", self.folder / f"depth/{number}.png", self.folder / f"pose/{number}.txt"]
            color, depth, pose = (need(file, "export the .sens file again") for file in files)
            yield number, color.read_bytes(), depth.read_bytes(), rows(numbers_of(pose, 16))


def write_cloud(out, mesh, aligned, owners, objects):
    """Writes the aligned vertices and tallies those of each object."""
    count, vertices = read_ply(mesh)
    if owners is not None and len(owners) != count:
        raise SystemExit(f"{mesh}: {count} vertices, its segs.json has {len(owners)}")
    header = (f"ply\nformat binary_little_endian 1.0\nelement vertex {count}\n" + "".join(f"property float {c}\n" for c in "xyz")
              + "".join(f"property uchar {c}\n" for c in ("red", "green", "blue")) + "end_header\n")
    entry = zipfile.ZipInfo("cloud.ply")
    entry.compress_type = zipfile.ZIP_DEFLATED
    with out.open(entry, "w", force_zip64=True) as cloud:
        cloud.write(header.encode())
        for vertex, (position, color) in enumerate(vertices):
            position, color = moved(aligned, position), color or (128, 128, 128)
            cloud.write(struct.pack("<3f3B", *position, *color))
            for owner in owners[vertex] if owners is not None else ():
                objects.setdefault(owner, Tally()).add(position, color)
    return count


def write_frames(out, source, aligned, name, cloud):
    manifest = {"format": "uniground-scene/1", "name": name, "up": "z", **({"cloud": "cloud.ply"} if cloud else {}), **source.cameras,
                "camera_axes": "opencv", "pose": "camera_to_world", "frames": []}
    for number, color, depth, pose in source.frames():
        # A lost pose contains infinities and is copied unchanged: the importer counts and skips it.
        if all(math.isfinite(v) for row in pose for v in row):
            pose = product(aligned, pose)
        entries = {"color": f"color/{number}.{source.ending}", "depth": f"depth/{number}.png", "pose": f"pose/{number}.txt"}
        out.writestr(entries["pose"], "\n".join(" ".join(f"{v:.9g}" for v in row) for row in pose) + "\n")
        out.writestr(entries["color"], color)
        out.writestr(entries["depth"], depth)
        manifest["frames"].append(entries)
    out.writestr("scene.json", json.dumps(manifest, indent=1), zipfile.ZIP_DEFLATED)
    return len(manifest["frames"])


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scan", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--every", type=int, default=1, help="take every N-th frame")
    parser.add_argument("--scan-only", action="store_true", help="leave the objects out: boxes come from elsewhere")
    args = parser.parse_args()
    folder, scene = args.scan.resolve(), args.scan.resolve().name
    sens, mesh = folder / f"{scene}.sens", folder / f"{scene}_vh_clean_2.ply"
    if (folder / "color").is_dir():
        source = Exported(folder, max(1, args.every))
    else:
        source = Sens(need(sens, f"download it with ScanNet's download-scannet.py --id {scene} --type .sens"), max(1, args.every))
    annotated = None if args.scan_only else annotations(folder, scene)
    if annotated or mesh.is_file():
        need(mesh, f"download it with ScanNet's download-scannet.py --id {scene} --type _vh_clean_2.ply, or give --scan-only")
    else:
        print(f"{mesh}: missing, the cloud is fused from the frames")
    args.out.mkdir(parents=True, exist_ok=True)
    aligned = axis_alignment(folder / f"{scene}.txt")
    names, owners = annotated or ({}, None)
    tallies, points = {}, 0
    with archive(args.out / f"{scene}.zip") as out:
        if mesh.is_file():
            points = write_cloud(out, mesh, aligned, owners, tallies)
        frames = write_frames(out, source, aligned, scene, mesh.is_file())
    for identity in sorted(names.keys() - tallies.keys()):
        print(f"{folder / scene}.aggregation.json: object {identity} has no points")
    if annotated:
        write_objects(args.out / f"{scene}.scene.json", scene, [
            {"id": identity, "name": names[identity], "min": [round(v, 4) for v in tally.low], "max": [round(v, 4) for v in tally.high],
             **tally.facts()} for identity, tally in sorted(tallies.items())])
    print(f"{scene}: {frames} frames, {points} points, {len(tallies)} objects")


if __name__ == "__main__":
    main()
