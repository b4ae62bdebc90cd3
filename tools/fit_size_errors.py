#!/usr/bin/env python3
"""Compares measured sizes with annotated boxes, and fits the expected error that answers state.

usage: fit_size_errors.py ROOM.scene.json=INSTANCES.json ...

INSTANCES.json is the response of GET /v1/scenes/{id}/instances?limit=1000 for that room. An object and an instance belong together if the
IoU of their axis-aligned boxes is at least --iou, each at most once, the best first. Three lengths of each pair are compared: the longer
and the shorter horizontal side, and the height.

The model: error = 2 * end + share * length, with one value of `end` for at least three views and another for fewer. It is fitted to the quantile
--coverage of the absolute errors (pinball loss) on all rooms but one, and applied to that one. "inside" is the share of errors that are not above the
stated one. Needs only Python's standard library.
"""
import argparse
import json
import math
from pathlib import Path

FEW_VIEWS = 3
ENDS = [x / 1000 for x in range(0, 151, 5)]
SHARES = [x / 100 for x in range(0, 41, 1)]


def bounds(low, high):
    return [(a, b) for a, b in zip(low, high)]


def iou(a, b):
    shared = 1.0
    for (a_low, a_high), (b_low, b_high) in zip(a, b):
        shared *= max(0.0, min(a_high, b_high) - max(a_low, b_low))
    volume = [math.prod(high - low for low, high in box) for box in (a, b)]
    return shared / (sum(volume) - shared) if shared > 0 else 0.0


def sides(size):
    return [max(size[0], size[1]), min(size[0], size[1]), size[2]]


def pairs_of(scene, instances, least):
    """Returns (views, measured, annotated) for each length of each pair."""
    objects = [o for o in scene["objects"] if o["category"] not in ("floor", "ceiling", "wall")]
    found = [i for i in instances["instances"] if not i["structure"] and not i["dismissed"]]
    candidates = []
    for o in objects:
        for i in found:
            box = i["box"]
            low = [c - s / 2 for c, s in zip(box["center"], box["size"])]
            high = [c + s / 2 for c, s in zip(box["center"], box["size"])]
            overlap = iou(bounds(o["min"], o["max"]), bounds(low, high))
            if overlap >= least:
                candidates.append((-overlap, o["id"], i["id"], o, i))
    used, rows = set(), []
    for _, o_id, i_id, o, i in sorted(candidates, key=lambda c: c[:3]):
        if ("o", o_id) in used or ("i", i_id) in used:
            continue
        used |= {("o", o_id), ("i", i_id)}
        true = o["obb"]["size"] if o.get("obb") else [high - low for low, high in zip(o["min"], o["max"])]
        for measured, annotated in zip(sides(i["oriented_box"]["size"]), sides(true)):
            rows.append((len(i["views"]), measured, annotated))
    return rows


def stated(row, ends, share):
    views, measured, _ = row
    return 2 * ends[views < FEW_VIEWS] + share * measured


def inside(rows, ends, share):
    return sum(abs(r[1] - r[2]) <= stated(r, ends, share) for r in rows) / max(1, len(rows))


def pinball(rows, end, share, quantile):
    loss = 0.0
    for _, measured, annotated in rows:
        over = abs(measured - annotated) - (2 * end + share * measured)
        loss += max(quantile * over, (quantile - 1) * over)
    return loss


def fit(rows, quantile):
    many = [r for r in rows if r[0] >= FEW_VIEWS]
    few = [r for r in rows if r[0] < FEW_VIEWS]
    best = None
    for share in SHARES:
        of_many = min((pinball(many, end, share, quantile), end) for end in ENDS)
        of_few = min((pinball(few, end, share, quantile), end) for end in ENDS) if few else (0, of_many[1])
        loss = of_many[0] + of_few[0]
        if best is None or loss < best[0]:
            best = (loss, (of_many[1], of_few[1]), share)
    return best[1:]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rooms", nargs="+", metavar="ROOM.scene.json=INSTANCES.json")
    parser.add_argument("--iou", type=float, default=0.25)
    parser.add_argument("--coverage", type=float, default=0.68)
    parser.add_argument("--today", default="0.02,0.05,0.03", help="end, end with few views, share of the length")
    args = parser.parse_args()
    rooms = {}
    for room in args.rooms:
        scene, instances = room.split("=")
        rooms[Path(scene).name] = pairs_of(json.loads(Path(scene).read_text()), json.loads(Path(instances).read_text()), args.iou)
    *ends, share = [float(x) for x in args.today.split(",")]
    print("room | lengths | few views | median error | inside today | inside fitted | end, few, share")
    all_rows, inside_fitted, mean_today, mean_fitted = [], 0, 0.0, 0.0
    for name, rows in rooms.items():
        others = [r for other, of in rooms.items() if other != name for r in of]
        fitted = fit(others, args.coverage)
        errors = sorted(abs(r[1] - r[2]) for r in rows)
        few = sum(r[0] < FEW_VIEWS for r in rows)
        print(f"{name} | {len(rows)} | {few} | {errors[len(errors) // 2]:.3f} | {inside(rows, ends, share):.2f} | {inside(rows, *fitted):.2f} | {fitted}")
        all_rows += rows
        inside_fitted += inside(rows, *fitted) * len(rows)
        mean_today += sum(stated(r, ends, share) for r in rows)
        mean_fitted += sum(stated(r, *fitted) for r in rows)
    n = len(all_rows)
    print(f"all | {n} | inside today {inside(all_rows, ends, share):.2f}, mean stated {mean_today / n:.3f} m | "
          f"cross-validated {inside_fitted / n:.2f}, mean stated {mean_fitted / n:.3f} m")
    print("fitted on all rooms:", fit(all_rows, args.coverage))


if __name__ == "__main__":
    main()
