"""Kills at seeded moments while a server receives uploads, parses, runs a batch with a model and does maintenance. Acknowledged data must be
there, started work must finish, and no stored answer may be paid for twice.
"""
import random
import threading
import time
from dataclasses import dataclass, field

import kill_checks
from model import Model
from questions import questions
from records import Records
from scans import Scans
from server import Server, doctor, log_lines
from table import Table
from wire import expect
from workload import OTHER_SETTINGS, Asker, Batch, Uploader, follow_job, instances, upload

SEED = 20261122
# Default concurrency of a batch: the maximum number of calls in progress at a kill.
WIDTH = 4
# Average life of a server between two kills in seconds; used for the model's pace.
USUAL_LIFE_S = 1.5
# A server starts maintenance a minute after its start.
HOUSEKEEPING_S = 60
# Consecutive lives that together lasted this long and produced this many answers have advanced a batch, even without the last half second of each,
# because progress is saved twice a second.
LONG_S, MANY_ANSWERS = 3.0, 20
# Remaining work must finish within this time.
END_S = {False: 180, True: 1200}


@dataclass
class Life:
    """One server, from its start to its kill."""
    moment: str
    killed: float = 0.0
    lasted_s: float = 0.0
    # Items of the batch with a stored answer after the kill.
    kept: set = field(default_factory=set)
    open_items: int = 0
    # How many consecutive interruptions of the batch's job the server counts; None if it was not running.
    interruptions: int = None


@dataclass
class KillRun:
    """Everything recorded during the kills."""
    items: list
    model: Model
    lives: list = field(default_factory=list)
    complaints: list = field(default_factory=list)
    # Reservations that a kill left open, by id, in US dollars.
    reserved: dict = field(default_factory=dict)


def moments(kills, full):
    """Returns the moment at which each server is killed: how it is found, and how long it takes."""
    dice = random.Random(SEED)
    plan = []
    for kill in range(kills):
        if kill == 0:
            # In the middle of the batch's submission.
            plan.append(("any", 0.15))
        elif full and kill % 33 == 30:
            plan.append(("housekeeping", HOUSEKEEPING_S + dice.uniform(0.0, 4.0)))
        else:
            # During startup; shortly after a reply of the model, while its answer is being stored; at any moment.
            kind = dice.choices(["starting", "reply", "any"], [15, 35, 50])[0]
            wait = {"starting": dice.uniform(0.0, 0.15), "reply": dice.uniform(0.0, 0.02), "any": dice.uniform(0.3, 3.5)}[kind]
            # In the short form long enough for a parse to make progress. A parse without progress is delayed for 30 s, which the short form cannot
            # wait for.
            plan.append((kind, wait if full or kind != "any" else 1.2 + wait / 4))
    return plan


def items_of(scenes, number):
    """Returns different questions for the model. Every fourth uses photographs, which take time to render."""
    wanted = [{} if i % 4 == 0 else {"ablation": "no_candidate"} for i in range(number)]
    asked = questions(number, SEED)
    return [{"scene_id": scenes[i % len(scenes)], "query": asked[i], "reasoner": "vlm", **wanted[i]} for i in range(number)]


def prepare(server, scans):
    """Uploads the scenes that the batch asks about."""
    connection = server.connection()
    scenes = []
    for name in ("base-0", "base-1"):
        created = upload(connection, scans, name)
        job = follow_job(connection, created["job"]["id"])
        if job["state"] != "succeeded":
            raise AssertionError(f"the sample scan could not be parsed: {job}")
        scenes.append(created["scene"]["id"])
    return scenes


def undisturbed(program, folder, number, scans):
    """Returns the results of an undisturbed server: those of the batch, and the instances of both parses of a variant."""
    model = Model()
    with Server(program, folder / "calm", folder / "calm.log", *model.flags) as server:
        scenes = prepare(server.ready(), scans)
        batch, stop = Batch(items_of(scenes, number)), threading.Event()
        watching = threading.Thread(target=watch, args=(server, batch, [], stop), daemon=True)
        watching.start()
        batch.live(server)
        stop.set()
        watching.join()
        connection = server.connection()
        first = instances(connection, scenes[0])
        job = expect(connection.call("POST", f"/v1/scenes/{scenes[0]}/parse", OTHER_SETTINGS), 202)
        follow_job(connection, job["id"])
        second = instances(connection, scenes[0])
        server.terminate()
    model.shutdown()
    stumbled = log_lines(folder / "calm.log", ("WARN", "ERROR"))[0]["job failed"]
    return kill_checks.answers(batch.followed), (first, second), len(model.calls), stumbled


def no_reason_to_wait(lives):
    """Returns why the batch's retry delay was wrong: items were answered in the lives that the server counts as without progress. None if that is
    unknown."""
    if not lives or (lives[-1].interruptions or 0) < 2:
        return None
    # Those counted before the last kill, and the one that this kill ended.
    counted = lives[-lives[-1].interruptions - 1:]
    before = lives[-len(counted) - 1].kept if len(lives) > len(counted) else set()
    lasted, gained = sum(life.lasted_s for life in counted), len(counted[-1].kept) - len(before)
    if lasted < LONG_S or gained < MANY_ANSWERS:
        return None
    return f"for want of progress, after {len(counted)} lives of {lasted:.1f} s together in which {gained} items were answered"


def watch(server, batch, lives, stop):
    """Restarts the batch's job whenever it waits for a retry, so that kills happen during its work."""
    why = no_reason_to_wait(lives)
    connection = server.connection()
    while not stop.wait(0.6):
        if batch.id is None:
            continue
        state = expect(connection.call("GET", f"/v1/batches/{batch.id}"), 200)
        job = expect(connection.call("GET", f"/v1/jobs/{state['job_id']}"), 200)
        if state["state"] == "running" and job["state"] == "queued" and job["attempts"] > 0:
            batch.put_off += 1
            batch.put_off_wrongly += [why] if why else []
            why = None
            batch.stopped.add(job["id"])
            connection.call("DELETE", f"/v1/jobs/{job['id']}")


