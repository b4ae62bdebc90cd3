"""Mixed traffic of 64 clients during parses, without and with a flood of idle streams and stalled uploads."""
import collections
import json
import threading
import time

from flood import Flood
from load import Load, percentile_ms
from machine import Watch
from model import Model
from questions import questions
from scans import Scans
from server import Server, log_lines
from table import Table
from wire import expect
from workload import follow_job, upload

CLIENTS = 64
# For traffic without a flood: the share that counts as warm-up, and the length of the first and last memory window.
WARM, WINDOW = 0.2, 0.2
# Correct statuses for a flood: its own limits, no permit, and 20 s of silence.
FLOOD_STATUSES = {200, 408, 429, 503}


class Parses:
    """Two users who upload scans continuously: each waits for the parse, deletes the scene and uploads the next. While stalled uploads hold all
    upload permits, they reparse another scene with new settings instead."""

    def __init__(self, server, scans, spares):
        self.over, self.done, self.refused, self.complaints, self.spares = threading.Event(), 0, 0, [], spares
        self.threads = [threading.Thread(target=self.one, args=(server, scans, number), daemon=True) for number in range(2)]
        for thread in self.threads:
            thread.start()

    def one(self, server, scans, number):
        connection, at = server.connection(), 0
        try:
            while not self.over.is_set():
                at += 1
                reply = connection.call("POST", "/v1/scenes", scans.variant(f"scan-{number}-{at}"), "application/zip")
                if reply.status == 429:
                    self.refused += 1
                    settings = {"settings": {"parsing": {"superpoints": {"voxel_m": 0.03 + 0.0001 * (at % 100)}}}}
                    job = expect(connection.call("POST", f"/v1/scenes/{self.spares[number]}/parse", settings), 202)
                    follow_job(connection, job["id"], 0.2)
                    self.done += 1
                    continue
                created = expect(reply, 202)
                job = follow_job(connection, created["job"]["id"], 0.2)
                if job["state"] != "succeeded":
                    self.complaints.append(f"a parse ended {job['state']}: {job['error']}")
                deleted = connection.call("DELETE", f"/v1/scenes/{created['scene']['id']}")
                if deleted.status not in (200, 202, 204):
                    self.complaints.append(f"deleting a scene answered {deleted.status}")
                self.done += 1
        except Exception as error:  # pylint: disable=broad-except
            self.complaints.append(f"uploads: {type(error).__name__}: {error}")

    def stop(self):
        self.over.set()
        for thread in self.threads:
            thread.join(120)


class Memory:
    """Records the server's resident megabytes twice a second."""

    def __init__(self, server):
        self.samples, self.over = [], threading.Event()
        self.thread = threading.Thread(target=self.look, args=(server,), daemon=True)
        self.thread.start()

    def look(self, server):
        while not self.over.wait(0.5):
            self.samples.append((time.time(), server.resident_mb()))

    def mean(self, begin, end):
        found = [mb for at, mb in self.samples if begin <= at < end]
        return sum(found) / len(found) if found else float("nan")

    def stop(self):
        self.over.set()
        self.thread.join()


def waiting_job(connection, scene):
    """Returns a job that stays unfinished for minutes: a batch whose model is slow."""
    item = json.dumps({"scene_id": scene, "query": "the red sofa", "reasoner": "vlm"}).encode()
    return expect(connection.call("POST", "/v1/batches", item, "application/jsonl"), 202)["job_id"]


def within(told, windows, kind):
    """Returns the latencies in seconds of requests of a kind that were sent within these periods."""
    return [took for what, at, took, status in told if what == kind and status < 400 and any(a <= at < b for a, b in windows)]


