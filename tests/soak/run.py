#!/usr/bin/env python3
"""Soak tests: months of load in minutes, by kills, connection floods and long lists.

usage: run.py --program target/release/uniground [--full] [--only kills|traffic|batch]

The short form asserts what holds on any machine, however busy; the full form also asserts the limits of time and memory. Each part prints one
table; the exit code is 1 if a check failed. Needs only Python's standard library, and Linux for process sizes.
"""
import argparse
import importlib
import os
import resource
import shutil
import sys
import tempfile
import time
from pathlib import Path

# Do not write bytecode into the checkout.
sys.dont_write_bytecode = True

PARTS = ["kills", "traffic", "batch"]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--program", required=True, type=Path, help="the binary under test")
    parser.add_argument("--full", action="store_true", help="the full form, about half an hour")
    parser.add_argument("--only", choices=PARTS)
    parser.add_argument("--kills", type=int, help="another number of kills")
    parser.add_argument("--seconds", type=int, help="another duration of the traffic")
    parser.add_argument("--keep", type=Path, help="keep data folders and logs in this folder")
    options = parser.parse_args()
    # Thousands of sockets, here and in the server, which inherits the limit.
    hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    failed, start = [], time.time()
    for part in [options.only] if options.only else PARTS:
        folder = (options.keep or Path(tempfile.gettempdir())) / f"soak-{part}-{os.getpid()}"
        folder.mkdir(parents=True)
        own = {"kills": {"kills": options.kills}, "traffic": {"seconds": options.seconds}}.get(part, {})
        try:
            table = importlib.import_module(part).run(options.program.resolve(), folder, options.full, **own)
        finally:
            if not options.keep:
                shutil.rmtree(folder, ignore_errors=True)
        table.print()
        failed += [f"{part}: {what}" for what in table.failed]
    print(f"{time.time() - start:.0f} s; " + ("everything held" if not failed else "did not hold: " + "; ".join(failed)))
    sys.exit(bool(failed))


if __name__ == "__main__":
    main()
