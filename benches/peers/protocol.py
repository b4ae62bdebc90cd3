"""The protocol between a peer and the bench: one command per line on stdin, one line back with the milliseconds that the peer measured.

The first output line is `ready <versions>`. An answer is `<ms> <result>` or `error <reason>`; then the next command may follow. Starting
Python and importing the library are therefore not timed.
"""

import os
import sys
import time


def timed(work):
    """Returns the milliseconds that `work` takes, and its result."""
    start = time.perf_counter()
    result = work()
    return (time.perf_counter() - start) * 1e3, result


def serve(peer):
    """Answers commands until stdin ends. `peer.name(*words)` returns milliseconds and a short description of the result."""
    # Output of the library itself must not be taken for an answer.
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
