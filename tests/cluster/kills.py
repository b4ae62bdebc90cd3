#!/usr/bin/env python3
"""A cluster whose processes are killed, and frozen past their leases, while they parse and call a model: every job finishes once, no call is paid
twice, nothing is lost, and all APIs return the same.

usage: kills.py --program PROGRAM --database postgres://… --log FILE --stop COMMAND --start COMMAND [--store S3S_FS] [--quick | --full] [--seed N] [--keep FOLDER]

The database is empty and belongs to a PostgreSQL server whose superuser the URL names; FILE is that server's log (scripts/test-cluster.sh starts one).
In the middle of the run the database is down for a while: COMMANDs stop and start its server. Without --store all processes share a data folder; with it
each has its own, files are in that S3 server, and it is frozen while the database is down. Needs only Python's standard library and psql. The seed
determines the planned moments, but not the machine's timing, so a failed run prints its observations.
"""
import argparse
import os
import random
import resource
import shutil
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

sys.dont_write_bytecode = True
sys.path.insert(1, str(Path(__file__).resolve().parents[1] / "soak"))

import cluster_checks
import plans
import throughput
from callers import Caller, Clients
from fleet import Fleet
from model import Model
from object_store import BUCKET, ObjectStore
from questions import questions
from scans import Scans
from server import Server, log_lines
from sql import WITNESS, Database
from table import Table
from wire import Connection

# The shortest possible lease, so that freezing a process past it does not take long.
LEASE_S = 10
# Parses, questions of each of three batches, disturbances, the model's average seconds per call (so that batches last as long as the disturbances,
# and a kill finds calls in progress), and the time limit in seconds.
QUICK, SHORT, FULL = (4, 30, 4, 3.5, 900), (8, 60, 8, 3.0, 1500), (60, 500, 60, 3.2, 3600)
BATCHES, FRAMES = 3, 6
# The disturbances of the quick form: a worker and an API killed, and one of each frozen.
SEED, SEED_OF_QUICK = 20261124, 43
# Duration of the outage of the database and the file store.
AWAY_S = 20


def items_of(scenes, number):
    """Returns three batches of different questions. Every fourth question uses photographs, which take time to render."""
    asked = questions(BATCHES * number, 7)
    wanted = lambda at: {} if at % 4 == 0 else {"ablation": "no_candidate"}
    return [[{"scene_id": scenes[at % len(scenes)], "query": asked[batch * number + at], "reasoner": "vlm", **wanted(at)} for at in range(number)]
            for batch in range(BATCHES)]


def undisturbed(program, folder, number, scans):
    """Returns the results of the same batches by one undisturbed server on SQLite, and the number of calls."""
    model = Model()
    with Server(program, folder / "calm", folder / "calm.log", *model.flags) as server:
        server.ready()
        fleet = CalmFleet(server)
        caller = Caller(fleet)
        batches = [caller.batch(items, f"batch-{at}") for at, items in enumerate(items_of(prepared(fleet, scans), number))]
        results = [server.connection().call("GET", f"/v1/batches/{batch}/results").body.splitlines() for batch in batches]
        server.terminate()
    model.shutdown()
    return results, len(model.calls)


class CalmFleet:
    """A single server with the interface of a fleet."""

    def __init__(self, server):
        self.server = server

    def addresses(self):
        return [self.server.address]


def prepared(fleet, scans):
    """Uploads and parses the scenes that batches ask about."""
    caller = Caller(fleet)
    made = [caller.upload(scans, f"base-{at}") for at in range(3)]
    for created in made:
        job = caller.finished(created["job"]["id"])
        if job["state"] != "succeeded":
            raise AssertionError(f"the sample scan could not be parsed: {job}")
    return [created["scene"]["id"] for created in made]


def storm(fleet, crowd, number, dice, outage):
    """Disturbs processes at seeded moments, the last while work remains; one at a time, so that a process is always available. The outage is in
    the middle."""
    for at in range(number):
        time.sleep(dice.uniform(0.3, 2.0))
        if crowd.is_over():
            return at
        if at == number // 2:
            outage()
        # Workers in three of four cases, because they run the jobs.
        member = dice.choice(fleet.of(dice.choice(["worker", "worker", "worker", "api"])))
        how = dice.choice(["killed", "killed", "stopped"])
        fleet.disturb(member, how, dice.uniform(0.1, 1.0) if how == "killed" else LEASE_S * dice.uniform(1.3, 2.0))
    return number


