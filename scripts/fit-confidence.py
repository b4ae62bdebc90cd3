#!/usr/bin/env python3
"""Fits crates/uniground-grounding/src/reasoner/confidence.tsv: the share of correct answers by belief.

    scripts/fit-confidence.py measures REPORT.json ...     # reports of `uniground eval`, source=parsed, before calibration

Prints the table's rows for names from that source (measures or encoder), and the expected calibration error of every room under a table
fitted to the other rooms, compared with that of the raw beliefs. Uses isotonic regression (pool adjacent violators), read at fixed beliefs.
Needs only Python's standard library.
"""

import json
import sys

AT = [0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.8, 1.0]
# Prior: this many answers with 0 % at belief 0 and with the mean at belief 1, because few answers have the highest beliefs.
PRIOR = 5


def answers(report):
    """Yields (scene, belief, right) of every answer with a box."""
    for cell in json.load(open(report))["cells"]:
        if cell["configuration"]["source"] != "parsed":
            continue
        for outcome in cell["outcomes"]:
            reply = outcome["reply"]
            if reply and reply["status"] in ("grounded", "uncertain"):
                target = outcome["target"]
                yield outcome["scene"], reply["confidence"], float(target is not None and target["iou"] >= 0.25)


def isotonic(rows):
    """Isotonic regression from belief to share right: a list of (belief, share, weight)."""
    mean = sum(right for _, right in rows) / len(rows)
    points = sorted([(b, r, 1) for b, r in rows] + [(0.0, 0.0, PRIOR), (1.0, mean, PRIOR)])
    pools = []
    for belief, right, weight in points:
        pools.append([belief * weight, right * weight, weight])
        while len(pools) > 1 and pools[-2][1] / pools[-2][2] >= pools[-1][1] / pools[-1][2]:
            last = pools.pop()
            pools[-1] = [a + b for a, b in zip(pools[-1], last)]
    return [(b / w, r / w) for b, r, w in pools]


def read(curve, belief):
    before = [(0.0, 0.0)] + [p for p in curve if p[0] <= belief]
    after = [p for p in curve if p[0] > belief]
    (x0, y0), (x1, y1) = before[-1], after[0] if after else before[-1]
    return y0 if x1 == x0 else y0 + (y1 - y0) * (belief - x0) / (x1 - x0)


def table(rows):
    curve = isotonic(rows)
    return [(at, round(read(curve, at), 2)) for at in AT]


def error(rows):
    """Returns the expected calibration error over tenths."""
    bins = {}
    for belief, right in rows:
        bins.setdefault(min(int(belief * 10), 9), []).append((belief, right))
    return sum(abs(sum(b for b, _ in v) - sum(r for _, r in v)) for v in bins.values()) / max(len(rows), 1)


def main():
    source, reports = sys.argv[1], sys.argv[2:]
    rows = [row for report in reports for row in answers(report)]
    before, after = [], []
    for scene in sorted({row[0] for row in rows}):
        curve = table([row[1:] for row in rows if row[0] != scene])
        held_out = [row[1:] for row in rows if row[0] == scene]
        before += held_out
        after += [(read(curve, belief), right) for belief, right in held_out]
    print(
        f"# {len(rows)} answers in {len({row[0] for row in rows})} rooms; error {error(before):.3f}, held out {error(after):.3f}",
        file=sys.stderr,
    )
    for belief, share in table([row[1:] for row in rows]):
        print(f"{source}\t{belief}\t{share}")


if __name__ == "__main__":
    main()
