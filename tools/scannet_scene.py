#!/usr/bin/env python3
"""A ScanNet scene as uniground takes it: SCENE.zip, and SCENE.scene.json with its annotated objects.

usage: scannet_scene.py SCAN_FOLDER OUT_FOLDER [--every N]

SCAN_FOLDER is scans/sceneXXXX_YY with the .sens file exported beside the rest:
    color/0.jpg …  depth/0.png …  pose/0.txt …  intrinsic/intrinsic_color.txt  intrinsic/intrinsic_depth.txt
    sceneXXXX_YY_vh_clean_2.ply  sceneXXXX_YY_vh_clean_2.0.010000.segs.json  sceneXXXX_YY.aggregation.json  sceneXXXX_YY.txt

Cloud, poses and boxes are brought into the axis-aligned world of the benchmarks. A box holds the aligned vertices of its
segments, as ScanRefer makes them; an object's id is its objectId. Only Python's standard library is needed.
"""
import argparse
import json
import math
import re
import struct
import zipfile
from pathlib import Path

PLY_TYPES = {"char": "b", "uchar": "B", "uint8": "B", "short": "h", "ushort": "H", "int": "i", "uint": "I", "float": "f",
             "float32": "f", "double": "d"}


def read_matrix(file):
    """The 4x4 matrix of a text file, by rows."""
    numbers = [float(word) for word in file.read_text().split()]
    if len(numbers) != 16:
        raise SystemExit(f"{file}: expected 16 numbers, found {len(numbers)}")
    return [numbers[i:i + 4] for i in range(0, 16, 4)]


def product(a, b):
    return [[sum(a[i][k] * b[k][j] for k in range(4)) for j in range(4)] for i in range(4)]


def moved(m, p):
    return [m[i][0] * p[0] + m[i][1] * p[1] + m[i][2] * p[2] + m[i][3] for i in range(3)]


def axis_alignment(file):
    """The world-to-aligned matrix; identity where the scene has none."""
    found = re.search(r"axisAlignment\s*=\s*(.+)", file.read_text()) if file.is_file() else None
    numbers = [float(word) for word in found.group(1).split()] if found else []
    if len(numbers) != 16:
        print(f"{file}: no axisAlignment, the scene stays as it is")
        return [[float(i == j) for j in range(4)] for i in range(4)]
    return [numbers[i:i + 4] for i in range(0, 16, 4)]


def read_vertices(file):
    """Positions and colours of a binary little-endian PLY."""
    data = file.read_bytes()
    end = data.index(b"end_header\n") + len(b"end_header\n")
    header = data[:end].decode("ascii").split("\n")
    if "format binary_little_endian 1.0" not in header:
        raise SystemExit(f"{file}: expected a binary little-endian PLY")
    properties, count, element = [], 0, None
    for line in header:
        words = line.split()
        if words[:1] == ["element"]:
            element = words[1]
            count = int(words[2]) if element == "vertex" else count
        elif words[:1] == ["property"] and element == "vertex":
            properties.append((words[2], PLY_TYPES[words[1]]))
    names = [name for name, _ in properties]
    at = [names.index(name) for name in ("x", "y", "z", "red", "green", "blue")]
    row = struct.Struct("<" + "".join(code for _, code in properties))
    vertices = [[values[i] for i in at] for values in row.iter_unpack(data[end:end + count * row.size])]
    return vertices


def objects_of(folder, scene, positions):
    """One record per annotated object."""
    segments_file = folder / f"{scene}_vh_clean_2.0.010000.segs.json"
    groups_file = folder / f"{scene}.aggregation.json"
    segment_of = json.loads(segments_file.read_text())["segIndices"]
    if len(segment_of) != len(positions):
        raise SystemExit(f"{segments_file}: {len(segment_of)} vertices, the mesh has {len(positions)}")
    points_of = {}
    for vertex, segment in enumerate(segment_of):
        points_of.setdefault(segment, []).append(vertex)
    objects = []
    for group in json.loads(groups_file.read_text())["segGroups"]:
        points = [positions[v] for segment in group["segments"] for v in points_of.get(segment, [])]
        if not points:
            print(f"{groups_file}: object {group['objectId']} has no points")
            continue
        low, high = ([round(f(p[i] for p in points), 4) for i in range(3)] for f in (min, max))
        colour = [round(sum(p[3 + i] for p in points) / len(points), 1) for i in range(3)]
        objects.append({"id": group["objectId"], "name": group["label"], "min": low, "max": high,
                        "cloud_points": len(points), "mean_rgb": colour})
    return sorted(objects, key=lambda o: o["id"])