def outage(table, fleet, options, store):
    """Stops the database, and the file store with it: every API reports it and recovers soon afterwards."""
    shell = lambda command: subprocess.run(shlex.split(command), check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    ready = lambda address: Connection(address, 5).call("GET", "/readyz").status
    shell(options.stop)
    if store:
        store.freeze()
    time.sleep(AWAY_S / 2)
    away = [ready(address) for address in fleet.addresses()]
    time.sleep(AWAY_S / 2)
    if store:
        store.thaw()
    shell(options.start)
    back = time.time()
    while any(ready(address) != 200 for address in fleet.addresses()) and time.time() < back + 60:
        time.sleep(0.2)
    took = time.time() - back
    table.equal(f"/readyz while the database{' and the store of files are' if store else ' is'} away for {AWAY_S} s", away, [503] * len(away))
    table.row("ready again after the outage, s", f"{took:.1f}", "15 at most", took <= 15)


def run(table, options, folder, most, store):
    parses, number, disturbances, pace_s, limit_s = most
    program, database, scans = options.program.resolve(), Database(options.database), Scans(FRAMES)
    start = time.time()
    expected, calm_calls = undisturbed(program, folder, number, scans)
    table.row("undisturbed, one server", f"{time.time() - start:.0f} s, {calm_calls} model calls")
    model = Model()
    model.pace_s = pace_s
    blobs = f"s3://{BUCKET}" if store else None
    with Fleet(program, folder, options.database, model, LEASE_S, blobs).add() as fleet:
        database.run(WITNESS)
        scenes = prepared(fleet, scans)
        items = items_of(scenes, number)
        single = questions(BATCHES * number + 1000, 7)[BATCHES * number:]
        start = time.time()
        crowd = Clients(fleet, scans, scenes, items, single, parses, limit_s / 2)
        done = storm(fleet, crowd, disturbances, random.Random(options.seed), lambda: outage(table, fleet, options, store))
        storm_s = time.time() - start
        crowd.end()
        # A fast machine finishes before all disturbances have happened.
        table.row("storm", f"{done} of {disturbances} disturbances in {storm_s:.0f} s; all finished after {time.time() - start:.0f} s", "half of them or more",
                  2 * done >= disturbances)
        cluster_checks.storm(table, fleet, database, crowd, model, items)
        cluster_checks.replicas(table, fleet, crowd, scenes, expected)
        cluster_checks.ends(table, fleet.end())
        numbers = sum((log_lines(folder / f"{member.name}.log")[0] for member in fleet.members), start=Counter())
        table.row("errors in the logs", ", ".join(f"{count} {what}" for what, count in numbers.most_common(3)) or "0", "for information")
    if most is QUICK:
        model.shutdown()
        return
    throughput.run(table, program, folder, database, model, scans, blobs, LEASE_S, *((4, 2) if most is SHORT else (12, 3)))
    plans.run(table, program, folder, database, model, scenes, scans, options.log, blobs, LEASE_S)
    model.shutdown()


def too_long(*_):
    raise AssertionError("the run exceeded its time limit")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--program", required=True, type=Path, help="the binary under test")
    parser.add_argument("--database", required=True, help="an empty PostgreSQL database")
    parser.add_argument("--log", required=True, type=Path, help="the log of its server")
    parser.add_argument("--stop", required=True, help="stops that server")
    parser.add_argument("--start", required=True, help="starts it again")
    parser.add_argument("--store", type=Path, help="an S3 server for files; each process has a data folder of its own then")
    length = parser.add_mutually_exclusive_group()
    length.add_argument("--quick", action="store_true", help="4 parses, three batches of 30, 4 disturbances; no throughput, no plans of statements")
    length.add_argument("--full", action="store_true", help="60 parses, three batches of 500, 60 disturbances")
    parser.add_argument("--seed", type=int)
    parser.add_argument("--keep", type=Path, help="keep data folders and logs in this folder")
    options = parser.parse_args()
    options.seed = options.seed or (SEED_OF_QUICK if options.quick else SEED)
    most = QUICK if options.quick else FULL if options.full else SHORT
    hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    # However it ends, no process stays behind.
    signal.signal(signal.SIGALRM, too_long)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit("ended"))
    signal.alarm(most[-1])
    folder = options.keep or Path(tempfile.mkdtemp(prefix="cluster-"))
    folder.mkdir(parents=True, exist_ok=True)
    table = Table(f"cluster: 2 APIs, 3 workers, {most[0]} parses, {BATCHES} batches of {most[1]}, lease {LEASE_S} s, seed {options.seed}")
    store = ObjectStore(options.store.resolve(), folder / "store") if options.store else None
    try:
        os.environ.update(store.environment() if store else {})
        run(table, options, folder, most, store)
    finally:
        if store:
            store.kill()
        table.print()
        if not options.keep:
            shutil.rmtree(folder, ignore_errors=True)
    print("everything held" if not table.failed else "did not hold: " + "; ".join(table.failed))
    sys.exit(bool(table.failed))


if __name__ == "__main__":
    main()