class Course:
    """The phases of the run: times of begin and end."""

    def __init__(self, begin, calm_s, full):
        self.turns, self.crowd_s, self.pause_s = (3, calm_s * 0.15, calm_s * 0.1) if full else (1, 5, 2)
        # A flood needs a moment to start and to end; its arrival is measured separately.
        self.arrival_s = 5 if full else 2
        self.calm = (begin, begin + calm_s)
        self.end = begin + calm_s + self.turns * (self.arrival_s + self.crowd_s + self.arrival_s + self.pause_s)
        # Alternating with and without a flood, including the last period before the first flood.
        self.crowds, self.arrivals, self.pauses = [], [], [(self.calm[1] - self.pause_s, self.calm[1])]

    def follow(self, make_crowd):
        """Starts and ends floods and returns the statuses they received."""
        told = []
        for _ in range(self.turns):
            crowd, at = make_crowd(), time.time()
            self.arrivals.append((at, at + self.arrival_s))
            time.sleep(self.arrival_s + self.crowd_s)
            self.crowds.append((at + self.arrival_s, time.time()))
            told.append(crowd.leave())
            time.sleep(self.arrival_s)
            at = time.time()
            time.sleep(max(0.1, min(self.pause_s, self.end - at)))
            self.pauses.append((at, time.time()))
        return told


def prepare(connection, scans, number):
    """Uploads and parses this many scenes."""
    scenes = []
    for at in range(number):
        created = upload(connection, scans, f"base-{at}")
        job = follow_job(connection, created["job"]["id"])
        if job["state"] != "succeeded":
            raise AssertionError(f"the sample scan could not be parsed: {job}")
        scenes.append(created["scene"]["id"])
    return scenes


def run(program, folder, full, seconds=None):
    """Runs everything and returns the table."""
    calm_s = seconds or (300 if full else 10)
    streams, uploads = (2000, 1000) if full else (200, 100)
    table = Table(f"traffic: {CLIENTS} clients beside two people who upload, {calm_s} s, then in turns with a crowd of {streams} + {uploads}")
    scans, model, asked = Scans(None if full else 6), Model(), questions(500, 1)
    model.pace_s = 3600
    with Server(program, folder / "data", folder / "log", *model.flags, "--max-connections", 8192 if full else 1024) as server:
        connection = server.ready().connection()
        # Two scenes are not queried.
        *scenes, spare, other_spare = prepare(connection, scans, 5)
        # The generator's own overhead: the same clients with a trivial request.
        alone, _ = Load(server.address, scenes, asked, CLIENTS, time.time() + (5 if full else 2), {"healthz": 1}).told()
        nothing = [took for _, _, took, _ in alone]
        table.row("generator: /healthz, server idle", f"p50 {percentile_ms(nothing, 0.5):.1f}, p99 {percentile_ms(nothing, 0.99):.1f} ms", "for information")
        job, memory, parses = waiting_job(connection, scenes[0]), Memory(server), Parses(server, scans, (spare, other_spare))
        course, watch = Course(time.time(), calm_s, full), Watch(server)
        load = Load(server.address, scenes, asked, CLIENTS, course.end, seed=1000)
        time.sleep(calm_s)
        done_calm, peak_calm = parses.done, server.peak_mb()
        crowd_told = course.follow(lambda: Flood(server.address, job, streams, uploads))
        told, closed_idle = load.told()
        peak = server.peak_mb()
        watch.row(table)
        parses.stop()
        memory.stop()
        code = server.terminate()
    model.shutdown()
    judge(table, told, course, full)
    table.row("connections closed while idle and reopened", closed_idle, "for information")
    judge_crowd(table, crowd_told, streams, uploads)
    judge_memory(table, memory, course.calm, full)
    table.row("peak resident memory, without and with a flood", f"{peak_calm:.0f} and {peak:.0f} MB", "for information")
    table.row("parses completed during the traffic", f"{done_calm} without a flood, {parses.done} in total", "some", done_calm > 0)
    table.row("uploads refused because stalled ones held all permits", parses.refused, "for information")
    table.row("uploads and parses that failed unexpectedly", len(parses.complaints), "0", not parses.complaints)
    for complaint in parses.complaints[:5]:
        table.note(complaint)
    numbers, examples = log_lines(folder / "log")
    table.row("errors in the log", sum(numbers.values()), "0", not numbers)
    for message, count in numbers.most_common(5):
        table.note(f"log, {count} times: {examples[message][:400]}")
    table.equal("exit code", code, 0)
    return table


