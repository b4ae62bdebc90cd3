#!/usr/bin/env python3
"""Checks the converters on synthetic scans in the layouts of the data sets, up to the figures of `uniground eval`.

usage: test_tools.py UNIGROUND

With source=parsed, eval segments the synthetic room itself: its instances overlap the converted boxes only if poses, cloud and boxes are
in the same world.
"""
import json
import math
import pickle
import struct
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

import made_up_scans as made_up
from embodiedscan_boxes import angles_of, box_in, rotation_of, way_back
from scan_files import moved, product
from sens import grey_png

TOOLS = Path(__file__).resolve().parent
QUESTIONS = {"couch": "the red couch", "cabinet": "the blue cabinet", "stool": "the green stool"}


def tool(name, *arguments):
    return run(sys.executable, TOOLS / name, *arguments)


def run(*command):
    done = subprocess.run([str(word) for word in command], capture_output=True, text=True)
    assert done.returncode == 0, f"{command}: {done.stdout}{done.stderr}"
    return done.stdout


def refused(name, *arguments):
    """Returns the message of a tool that refuses its input: a sentence, not a traceback."""
    done = subprocess.run([str(word) for word in (sys.executable, TOOLS / name, *arguments)], capture_output=True, text=True)
    assert done.returncode != 0 and "Traceback" not in done.stderr, f"{arguments}: {done.stdout}{done.stderr}"
    return done.stderr


def written(file, value):
    file.write_text(json.dumps(value))
    return file


def figures(uniground, suite, scenes, source):
    out = suite.with_suffix(f".{source}")
    run(uniground, "eval", suite, "--scenes", scenes, "--out", out, "--matrix", f"source={source}")
    cell = json.loads((out / "report.json").read_text())["cells"][0]
    assert not cell["left_out"], cell["left_out"]
    return cell["figures"]


def questions(scan_id, first):
    """Writes a question about each object of the synthetic room; object numbers start at `first`."""
    return [{"scan_id": scan_id, "target_id": first + i, "distractor_ids": [], "text": QUESTIONS[name], "target": name}
            for i, (name, *_) in enumerate(made_up.THINGS)]


def check_found(found, count):
    assert found["complete"][1]["of"] == count and found["complete"][1]["value"] == 1.0 and found["mean_iou"] > 0.75, found
    assert found["oriented"] is None or found["oriented"]["mean_iou"] > 0.75, found["oriented"]


def check_import(uniground, scan, frames, layout):
    report = json.loads(run(uniground, "import", scan, "--check", "--json"))
    assert (report["format"], report["frames"]) == (layout, frames) and report["reprojection_agreement"] > 0.6, report
    assert not [warning for warning in report["warnings"] if "lost" not in warning], report["warnings"]