def picture_size(file):
    """Width and height of a JPEG or PNG."""
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


def intrinsics(file, picture):
    m = read_matrix(file)
    width, height = picture_size(picture)
    return {"width": width, "height": height, "fx": m[0][0], "fy": m[1][1], "cx": m[0][2], "cy": m[1][2]}


def write_archive(folder, archive, aligned, positions, every):
    frames = sorted((int(f.stem) for f in (folder / "color").glob("*.jpg")))[::every]
    if not frames:
        raise SystemExit(f"{folder / 'color'}: no pictures; export the .sens file first")
    first = frames[0]
    manifest = {
        "format": "uniground-scene/1", "name": folder.name, "up": "z", "cloud": "cloud.ply",
        "intrinsics": intrinsics(folder / "intrinsic/intrinsic_color.txt", folder / f"color/{first}.jpg"),
        "depth_intrinsics": intrinsics(folder / "intrinsic/intrinsic_depth.txt", folder / f"depth/{first}.png"),
        "depth_scale_m": 0.001, "camera_axes": "opencv", "pose": "camera_to_world", "frames": [],
    }
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_STORED) as out:
        for frame in frames:
            pose = read_matrix(folder / f"pose/{frame}.txt")
            # A lost pose holds infinities and stays as it is: the importer counts and skips it.
            if all(math.isfinite(v) for row in pose for v in row):
                pose = product(aligned, pose)
            out.writestr(f"pose/{frame}.txt", "\n".join(" ".join(f"{v:.9g}" for v in row) for row in pose) + "\n")
            out.write(folder / f"color/{frame}.jpg", f"color/{frame}.jpg")
            out.write(folder / f"depth/{frame}.png", f"depth/{frame}.png")
            manifest["frames"].append({"color": f"color/{frame}.jpg", "depth": f"depth/{frame}.png", "pose": f"pose/{frame}.txt"})
        header = ("ply\nformat binary_little_endian 1.0\n" f"element vertex {len(positions)}\n"
                  + "".join(f"property float {c}\n" for c in "xyz")
                  + "".join(f"property uchar {c}\n" for c in ("red", "green", "blue")) + "end_header\n")
        body = b"".join(struct.pack("<3f3B", *p) for p in positions)
        out.writestr("cloud.ply", header.encode() + body, zipfile.ZIP_DEFLATED)
        out.writestr("scene.json", json.dumps(manifest, indent=1), zipfile.ZIP_DEFLATED)
    return len(frames)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scan", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--every", type=int, default=1, help="take every N-th frame")
    args = parser.parse_args()
    folder, scene = args.scan.resolve(), args.scan.resolve().name
    args.out.mkdir(parents=True, exist_ok=True)
    aligned = axis_alignment(folder / f"{scene}.txt")
    positions = [moved(aligned, v[:3]) + v[3:] for v in read_vertices(folder / f"{scene}_vh_clean_2.ply")]
    objects = objects_of(folder, scene, positions)
    frames = write_archive(folder, args.out / f"{scene}.zip", aligned, positions, max(1, args.every))
    lines = ",\n".join("  " + json.dumps(o) for o in objects)
    (args.out / f"{scene}.scene.json").write_text(f'{{\n "name": "{scene}",\n "objects": [\n{lines}\n ]\n}}\n')
    print(f"{scene}: {frames} frames, {len(positions)} points, {len(objects)} objects")


if __name__ == "__main__":
    main()
