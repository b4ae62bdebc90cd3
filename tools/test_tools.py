#!/usr/bin/env python3
"""Checks the converters on tiny datasets made up here, through to the figures of `uniground eval`.

usage: test_tools.py UNIGROUND
"""
import json
import math
import pickle
import struct
import subprocess
import sys
import tempfile
import zipfile
import zlib
from pathlib import Path

TOOLS = Path(__file__).resolve().parent


def png(width, height, depth_mm):
    """A 16-bit grey PNG of one value."""
    def chunk(kind, body):
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
    rows = b"".join(b"\0" + struct.pack(">H", depth_mm) * width for _ in range(height))
    return (b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 16, 0, 0, 0, 0))
            + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b""))


def box_points(low, high, step=0.05):
    def steps(a, b):
        return [a + i * step for i in range(int(round((b - a) / step)) + 1)]
    faces = [[x, y, z] for x in steps(low[0], high[0]) for y in steps(low[1], high[1]) for z in steps(low[2], high[2])]
    return [p for p in faces if any(abs(p[i] - e[i]) < 1e-6 for i in range(3) for e in (low, high))]


def scannet(folder):
    """A sofa and a mug in a world turned by 30 degrees, which axisAlignment turns back."""
    scene = folder / "scene9999_00"
    for sub in ("color", "depth", "pose", "intrinsic"):
        (scene / sub).mkdir(parents=True)
    sofa = box_points([0.0, 0.0, 0.0], [2.0, 0.9, 0.8])
    mug = box_points([3.0, 1.0, 0.7], [3.1, 1.1, 0.8], 0.02)
    c, s = math.cos(math.radians(30)), math.sin(math.radians(30))
    turned = [[c * x - s * y, s * x + c * y, z] for x, y, z in sofa + mug]
    colours = [(180, 30, 30)] * len(sofa) + [(30, 30, 180)] * len(mug)
    header = (f"ply\nformat binary_little_endian 1.0\nelement vertex {len(turned)}\n" + "".join(f"property float {a}\n" for a in "xyz")
              + "".join(f"property uchar {a}\n" for a in ("red", "green", "blue", "alpha")) + "end_header\n")
    body = b"".join(struct.pack("<3f4B", *p, *rgb, 255) for p, rgb in zip(turned, colours))
    (scene / "scene9999_00_vh_clean_2.ply").write_bytes(header.encode() + body)
    (scene / "scene9999_00_vh_clean_2.0.010000.segs.json").write_text(json.dumps({"segIndices": [4] * len(sofa) + [7] * len(mug)}))
    groups = [{"id": 0, "objectId": 0, "segments": [4], "label": "couch"}, {"id": 1, "objectId": 1, "segments": [7], "label": "mug"}]
    (scene / "scene9999_00.aggregation.json").write_text(json.dumps({"segGroups": groups}))
    (scene / "scene9999_00.txt").write_text(f"axisAlignment = {c} {s} 0 0 {-s} {c} 0 0 0 0 1 0 0 0 0 1\n")
    for name, (w, h) in (("color", (640, 480)), ("depth", (32, 24))):
        m = [[50, 0, w / 2, 0], [0, 50, h / 2, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
        (scene / f"intrinsic/intrinsic_{name}.txt").write_text("\n".join(" ".join(map(str, row)) for row in m))
    (scene / "pose/0.txt").write_text("1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n")
    (scene / "depth/0.png").write_bytes(png(32, 24, 0))
    with zipfile.ZipFile(TOOLS.parent / "examples/living_room.zip") as sample:
        (scene / "color/0.jpg").write_bytes(sample.read("color/0.jpg"))
    return scene


def run(*command):
    done = subprocess.run([str(word) for word in command], capture_output=True, text=True)
    assert done.returncode == 0, f"{command}: {done.stderr}"
    return done.stdout


def main():
    uniground = Path(sys.argv[1]).resolve()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        scene, out = scannet(folder), folder / "scenes"
        print(run(sys.executable, TOOLS / "scannet_scene.py", scene, out).strip())
        sofa, mug = json.loads((out / "scene9999_00.scene.json").read_text())["objects"]
        assert all(abs(a - b) < 1e-3 for a, b in zip(sofa["min"] + sofa["max"], [0, 0, 0, 2, 0.9, 0.8])), sofa
        assert mug["name"] == "mug" and mug["mean_rgb"] == [30.0, 30.0, 180.0], mug
        with zipfile.ZipFile(out / "scene9999_00.zip") as archive:
            pose = [float(v) for v in archive.read("pose/0.txt").split()]
            manifest = json.loads(archive.read("scene.json"))
        assert abs(pose[0] - math.cos(math.radians(30))) < 1e-6 and abs(pose[1] - math.sin(math.radians(30))) < 1e-6, pose
        assert (manifest["intrinsics"]["width"], manifest["depth_intrinsics"]["width"]) == (640, 32), manifest
        expressions = [{"scene_id": "scene9999_00", "object_id": "0", "object_name": "couch", "ann_id": "0", "description": "the red couch"},
                       {"scene_id": "scene9999_00", "object_id": "1", "object_name": "mug", "ann_id": "0", "description": "the blue mug"}]
        (folder / "ScanRefer_filtered_val.json").write_text(json.dumps(expressions))
        run(uniground, "eval", folder / "ScanRefer_filtered_val.json", "--scenes", out, "--out", folder / "report", "--matrix", "source=oracle")
        report = json.loads((folder / "report/report.json").read_text())
        assert report["cells"][0]["figures"]["complete"][0]["value"] == 1.0, report["cells"][0]["left_out"]

        boxes = [{"bbox_id": 5, "bbox_label_3d": 1, "bbox_3d": [1.0, 0.5, 0.3, 2.0, 1.0, 0.6, 0.5, 0.0, 0.0]}]
        infos = {"metainfo": {"categories": {"bed": 1}}, "data_list": [{"sample_idx": "arkitscenes/Training/47333462", "instances": boxes}]}
        (folder / "infos.pkl").write_bytes(pickle.dumps(infos))
        print(run(sys.executable, TOOLS / "embodiedscan_boxes.py", folder / "infos.pkl", out, "--only", "arkitscenes").strip())
        expressions = [{"scan_id": "arkitscenes/Training/47333462", "target_id": 5, "distractor_ids": [], "text": "the bed", "target": "bed"}]
        (folder / "vg.json").write_text(json.dumps(expressions))
        run(uniground, "eval", folder / "vg.json", "--scenes", out, "--out", folder / "report2", "--matrix", "source=oracle")
        figures = json.loads((folder / "report2/report.json").read_text())["cells"][0]["figures"]
        assert figures["oriented"]["targets"] == 1 and figures["oriented"]["mean_iou"] > 0.99, figures["oriented"]
    print("the converters agree with the readers")


if __name__ == "__main__":
    main()
