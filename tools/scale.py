#!/usr/bin/env python3
"""What uniground needs for so many questions: a discrete simulation of its queues with measured service times.

scale.py [load] [size]                                 how long each kind of request takes then, and what is used how much
scale.py --least cores --p99-ms 50 [load] [size]       the fewest cores (workers, databases, ...) that hold a promise
scale.py --check                                       what was measured beside what the simulation makes of it
scale.py --table, scale.py --inputs                    the tables of docs/SCALE.md

The figures are in tools/scale.json, each with its source; --figures takes others. Needs nothing but Python 3.9.
"""
import argparse
import sys
from dataclasses import fields, replace
from pathlib import Path
from typing import List, Optional, Tuple

import scale_table
from service_model import FIGURES, KINDS, Figures, Load, Size, check, least, simulate, stations_of, window_s
from stations import Clock, percentile


def run_lines(figures: Figures, load: Load, size: Size, seconds: float) -> List[str]:
    """What a run tells people."""
    came, servers = simulate(figures, load, size, seconds), stations_of(figures, size, Clock())
    lines = [f"{'request':16}{'ended':>10}{'p50 ms':>12}{'p99 ms':>12}"]
    for kind, took in came.took_ms.items():
        lines.append(f"{kind:16}{len(took):>10,}{percentile(took, 0.5):>12,.1f}{percentile(took, 0.99):>12,.1f}")
    lines.append(f"{'station':16}{'servers':>10}{'used':>12}{'asked for':>12}{'waiting':>12}  its queue")
    for name, (used, asked, waiting, grew) in came.stations.items():
        if asked:
            state = "grows" if grew else "ends"
            lines.append(f"{name:16}{servers[name].meter.servers:>10,}{used:>12.2f}{asked:>12.2f}{waiting:>12,.1f}  {state}")
    full = came.saturated()
    lines.append(f"{'saturated: ' + ', '.join(full) if full else 'nothing is saturated'}; the bottleneck is: {came.bottleneck()}")
    return lines


def check_lines(rows: List[Tuple[str, float, float, float]]) -> List[str]:
    lines = [f"{'':28}{'measured':>10}{'simulated':>12}{'ratio':>8}  may be"]
    for what, measured, simulated, factor in rows:
        held = "" if within(measured, simulated, factor) else "  <-- FAILED"
        lines.append(f"{what:28}{measured:>10,.1f}{simulated:>12,.1f}{simulated / measured:>8.2f}  {1 / factor:.2f} to {factor:.2f}{held}")
    return lines


def within(measured: float, simulated: float, factor: float) -> bool:
    return 1 / factor <= simulated / measured <= factor


def least_line(figures: Figures, load: Load, size: Size, words: argparse.Namespace) -> str:
    seconds = words.seconds or window_s(load)
    number = least(figures, load, size, words.least, words.kind, words.p99_ms, seconds)
    if number is None:
        return f"no number of {words.least} holds a p99 of {words.p99_ms:g} ms for a {words.kind}: something else is in the way"
    p99 = simulate(figures, load, replace(size, **{words.least: number}), seconds).p99_ms(words.kind)
    return f"{words.least}: {number}, with which the p99 of a {words.kind} is {p99:,.1f} ms"


def arguments(words: Optional[List[str]] = None) -> argparse.Namespace:
    """Every field of a load and of a size is a flag."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for group, told in (("load", Load()), ("size", Size())):
        flags = parser.add_argument_group(group)
        for field in fields(told):
            default = getattr(told, field.name)
            choices = ["none", "cores", "gpu"] if field.name == "networks" else None
            flag = "--" + field.name.replace("_", "-")
            flags.add_argument(flag, type=type(default), default=default, choices=choices, help=f"default {default}")
    parser.add_argument("--least", choices=[field.name for field in fields(Size)])
    parser.add_argument("--kind", default="question", choices=KINDS, help="whose p99 counts for --least; default question")
    parser.add_argument("--p99-ms", type=float, default=50.0)
    parser.add_argument("--seconds", type=float, help="how long is simulated; default ten thousand questions")
    parser.add_argument("--figures", type=Path, default=FIGURES)
    for mode in ("check", "table", "inputs"):
        parser.add_argument(f"--{mode}", action="store_true")
    found = parser.parse_args(words)
    if min(getattr(found, field.name) for field in fields(Size)) < 1:
        parser.error("there is at least one of everything")
    return found


def taken(of: type, words: argparse.Namespace):
    """The load or the size that the flags say."""
    return of(**{field.name: getattr(words, field.name) for field in fields(of)})


def main(words: argparse.Namespace) -> int:
    figures, load, size = Figures(words.figures), taken(Load, words), taken(Size, words)
    if words.check:
        rows = check(figures)
        print("\n".join(check_lines(rows)))
        return 0 if all(within(*row[1:]) for row in rows) else 1
    if words.table or words.inputs:
        print("\n".join(scale_table.inputs(figures) if words.inputs else scale_table.tables(figures)))
    elif words.least:
        print(least_line(figures, load, size, words))
    else:
        print("\n".join(run_lines(figures, load, size, words.seconds or window_s(load))))
    return 0


if __name__ == "__main__":
    sys.exit(main(arguments()))
