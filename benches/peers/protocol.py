"""How a peer talks to the bench: one command a line on stdin, one line back with the milliseconds the peer measured itself.

The first line out is `ready <versions>`. An answer is `<ms> <what came out>`, or `error <why>`, after which the next command
may follow. Starting Python and importing the library are thus over before anything is timed.
"""

import os
import sys
import time


def timed(work):
    """Milliseconds that `work` takes, and what it returns."""
    start = time.perf_counter()
    result = work()
    return (time.perf_counter() - start) * 1e3, result


def serve(peer):
    """Answers commands until stdin ends. `peer.name(*words)` returns milliseconds and a few words on the result."""
    # Whatever the library itself prints must not pass for an answer.
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)
    print("ready", peer.versions, file=answers)
    for line in sys.stdin:
        name, *words = line.split()
        try:
            ms, gives = getattr(peer, name)(*words)
            print(f"{ms:.4f} {gives}", file=answers)
        except Exception as error:  # any failure of a peer is a row of the table, not the end of the bench
            print("error", " ".join(f"{type(error).__name__}: {error}".split()), file=answers)