def exported_scannet(folder):
    """A sofa and a mug in a world turned by 30 degrees, which axisAlignment turns back; exported from its .sens file."""
    scene = folder / "scene9999_00"
    for sub in ("color", "depth", "pose", "intrinsic"):
        (scene / sub).mkdir(parents=True)
    sofa = list(made_up.surface([0.0, 0.0, 0.0], [2.0, 0.9, 0.8], 0.05))
    mug = list(made_up.surface([3.0, 1.0, 0.7], [3.1, 1.1, 0.8], 0.02))
    c, s = math.cos(math.radians(30)), math.sin(math.radians(30))
    turned = [[c * x - s * y, s * x + c * y, z] for x, y, z in sofa + mug]
    colors = [(180, 30, 30)] * len(sofa) + [(30, 30, 180)] * len(mug)
    header = (f"ply\nformat binary_little_endian 1.0\nelement vertex {len(turned)}\n" + "".join(f"property float {a}\n" for a in "xyz")
              + "".join(f"property uchar {a}\n" for a in ("red", "green", "blue", "alpha")) + "end_header\n")
    body = b"".join(struct.pack("<3f4B", *p, *rgb, 255) for p, rgb in zip(turned, colors))
    (scene / "scene9999_00_vh_clean_2.ply").write_bytes(header.encode() + body)
    written(scene / "scene9999_00_vh_clean_2.0.010000.segs.json", {"segIndices": [4] * len(sofa) + [7] * len(mug)})
    groups = [{"id": 0, "objectId": 0, "segments": [4], "label": "couch"}, {"id": 1, "objectId": 1, "segments": [7], "label": "mug"}]
    written(scene / "scene9999_00.aggregation.json", {"segGroups": groups})
    (scene / "scene9999_00.txt").write_text(f"axisAlignment = {c} {s} 0 0 {-s} {c} 0 0 0 0 1 0 0 0 0 1\n")
    for name, (w, h) in (("color", (640, 480)), ("depth", (32, 24))):
        m = [[50, 0, w / 2, 0], [0, 50, h / 2, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
        (scene / f"intrinsic/intrinsic_{name}.txt").write_text(made_up.text_of(m))
    (scene / "pose/0.txt").write_text("1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n")
    (scene / "depth/0.png").write_bytes(grey_png(32, 24, bytes(2 * 32 * 24)))
    with zipfile.ZipFile(TOOLS.parent / "examples/living_room.zip") as sample:
        (scene / "color/0.jpg").write_bytes(sample.read("color/0.jpg"))
    return scene


def test_exported_scannet(uniground, folder):
    scene, out = exported_scannet(folder), folder / "scenes"
    tool("scannet_scene.py", scene, out)
    sofa, mug = json.loads((out / "scene9999_00.scene.json").read_text())["objects"]
    assert all(abs(a - b) < 1e-3 for a, b in zip(sofa["min"] + sofa["max"], [0, 0, 0, 2, 0.9, 0.8])), sofa
    assert mug["name"] == "mug" and mug["mean_rgb"] == [30.0, 30.0, 180.0], mug
    with zipfile.ZipFile(out / "scene9999_00.zip") as archive:
        pose = [float(v) for v in archive.read("pose/0.txt").split()]
        manifest = json.loads(archive.read("scene.json"))
    assert abs(pose[0] - math.cos(math.radians(30))) < 1e-6 and abs(pose[1] - math.sin(math.radians(30))) < 1e-6, pose
    assert (manifest["intrinsics"]["width"], manifest["depth_intrinsics"]["width"]) == (640, 32), manifest
    expressions = [{"scene_id": "scene9999_00", "object_id": str(i), "object_name": name, "ann_id": "0", "description": f"the {name}"}
                   for i, name in enumerate(("couch", "mug"))]
    suite = written(folder / "ScanRefer_filtered_val.json", expressions)
    assert figures(uniground, suite, out, "oracle")["complete"][0]["value"] == 1.0


def test_sens(uniground, folder, frames):
    """ScanNet as downloaded; then without its annotations, without its mesh, and cut off."""
    name, out = "scene0099_00", folder / "scenes"
    scan = made_up.scannet(folder, name, made_up.rigid(40, [3, 3, 0.1]), frames)
    tool("scannet_scene.py", scan, out)
    check_import(uniground, out / f"{name}.zip", len(frames), "uniground-scene/1")
    annotated = json.loads((out / f"{name}.scene.json").read_text())["objects"]
    for thing, (label, low, high, _) in zip(annotated, made_up.THINGS):
        assert thing["name"] == label and all(abs(a - b) < 1e-3 for a, b in zip(thing["min"] + thing["max"], low + high)), thing
    suite = written(folder / "questions.json", questions(name, 0))
    check_found(figures(uniground, suite, out, "parsed"), 3)

    (scan / f"{name}_vh_clean_2.0.010000.segs.json").unlink()
    bare = folder / "bare"
    assert "without its objects" in tool("scannet_scene.py", scan, bare, "--every", 2)
    assert not (bare / f"{name}.scene.json").exists()
    check_import(uniground, bare / f"{name}.zip", len(frames) // 2, "uniground-scene/1")
    mesh = scan / f"{name}_vh_clean_2.ply"
    mesh.unlink()
    assert "fused" in tool("scannet_scene.py", scan, bare)
    # The frames alone give the annotated room.
    (out / f"{name}.zip").write_bytes((bare / f"{name}.zip").read_bytes())
    check_found(figures(uniground, written(folder / "fused.json", questions(name, 0)), out, "parsed"), 3)

    sens = scan / f"{name}.sens"
    sens.write_bytes(sens.read_bytes()[:-100])
    empty = folder / "empty"
    assert str(sens) in refused("scannet_scene.py", scan, empty) and not list(empty.iterdir())
    sens.unlink()
    assert "--type .sens" in refused("scannet_scene.py", scan, empty)


def test_arkitscenes(uniground, folder, frames):
    out, expressions = folder / "scenes", []
    for video, raw, world in (("47333462", False, made_up.rigid(25, [5, -3, -0.5])), ("41048190", True, made_up.rigid(-70, [-2, 1, -1.2]))):
        scan = made_up.arkitscenes(folder / ("raw" if raw else "3dod"), video, world, frames, raw)
        tool("arkitscenes_scene.py", scan, out)
        check_import(uniground, out / f"{video}.zip", len(frames), "arkit-scenes")
        for thing, (_, low, high, _) in zip(json.loads((out / f"{video}.scene.json").read_text())["objects"], made_up.THINGS):
            points = [moved(world, p) for p in made_up.surface(low, high, 0.1)]
            box, back = thing["obb"], made_up.inverse(made_up.rigid(thing["obb"]["yaw_deg"], thing["obb"]["center"]))
            assert all(abs(v) < size / 2 + 1e-3 for p in points for v, size in zip(moved(back, p), box["size"])), thing
            assert abs(math.prod(box["size"]) - math.prod(b - a for a, b in zip(low, high))) < 1e-3, thing
            around = [f(p[k] for p in points) for f in (min, max) for k in range(3)]
            assert all(abs(a - b) < 1e-3 for a, b in zip(thing["min"] + thing["max"], around)), thing
            assert thing["cloud_points"] > 1500 and abs(sum(thing["mean_rgb"]) - 240) < 60, thing
        expressions += questions(video, 1)
    check_found(figures(uniground, written(folder / "questions.json", expressions), out, "parsed"), 6)

    again = folder / "again"
    assert "6 frames" in tool("arkitscenes_scene.py", scan, again, "--every", 2, "--scan-only")
    assert [file.name for file in again.iterdir()] == [f"{video}.zip"]
    annotation, other = (folder / f"{kind}/{name}/{name}_3dod_annotation.json" for kind, name in (("raw", video), ("3dod", "47333462")))
    annotation.write_text(other.read_text())
    assert "belong to one video" in refused("arkitscenes_scene.py", scan, again)
    annotation.write_text('{"data": [{"label": "bed", "segments": {}}], "skipped": false}')
    assert "object 1 is left out" in tool("arkitscenes_scene.py", scan, again)
    (scan / "lowres_depth").rename(scan / "depth")
    assert str(scan / "lowres_depth") in refused("arkitscenes_scene.py", scan, again)


def info_of(identity, world, align, first):
    """What an info file of EmbodiedScan says of the made-up room in a scan's world; its boxes are in the world `align` leads to."""
    aligned = product(align, world)
    yaw = math.atan2(aligned[1][0], aligned[0][0])
    instances = [{"bbox_id": first + i, "bbox_label_3d": 7 + i, "bbox_3d": moved(aligned, [(a + b) / 2 for a, b in zip(low, high)])
                  + [b - a for a, b in zip(low, high)] + [yaw, 0.0, 0.0]} for i, (_, low, high, _) in enumerate(made_up.THINGS)]
    return {"sample_idx": identity, "axis_align_matrix": align, "instances": instances, "images": []}


def test_embodiedscan(uniground, folder, frames):
    """A scan of each of its data sets, Matterport3D's as the cloud of a region, in two buildings."""
    out = folder / "scenes"
    worlds = {"scannet/scene0099_00": made_up.rigid(40, [3, 3, 0.1]), "arkitscenes/Training/47333462": made_up.rigid(25, [5, -3, -0.5]),
              "3rscan/0a1b2c3d": made_up.rigid(-33, [-1, 2, -1.4]), "matterport3d/1LXtFkjw3qL/region0": made_up.rigid(75, [9, 2, 3]),
              "matterport3d/29hnd4uzFmX/region0": made_up.rigid(-15, [-9, 4, 0])}
    scannet, arkit, three, first_region, second_region = worlds.values()
    tool("scannet_scene.py", made_up.scannet(folder, "scene0099_00", scannet, frames), out, "--scan-only")
    tool("arkitscenes_scene.py", made_up.arkitscenes(folder, "47333462", arkit, frames, False), out, "--scan-only")
    scan = made_up.three_r_scan(folder, "0a1b2c3d", three, list(made_up.shots(90)))
    as_it_stands = ("--up", "z", "--no-levelling", "--out")
    run(uniground, "import", scan, *as_it_stands, out / "0a1b2c3d.zip")
    for building, world in (("1LXtFkjw3qL", first_region), ("29hnd4uzFmX", second_region)):
        (folder / "region0.ply").write_bytes(made_up.mesh(world)[0])
        run(uniground, "import", folder / "region0.ply", *as_it_stands, out / f"{building}_region0.zip")

    turned = made_up.rigid(8, [0.3, -0.4, 0.2])
    aligns = {scan: made_up.inverse(world) if scan.startswith("scannet") else product(turned, made_up.inverse(world))
              for scan, world in worlds.items()}
    scans = [info_of(scan, world, aligns[scan], 5) for scan, world in worlds.items()] + [info_of("3rscan/absent", three, turned, 5)]
    infos = folder / "embodiedscan_infos_val.pkl"
    infos.write_bytes(pickle.dumps({"metainfo": {"categories": {name: 7 + i for i, (name, *_) in enumerate(made_up.THINGS)}},
                                    "data_list": scans}))
    # A bare cloud is segmented more coarsely: only the couch is found reliably.
    lists = [question for scan in scans for question in questions(scan["sample_idx"], 5)[:1 if "matterport" in scan["sample_idx"] else 3]]
    suite = written(folder / "embodiedscan_val_vg.json", lists)
    assert "11 of 14 expressions" in tool("embodiedscan_boxes.py", infos, out, "--expressions", suite, "--present")
    check_found(figures(uniground, out / "embodiedscan_val_vg.all.json", out, "parsed"), 11)
    tool("embodiedscan_boxes.py", infos, out, "--expressions", suite, "--only", "arkitscenes")
    check_found(figures(uniground, out / "embodiedscan_val_vg.arkitscenes.json", out, "oracle"), 3)

    written(out / "47333462.scene.json", {"objects": []})
    assert "read instead" in refused("embodiedscan_boxes.py", infos, out)
    infos.write_bytes(pickle.dumps({"metainfo": print}))
    assert "builtins.print" in refused("embodiedscan_boxes.py", infos, out)


def test_angles():
    """EmbodiedScan's angles: about Z first, then X, then Y, of the box's own axes; and boxes led back from a tilted world."""
    quarter = math.pi / 2
    for angles, from_axis, to_axis in (([quarter, 0, 0], 0, 1), ([0, quarter, 0], 1, 2), ([0, 0, quarter], 2, 0),
                                       ([quarter, quarter, 0], 1, 2), ([0, quarter, quarter], 2, 0), ([quarter, 0, quarter], 2, 1)):
        turned = [row[from_axis] for row in rotation_of(angles)]
        assert abs(turned[to_axis] - 1) < 1e-9, (angles, turned)
    for angles in ([0.4, -0.3, 1.1], [-3.0, 1.2, -2.0], [0.7, quarter, 0.0]):
        assert all(abs(a - b) < 1e-6 for a, b in zip(angles, angles_of(rotation_of(angles)))), angles
    tilt = [row + [shift] for row, shift in zip(rotation_of([0.9, 0.2, -0.1]), [1.0, -2.0, 0.5])] + [[0, 0, 0, 1]]
    before = [2.0, 1.0, 0.4, 1.5, 0.6, 0.9, 0.3, 0.05, -0.2]
    after = box_in(way_back({"sample_idx": "3rscan/a", "axis_align_matrix": tilt}), before)
    corners = [[[sum(turn[i][k] * half[k] for k in range(3)) + box[i] for i in range(3)] for box, turn in
                ((b, rotation_of(b[6:])) for b in (before, after))] for half in ([0.75, 0.3, 0.45], [-0.75, 0.3, 0.45], [0.75, -0.3, 0.45])]
    for there, here in corners:
        assert all(abs(a - b) < 1e-4 for a, b in zip(there, moved(tilt, here))), (there, here)
    assert box_in(way_back({"sample_idx": "scannet/a", "axis_align_matrix": tilt}), before) == before


def main():
    uniground, frames = Path(sys.argv[1]).resolve(), list(made_up.shots())
    with tempfile.TemporaryDirectory() as temporary:
        test_angles()
        for number, (test, given) in enumerate(((test_exported_scannet, []), (test_sens, [frames]), (test_arkitscenes, [frames]),
                                                (test_embodiedscan, [frames]))):
            folder = Path(temporary) / str(number)
            folder.mkdir()
            test(uniground, folder, *given)
    print("the converters agree with the readers")


if __name__ == "__main__":
    main()
