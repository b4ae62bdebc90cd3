#!/usr/bin/env python3
"""Boxes and expressions of EmbodiedScan as uniground takes them: SCAN.json for each scan, a list of {bbox_id, target, bbox_3d}.

usage: embodiedscan_boxes.py embodiedscan_infos_val.pkl OUT_FOLDER [--only arkitscenes] [--expressions embodiedscan_val_vg.json] [--present]

SCAN is what the scan is called in its data set: scene0011_00 (ScanNet), the id of a 3RScan scan, BUILDING_regionN (Matterport3D; regions of
two buildings have one name), the video of ARKitScenes. --expressions writes those about these scans to OUT_FOLDER/<list>.<only>.json,
under the same names. --present leaves out scans that are not in OUT_FOLDER yet.

bbox_3d is center, full extent and three angles in radians: the rotation is Rz(first) Rx(second) Ry(third). EmbodiedScan has its boxes in
a world of its own, which axis_align_matrix leads to. Here they are in the world the scan is read in: ScanNet's axis-aligned one
(scannet_scene.py), for the other data sets that of their own files. Needs numpy, which the info files are pickled with.
"""
import argparse
import json
import math
import pickle
from pathlib import Path

from scan_files import moved, need, product, read_json

# The types in a pickle of lists, dictionaries and arrays. Any other type could execute code and is refused.
KNOWN = {("builtins", "set"), ("builtins", "bytearray"), ("_codecs", "encode"), ("collections", "OrderedDict"), ("numpy", "ndarray"),
         ("numpy", "dtype")} | {(f"numpy.{core}.{name}", part) for core in ("core", "_core")
                                for name, part in (("multiarray", "_reconstruct"), ("multiarray", "scalar"), ("numeric", "_frombuffer"))}


class Infos(pickle.Unpickler):
    def find_class(self, module, name):
        if (module, name) not in KNOWN:
            raise pickle.UnpicklingError(f"it would load {module}.{name}, which no list of boxes needs")
        return super().find_class(module, name)


def read_infos(file):
    try:
        with need(file, "EmbodiedScan sends it: https://github.com/OpenRobotLab/EmbodiedScan").open("rb") as data:
            infos = Infos(data).load()
        return infos["metainfo"]["categories"], infos["data_list"]
    except ModuleNotFoundError as error:
        raise SystemExit(f"{file}: {error}; pip install --upgrade numpy") from None
    except (pickle.UnpicklingError, EOFError, KeyError, TypeError, AttributeError) as error:
        raise SystemExit(f"{file}: not an info file of EmbodiedScan: {error!r}") from None


def scan_name(identity):
    parts = identity.split("/")
    return "_".join(parts[1:]) if parts[0] == "matterport3d" else parts[-1]


def rotation_of(angles):
    (ca, sa), (cb, sb), (cc, sc) = ((math.cos(v), math.sin(v)) for v in angles)
    about_z, about_x = [[ca, -sa, 0], [sa, ca, 0], [0, 0, 1]], [[1, 0, 0], [0, cb, -sb], [0, sb, cb]]
    return product(product(about_z, about_x), [[cc, 0, sc], [0, 1, 0], [-sc, 0, cc]])


def angles_of(r):
    second = math.asin(max(-1.0, min(1.0, r[2][1])))
    if abs(r[2][1]) > 1 - 1e-9:
        return [math.atan2(r[1][0], r[0][0]), second, 0.0]
    return [math.atan2(-r[0][1], r[1][1]), second, math.atan2(-r[2][0], r[2][2])]


def way_back(scan):
    """Returns the inverse of the matrix that led into EmbodiedScan's world; None if the scan is read in that world."""
    if scan["sample_idx"].startswith("scannet/") or scan.get("axis_align_matrix") is None:
        return None
    matrix = [[float(v) for v in row] for row in scan["axis_align_matrix"]]
    turn = [row[:3] for row in matrix[:3]]
    back = [list(column) for column in zip(*turn)]
    if any(abs(v - (i == j)) > 1e-3 for i, row in enumerate(product(turn, back)) for j, v in enumerate(row)):
        raise SystemExit(f"{scan['sample_idx']}: its axis_align_matrix is no rotation and shift")
    shift = [row[3] for row in matrix[:3]]
    return [row + [-sum(a * b for a, b in zip(row, shift))] for row in back]


def box_in(world, numbers):
    """Returns nine numbers in the scan's world; boxes of 6 or 7 numbers lack the last angles."""
    numbers = [float(v) for v in numbers]
    numbers += [0.0] * (9 - len(numbers))
    if world is not None:
        turn = [row[:3] for row in world]
        numbers = moved(world, numbers[:3]) + numbers[3:6] + angles_of(product(turn, rotation_of(numbers[6:])))
    return [round(v, 5) for v in numbers]


def write_list(file, records):
    file.write_text("[\n" + ",\n".join(" " + json.dumps(record) for record in records) + "\n]\n")


def write_boxes(args):
    """Writes the boxes of each scan and returns the scans' names by EmbodiedScan's ids."""
    categories, scans = read_infos(args.infos)
    name_of = {number: name for name, number in categories.items()} if isinstance(categories, dict) else dict(enumerate(categories))
    names = {}
    for scan in scans:
        name = scan_name(scan["sample_idx"])
        scan_is_there = any((args.out / (name + ending)).exists() for ending in (".zip", ".tar", ".tar.zst", ""))
        if not scan["sample_idx"].startswith(args.only) or args.present and not scan_is_there:
            continue
        if "instances" not in scan:
            raise SystemExit(f"{args.infos}: no boxes ({scan['sample_idx']} has no instances): the test split is kept back by its makers")
        other = args.out / f"{name}.scene.json"
        if other.exists():
            raise SystemExit(f"{other}: objects with other ids, which uniground would read instead; remove it, or convert with --scan-only")
        world = way_back(scan)
        boxes = [{"bbox_id": int(o["bbox_id"]), "target": name_of.get(o["bbox_label_3d"], "object"), "bbox_3d": box_in(world, o["bbox_3d"])}
                 for o in scan["instances"]]
        write_list(args.out / f"{name}.json", sorted(boxes, key=lambda box: box["bbox_id"]))
        names[scan["sample_idx"]] = name
    return names


def write_expressions(args, names):
    known = {**{name: name for name in names.values()}, **names}
    expressions = read_json(need(args.expressions, "EmbodiedScan sends it with the info files"))
    try:
        kept = [{**e, "scan_id": known[e["scan_id"]]} for e in expressions if e["scan_id"] in known]
    except (KeyError, TypeError) as error:
        raise SystemExit(f"{args.expressions}: not a list of expressions of EmbodiedScan: {error!r}") from None
    file = args.out / f"{args.expressions.stem}.{args.only.replace('/', '_') or 'all'}.json"
    write_list(file, kept)
    print(f"{file}: {len(kept)} of {len(expressions)} expressions")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("infos", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--only", default="", help="scans whose id starts with this: scannet, 3rscan, matterport3d, arkitscenes")
    parser.add_argument("--expressions", type=Path, help="EmbodiedScan's list of expressions")
    parser.add_argument("--present", action="store_true", help="only scans that lie in OUT_FOLDER")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    names = write_boxes(args)
    print(f"{len(names)} scans")
    if not names:
        raise SystemExit(f"{args.infos}: no scan starts with {args.only!r}" + (f" and lies in {args.out}" if args.present else ""))
    if args.expressions:
        write_expressions(args, names)


if __name__ == "__main__":
    main()
