#!/usr/bin/env python3
"""Fits crates/uniground-grounding/src/reasoner/confidence.tsv: the share of right answers by belief, for each source of names.

    scripts/fit-confidence.py REPORT.json ... [--source NAME] [--rooms NAME,NAME] [--check NAME,NAME] [--write]

Reads reports of `uniground eval` with source=parsed and the encoders "attributes" (names from measures) or another one, which is judged apart with the
masks "rgbd" (encoder-builtin-masks) and with a segmenter (encoder). Each room is judged by a
table that was fitted to the other rooms; printed are the expected calibration error, the share right at several coverages, and how many answers
are at or above several thresholds. `--source` fits one source alone: rooms that measures were developed with say nothing about measures. `--rooms`
fits to these rooms alone, `--check` judges others by that table. `--write` replaces the table.
Isotonic regression (pool adjacent violators), read at fixed beliefs. Confidences in reports are led back to beliefs by the table in use. Needs only
Python's standard library.
"""

import argparse
import json
from pathlib import Path

TABLE = Path(__file__).parents[1] / "crates/uniground-grounding/src/reasoner/confidence.tsv"
SOURCES = ("measures", "encoder", "encoder-builtin-masks")
AT = [0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.8, 1.0]
# Prior: this many answers with 0 % at belief 0 and with the mean at belief 1, because few answers have the highest beliefs.
PRIOR = 5
THRESHOLDS = (0.4, 0.5, 0.6, 0.7)
COVERAGES = (0.25, 0.5, 0.75, 1.0)


def table_in_use():
    """Returns for each source the (belief, share) pairs of the table."""
    rows = [line.split("\t") for line in TABLE.read_text().splitlines() if not line.startswith("#")]
    return {source: [(float(at), float(share)) for name, at, share in rows if name == source] for source in SOURCES}


def belief_of(confidence, curve):
    """Returns the lowest belief with this confidence."""
    for (x0, y0), (x1, y1) in zip(curve, curve[1:]):
        if confidence <= y1:
            return x1 if y1 == y0 else x0 + (x1 - x0) * (confidence - y0) / (y1 - y0)
    return curve[-1][0] if curve else confidence


def answers(report, curves):
    """Yields (source, scene, belief, right) of every answer with a box."""
    for cell in json.loads(Path(report).read_text())["cells"]:
        configuration = cell["configuration"]
        if configuration["source"] != "parsed" or configuration["names"] != "own":
            continue
        source = "measures" if configuration["encoder"] == "attributes" else "encoder"
        if source == "encoder" and configuration["masks"] == "rgbd":
            source = "encoder-builtin-masks"
        for outcome in cell["outcomes"]:
            reply = outcome["reply"]
            if reply and reply["status"] in ("grounded", "uncertain"):
                target = outcome["target"]
                right = target is not None and target["iou"] >= 0.25
                yield source, outcome["scene"], belief_of(reply["confidence"], curves[source]), float(right)


def isotonic(rows):
    """Isotonic regression from belief to share right: a list of (belief, share)."""
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


def fit(rows):
    curve = isotonic(rows)
    return [(at, round(read(curve, at), 2)) for at in AT]


def calibration_error(rows):
    """Returns the expected calibration error over tenths."""
    bins = {}
    for confidence, right in rows:
        bins.setdefault(min(int(confidence * 10), 9), []).append((confidence, right))
    return sum(abs(sum(b for b, _ in v) - sum(r for _, r in v)) for v in bins.values()) / max(len(rows), 1)


def describe(title, judged):
    """Prints error, share right by coverage, and what thresholds keep, of (confidence, right) pairs."""
    count = len(judged)
    if not count:
        print(f"  {title}: no answers")
        return
    share = lambda rows: sum(right for _, right in rows) / max(len(rows), 1)
    best_first = sorted(judged, reverse=True)
    kept = [f"{coverage:.0%}: {share(best_first[: max(round(coverage * count), 1)]):.2f}" for coverage in COVERAGES]
    above = [(t, [row for row in judged if row[0] >= t]) for t in THRESHOLDS]
    print(f"  {title}: {count} answers, {share(judged):.2f} right, calibration error {calibration_error(judged):.3f}")
    print("    right at coverage  " + ", ".join(kept))
    print("    right at or above  " + ", ".join(f"{t}: {share(rows):.2f} of {len(rows)}" for t, rows in above))


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("reports", nargs="+")
    parser.add_argument("--source", choices=SOURCES)
    parser.add_argument("--rooms", default="")
    parser.add_argument("--check", default="")
    parser.add_argument("--write", action="store_true")
    args = parser.parse_args()
    curves = table_in_use()
    rows = [row for report in args.reports for row in answers(report, curves)]
    of = lambda names: set(filter(None, names.split(",")))
    check = of(args.check)
    rooms = of(args.rooms) or {scene for _, scene, _, _ in rows} - check
    lines, summary = [], []
    for source in SOURCES:
        fitted = [(scene, belief, right) for name, scene, belief, right in rows if name == source and scene in rooms]
        if args.source not in (None, source) or not fitted:
            summary += [line[2:] for line in TABLE.read_text().splitlines() if line.startswith(f"# {source}:")]
            lines += [f"{source}\t{at}\t{share}" for at, share in curves[source]]
            continue
        print(source)
        held_out = []
        for scene in sorted({scene for scene, _, _ in fitted}):
            table = fit([(belief, right) for other, belief, right in fitted if other != scene] or [(0.5, 0.0)])
            held_out += [(read(table, belief), right) for other, belief, right in fitted if other == scene]
        describe("each room by a table of the others", held_out)
        table = fit([(belief, right) for _, belief, right in fitted])
        unseen = [(read(table, belief), right) for name, scene, belief, right in rows if name == source and scene in check]
        if check:
            describe("rooms outside the fit", unseen)
        lines += [f"{source}\t{at}\t{share}" for at, share in table]
        summary.append(f"{source}: {len(fitted)} answers in {len({s for s, _, _ in fitted})} rooms, error {calibration_error(held_out):.3f}")
    print("\n".join(lines))
    if args.write:
        head = (
            "# Share of right answers (IoU 0.25) by the belief they were given with, for names from measures, from an encoder that saw instances of a\n"
            "# segmenter, and from one that saw instances of the built-in masks; read linearly between.\n"
            "# Written by scripts/fit-confidence.py. Each room judged by a table of the others:\n"
        )
        TABLE.write_text(head + "".join(f"# {line}\n" for line in summary) + "\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
