#!/usr/bin/env python3
"""Annotated boxes of EmbodiedScan as uniground takes them: one SCAN.json per scan, a list of {bbox_id, target, bbox_3d}.

usage: embodiedscan_boxes.py embodiedscan_infos_val.pkl OUT_FOLDER [--only arkitscenes]

bbox_3d is kept as it is: centre, full extent and ZXY Euler angles, in the axis-aligned world of the scan. Needs numpy, which
the info files are pickled with. Unpickling runs code: take info files from their makers only.
"""
import argparse
import json
import pickle
from pathlib import Path


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("infos", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--only", default="", help="scans whose id starts with this")
    args = parser.parse_args()
    infos = pickle.loads(args.infos.read_bytes())
    name_of = {number: name for name, number in infos["metainfo"]["categories"].items()}
    args.out.mkdir(parents=True, exist_ok=True)
    written = 0
    for scan in infos["data_list"]:
        scan_id = scan.get("sample_idx") or scan.get("scan_id")
        if not scan_id.startswith(args.only):
            continue
        boxes = [{"bbox_id": int(o["bbox_id"]), "target": name_of.get(o["bbox_label_3d"], "object"),
                  "bbox_3d": [round(float(v), 5) for v in o["bbox_3d"]]} for o in scan["instances"]]
        lines = ",\n".join(" " + json.dumps(box) for box in sorted(boxes, key=lambda b: b["bbox_id"]))
        (args.out / (scan_id.rsplit("/", 1)[-1] + ".json")).write_text(f"[\n{lines}\n]\n")
        written += 1
    print(f"{written} scans")


if __name__ == "__main__":
    main()