def judge_memory(table, memory, calm, full):
    """Checks whether memory grows under constant traffic."""
    begin, end = calm
    window = WINDOW * (end - begin)
    first = memory.mean(begin + WARM * (end - begin), begin + WARM * (end - begin) + window)
    last = memory.mean(end - window, end)
    tenths = [memory.mean(begin + (end - begin) * at / 10, begin + (end - begin) * (at + 1) / 10) for at in range(10)]
    table.row("resident memory, by tenths of that time", " ".join(f"{mb:.0f}" for mb in tenths) + " MB", "for information")
    growth = last / first - 1
    table.row("resident memory, first window after warm-up, and last", f"{first:.0f} and {last:.0f} MB: {growth * 100:+.1f} %",
              "+5 % at most" if full else "for information", not full or growth <= 0.05)


def judge(table, told, course, full):
    """Checks statuses and latencies."""
    begin, end = course.calm
    numbers = collections.Counter((kind, status) for kind, _, _, status in told)
    in_calm = [one for one in told if begin <= one[1] < end]
    wrong_calm = collections.Counter((kind, status) for kind, _, _, status in in_calm if status == 0 or status >= 500)
    wrong = collections.Counter({key: count for key, count in numbers.items() if key[1] == 0 or key[1] >= 500})
    table.row("requests", f"{len(in_calm)} without a flood, {len(in_calm) / (end - begin):.0f} per second; {len(told)} in total")
    table.row("5xx and broken connections, without a flood", sum(wrong_calm.values()), "0", not wrong_calm)
    in_crowd = wrong - wrong_calm
    # Above its limits a server may answer 503, but nothing else.
    unfit = {key: count for key, count in in_crowd.items() if key[1] != 503}
    table.row("5xx and broken connections, with a flood", f"{sum(in_crowd.values())}, of them 503 {sum(in_crowd.values()) - sum(unfit.values())}",
              "503 only", not unfit)
    for key, count in (wrong_calm + in_crowd).most_common(6):
        table.note(f"{key[0]} got {key[1]} {count} times")
    others = {f"{kind} {status}": count for (kind, status), count in sorted(numbers.items()) if 400 <= status < 500}
    table.row("4xx", json.dumps(others), "for information")
    for kind in sorted({kind for kind, *_ in told}):
        took = within(told, [course.calm], kind)
        table.row(f"{kind}, without a flood", f"n {len(took)}, p50 {percentile_ms(took, 0.5):.1f}, p95 {percentile_ms(took, 0.95):.1f}, "
                  f"p99 {percentile_ms(took, 0.99):.1f} ms")
    ground, evidence = within(told, [course.calm], "ground"), within(told, [course.calm], "evidence")
    p99, p95 = percentile_ms(ground, 0.99), percentile_ms(evidence, 0.95)
    # A busy machine may take seconds. The short form only asserts that there is an answer.
    for what, figure, most in [("ground, p99", p99, 50 if full else 10_000), ("evidence pictures, p95", p95, 250 if full else 20_000)]:
        table.row(what, f"{figure:.1f} ms", f"{most} ms" + ("" if full else ", for busy machines"), figure < most)
    before, with_crowd = (percentile_ms(within(told, windows, "ground"), 0.99) for windows in (course.pauses, course.crowds))
    coming = percentile_ms(within(told, course.arrivals, "ground"), 0.99)
    change = with_crowd / before - 1
    table.row("ground p99, alternating: without, with a flood", f"{before:.1f}, {with_crowd:.1f} ms: {change * 100:+.0f} %",
              "+50 % at most" if full else "for information", not full or change < 0.5)
    table.row("ground p99 while a flood starts", f"{coming:.1f} ms", "for information")
    for kind in ("evidence", "healthz"):
        before, with_crowd = (percentile_ms(within(told, windows, kind), 0.95) for windows in (course.pauses, course.crowds))
        table.row(f"{kind} p95, alternating: without, with a flood", f"{before:.1f}, {with_crowd:.1f} ms", "for information")


def judge_crowd(table, crowd_told, streams, uploads):
    """Checks the statuses that the flood received."""
    for kind, number in (("streams", streams), ("uploads", uploads)):
        statuses = collections.Counter()
        for told in crowd_told:
            statuses.update(told[kind])
        strange = {status for status in statuses if status and status not in FLOOD_STATUSES}
        table.row(f"flood of {number} {kind}: statuses", json.dumps(dict(sorted(statuses.items()))), f"of {sorted(FLOOD_STATUSES)}", not strange)
    table.row("flood: connections open at its end", ", ".join(str(told["open at the end"]) for told in crowd_told), "for information")
