"""A long list of questions as one batch, compared with a loop that asks them one by one; and the submission of a very long list."""
import json
import multiprocessing
import statistics
import time

from machine import Watch
from questions import questions
from scans import Scans
from server import Server, log_lines
from table import Table
from wire import Connection, expect, request_bytes
from workload import follow_job, upload

WORKERS = 4


def ask_all(address, requests, pipe):
    """One worker of the loop: sends its prepared requests one after another over one connection."""
    connection, wrong = Connection(address), 0
    pipe.recv()
    for request in requests:
        wrong += connection.send(request).status != 200
    pipe.send(wrong)


def bare_loop(address, requests):
    """Returns the seconds that the workers take together, and the number of missing answers. The processes start before the clock runs."""
    context, pipes, processes = multiprocessing.get_context("fork"), [], []
    for worker in range(WORKERS):
        here, there = context.Pipe()
        process = context.Process(target=ask_all, args=(address, requests[worker::WORKERS], there), daemon=True)
        process.start()
        pipes.append(here)
        processes.append(process)
    time.sleep(0.2)
    start = time.time()
    for pipe in pipes:
        pipe.send("go")
    wrong = sum(pipe.recv() for pipe in pipes)
    took = time.time() - start
    for process in processes:
        process.join()
    return took, wrong


def one_batch(connection, lines):
    """Returns the seconds from the first submitted byte to the last result read, and the number of results without an answer."""
    start = time.time()
    batch = expect(connection.call("POST", "/v1/batches", lines, "application/jsonl"), 202)
    wrong, seen = 0, 0
    for line in Connection(connection.address, 600).stream(f"/v1/batches/{batch['id']}/results?follow=true"):
        # Results are not decoded, as in the loop.
        seen += 1
        wrong += b'"answer":null' in line
    return time.time() - start, wrong + abs(seen - lines.count(b"\n"))


def run(program, folder, full):
    """Runs everything and returns the table."""
    number, rounds, many = (5000, 5, 100_000) if full else (400, 2, 10_000)
    table = Table(f"batch: {number} questions over three scenes, {rounds} rounds in alternation; {many} submitted")
    with Server(program, folder / "data", folder / "log") as server:
        connection = server.ready().connection(600)
        scans, scenes = Scans(None if full else 6), []
        for at in range(3):
            created = upload(connection, scans, f"base-{at}")
            if (job := follow_job(connection, created["job"]["id"]))["state"] != "succeeded":
                raise AssertionError(f"the sample scan could not be parsed: {job}")
            scenes.append(created["scene"]["id"])
        asked = questions(number, 2)
        requests = [request_bytes("POST", f"/v1/scenes/{scenes[i % 3]}/ground", json.dumps({"query": query}).encode())
                    for i, query in enumerate(asked)]
        lines = "".join(json.dumps({"scene_id": scenes[i % 3], "query": query}) + "\n" for i, query in enumerate(asked)).encode()
        nothing, _ = bare_loop(server.address, [request_bytes("GET", "/healthz")] * number)
        table.row("generator: the loop over /healthz", f"{nothing / number * 1e6:.0f} us per request", "for information")
        # Warm-up: caches fill, and each way runs once before it counts.
        bare_loop(server.address, requests[:300])
        one_batch(connection, b"".join(lines.splitlines(keepends=True)[:300]))
        loops, batches, wrong, watch = [], [], 0, Watch(server)
        for _ in range(rounds):
            took, none = bare_loop(server.address, requests)
            loops.append(took)
            wrong += none
            took, none = one_batch(connection, lines)
            batches.append(took)
            wrong += none
        watch.row(table)
        loop, whole = statistics.median(loops), statistics.median(batches)
        listed = lambda figures: ", ".join(f"{figure:.2f}" for figure in figures)
        table.row(f"loop, {WORKERS} workers", f"{listed(loops)} s; median {number / loop:.0f} per second")
        table.row("batch, submitted and read", f"{listed(batches)} s; median {number / whole:.0f} per second")
        # Each round is compared by itself, because load on the machine affects both halves of a round alike.
        ratios = [batch / loop for batch, loop in zip(batches, loops)]
        ratio = statistics.median(ratios)
        table.row("batch over loop, round by round", f"{listed(ratios)}; median {ratio:.2f}", "1.3 at most" if full else "for information",
                  not full or ratio <= 1.3)
        table.row("best batch over best loop", f"{min(batches) / min(loops):.2f}", "for information")
        table.equal("questions without an answer", wrong, 0)
        submit(table, server, connection, scenes, many, full)
        code = server.terminate()
    numbers, examples = log_lines(folder / "log", ("WARN", "ERROR"))
    table.row("warnings and errors in the log", sum(numbers.values()), "0", not numbers)
    for message, count in numbers.most_common(5):
        table.note(f"log, {count} times: {examples[message][:400]}")
    table.equal("exit code", code, 0)
    return table


def submit(table, server, connection, scenes, many, full):
    """Submits a very long list: time until it is accepted, and memory."""
    asked = questions(5000, 3)
    lines = "".join(json.dumps({"scene_id": scenes[i % 3], "query": asked[i % len(asked)]}) + "\n" for i in range(many)).encode()
    server.forget_peak()
    before, start = server.resident_mb(), time.time()
    batch = expect(connection.call("POST", "/v1/batches", lines, "application/jsonl"), 202)
    took = time.time() - start
    grown = server.peak_mb() - before
    table.row(f"{many} items submitted, {len(lines) / 1e6:.0f} MB", f"{took:.2f} s", "10 s" if full else "120 s, for busy machines",
              took < (10 if full else 120))
    table.row("peak memory increase", f"{grown:.1f} MB", "100 MB", grown < 100)
    # Running the batch must not load the list into memory either.
    time.sleep(5 if full else 1)
    grown = server.peak_mb() - before
    table.row("the same, after running for a while", f"{grown:.1f} MB", "100 MB", grown < 100)
    state = expect(connection.call("POST", f"/v1/batches/{batch['id']}/cancel"), 200)
    table.row("the stored batch", f"{state['items']} items, {state['done']} asked, {state['state']}", f"{many} items, cancelled",
              (state["items"], state["state"]) == (many, "cancelled"))
