#!/usr/bin/env python3
"""Tests the classification of repeated model calls with synthetic calls; times are seconds from the first."""
import sys
from pathlib import Path

sys.dont_write_bytecode = True
sys.path.insert(1, str(Path(__file__).resolve().parents[1] / "soak"))

from fleet import Disturbance
from cluster_checks import KEPT, KILLED, LATE, NOTHING, STOPPED, repeated_calls
from model import Call

KILL = Disturbance("worker-1.0", KILLED, 1.0, 1.5)
PAUSE = Disturbance("worker-1.0", STOPPED, 1.0, 15.0)
NAP = Disturbance("worker-1.0", STOPPED, 1.0, 4.0)
# Calls by process and time; disturbances; when the answer was stored; the expected result.
STORIES = {
    "one call is none too many": ([("worker-1.0", 0)], [KILL], 2, {}),
    "killed under a call: once more": ([("worker-1.0", 0), ("worker-2.0", 8)], [KILL], 10, {KILLED: 1}),
    "but not twice more": ([("worker-1.0", 0), ("worker-2.0", 8), ("worker-2.0", 9)], [KILL], 10, {KILLED: 1, NOTHING: 1}),
    "killed elsewhere: no reason": ([("worker-2.0", 0), ("worker-3.0", 8)], [KILL], 10, {NOTHING: 1}),
    "killed before the call: no reason": ([("worker-1.0", 2), ("worker-3.0", 8)], [KILL], 10, {NOTHING: 1}),
    "killed after the answer was kept": ([("worker-1.0", 0), ("worker-2.0", 8)], [KILL], 0.9, {KEPT: 1}),
    "still past the lease under a call: once more": ([("worker-1.0", 0), ("worker-2.0", 12)], [PAUSE], 14, {STOPPED: 1}),
    "still for less than that: no reason": ([("worker-1.0", 0), ("worker-2.0", 12)], [NAP], 14, {NOTHING: 1}),
    "awake, and asks what another has answered": ([("worker-2.0", 12), ("worker-1.0", 15.1)], [PAUSE], 14, {LATE: 1}),
    "awake, and asks what another is about to ask": ([("worker-1.0", 15.1), ("worker-2.0", 18)], [PAUSE], 20, {LATE: 1}),
    "still under a call, awake, and once more": ([("worker-1.0", 0), ("worker-1.0", 15.1), ("worker-2.0", 18)], [PAUSE], 20, {LATE: 1, STOPPED: 1}),
}
# The same, if the batch was claimed at this moment.
TAKEN_UP = {
    "awake, takes the job again, and asks once more": ([("worker-1.0", 0), ("worker-1.0", 15.3)], [PAUSE], 20, 15.2, {STOPPED: 1}),
    "awake, while another takes it up and asks": ([("worker-1.0", 0), ("worker-2.0", 15.3), ("worker-1.0", 15.4)], [PAUSE], 20, 15.2, {LATE: 1, STOPPED: 1}),
    "awake, when another has had it for long": ([("worker-1.0", 0), ("worker-1.0", 15.3)], [PAUSE], 20, 12.0, {LATE: 1}),
}


def main():
    wrong, stories = 0, {story: (*told[:3], [], told[3]) for story, told in STORIES.items()}
    stories |= {story: (*told[:3], [("batch", told[3])], told[4]) for story, told in TAKEN_UP.items()}
    for story, (calls, disturbances, kept, claims, wanted) in stories.items():
        made = [Call("which chair", 1, who, at, 0.0) for who, at in calls]
        told = repeated_calls(made, disturbances, {"which chair": kept}, 10, claims, lambda _: "batch")
        found = {why: len(calls) for why, calls in told.items() if calls}
        if found != wanted:
            print(f"{story}: {found}, not {wanted}")
            wrong += 1
    print(f"{len(stories) - wrong} passed, {wrong} failed")
    sys.exit(bool(wrong))


if __name__ == "__main__":
    main()