def at_work(storm, server, workers, stop):
    """Starts the threads of all clients. They stop when the server is killed; errors are reported."""
    def live(work, *arguments):
        try:
            work(*arguments)
        except (OSError, ValueError) as error:
            # A truncated reply; before the kill there is no reason for one.
            if not stop.is_set():
                storm.complaints.append(f"{work.__qualname__}: {type(error).__name__}: {error}")
        except Exception as error:  # pylint: disable=broad-except
            storm.complaints.append(f"{work.__qualname__}: {type(error).__name__}: {error}")
    batch = next(worker for worker in workers if isinstance(worker, Batch))
    threads = [threading.Thread(target=live, args=(worker.live, server), daemon=True) for worker in workers]
    threads.append(threading.Thread(target=live, args=(watch, server, batch, storm.lives, stop), daemon=True))
    for thread in threads:
        thread.start()
    return threads


def pace(life, left, storm, number):
    """Returns the model's pace for which the batch lasts as long as the kills."""
    open_items = storm.lives[-1].open_items if storm.lives and storm.lives[-1].kept else number
    expected_s = life[1] if life[0] == "housekeeping" else USUAL_LIFE_S
    return min(1.0, max(0.005, WIDTH * expected_s * (left + 3) / max(open_items, 1) - 0.1))


def one_life(program, folder, storm, workers, moment):
    """Runs a server from its start to its kill."""
    kind, wait = moment
    life, stop, threads = Life(kind), threading.Event(), []
    data, model = folder / "storm", storm.model
    server = Server(program, data, folder / "storm.log", *model.flags)
    with server:
        if kind == "starting":
            time.sleep(wait)
            began = time.time()
        else:
            server.ready()
            began = time.time()
            threads = at_work(storm, server, workers, stop)
            if kind == "reply":
                model.wait_for_replies(1 + int(wait * 1000) % 12, 4.0)
            time.sleep(wait)
        stop.set()
        life.killed = time.time()
        server.kill()
    life.lasted_s = life.killed - began
    for thread in threads:
        thread.join(20)
    model.life += 1
    if (data / "uniground.sqlite").exists():
        with Records(data) as records:
            life.kept, life.open_items = {item for _, item in records.kept_items()}, records.open_items()
            running = [job["interruptions"] for job in records.jobs() if job["kind"] == "batch" and job["state"] == "running"]
            life.interruptions = max(running, default=None)
            storm.reserved |= {row["id"]: row["usd"] for row in records.rows("SELECT id, usd FROM reservations")}
    storm.lives.append(life)


def finish(program, folder, storm, workers, full):
    """Runs the last server without a kill until all work is done. Returns its final state and how it stopped."""
    batch, stop, began = next(worker for worker in workers if isinstance(worker, Batch)), threading.Event(), time.time()
    storm.model.pace_s = 0.005
    with Server(program, folder / "storm", folder / "storm.log", *storm.model.flags) as server:
        server.ready()
        uploader, asker = workers[0], workers[2]
        # Started work finishes, and nothing new starts; the final server keeps its place in the call records.
        uploader.most = uploader.begun
        threads = at_work(storm, server, [uploader, batch], stop)
        for thread in threads[:2]:
            thread.join(max(1.0, began + END_S[full] - time.time()))
        stop.set()
        if any(thread.is_alive() for thread in threads[:2]):
            storm.complaints.append(f"not everything was over after {END_S[full]} s")
        told = kill_checks.FinalState(server, batch, uploader, asker)
        told.exit_code = server.terminate()
    return told


def run(program, folder, full, kills=None):
    """Runs everything and returns the table."""
    kills, number = kills or (100 if full else 5), 2000 if full else 200
    table, scans = Table(f"kills: {kills} SIGKILLs, a batch of {number}, seed {SEED}"), Scans(6)
    start = time.time()
    expected, parses, calls, stumbled = undisturbed(program, folder, number, scans)
    table.row("undisturbed run", f"{time.time() - start:.0f} s, {calls} model calls, failed job attempts {stumbled}",
              "failed 0", stumbled == 0)
    model = Model()
    with Server(program, folder / "storm", folder / "storm.log", *model.flags) as server:
        scenes = prepare(server.ready(), scans)
        server.terminate()
    storm = KillRun(items_of(scenes, number), model)
    batch = Batch(storm.items)
    workers = [Uploader(scans, kills // 4 + 1, SEED), batch, Asker(scenes, questions(number + 100, SEED)[number:])]
    start = time.time()
    plan = moments(kills, full)
    for at, moment in enumerate(plan):
        model.pace_s = pace(moment, len(plan) - at, storm, number)
        one_life(program, folder, storm, workers, moment)
    storm_s, start = time.time() - start, time.time()
    told = finish(program, folder, storm, workers, full)
    table.row("kills", f"{storm_s:.0f} s; the end {time.time() - start:.0f} s")
    model.shutdown()
    kill_checks.judge_batch_job(table, batch)
    kill_checks.judge(table, storm, told, expected, parses, folder / "storm", full)
    numbers, examples = log_lines(folder / "storm.log", ("WARN", "ERROR"))
    # The model always answers and the disk has space, so no job has a reason to fail.
    table.equal("tries of jobs that failed, by the log", numbers["job failed"], 0)
    kill_checks.judge_folder(table, *doctor(program, folder / "storm"))
    for message, count in numbers.most_common(8):
        table.note(f"log, {count} times: {examples[message][:300]}")
    return table
