"""A long list as one batch beside the bare loop that asks the same questions one by one, and a very long list submitted."""
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
from work import follow_job, upload

WORKERS = 4


def ask_all(address, requests, pipe):
    """One worker of the bare loop: its requests, made up beforehand, one after the other over one connection."""
    connection, wrong = Connection(address), 0
    pipe.recv()
    for request in requests:
        wrong += connection.send(request).status != 200
    pipe.send(wrong)


def bare_loop(address, requests):
    """Seconds that the workers take together; how many answers were none. Processes are up before the clock runs."""
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
    """Seconds from the first byte submitted to the last result read; how many results had no answer."""
    start = time.time()
    batch = expect(connection.call("POST", "/v1/batches", lines, "application/jsonl"), 202)
    wrong, seen = 0, 0
    for line in Connection(connection.address, 600).stream(f"/v1/batches/{batch['id']}/results?follow=true"):
        # What is read is not decoded: the loop does not do that either.
        seen += 1
        wrong += b'"answer":null' in line
    return time.time() - start, wrong + abs(seen - lines.count(b"\n"))


def run(program, folder, full):
    """The table of it all."""
    number, rounds, many = (5000, 5, 100_000) if full else (400, 2, 10_000)
    table = Table(f"batch: {number} questions over three scenes, {rounds} rounds in alternation; {many} submitted")
    with Server(program, folder / "data", folder / "log") as server:
        connection = server.ready().connection(600)
        scans, scenes = Scans(None if full else 6), []
        for at in range(3):
            created = upload(connection, scans, f"base-{at}")
            if (job := follow_job(connection, created["job"]["id"]))["state"] != "succeeded":
                raise AssertionError(f"the sample scan can not be parsed: {job}")
            scenes.append(created["scene"]["id"])
        asked = questions(number, 2)
        requests = [request_bytes("POST", f"/v1/scenes/{scenes[i % 3]}/ground", json.dumps({"query": query}).encode())
                    for i, query in enumerate(asked)]
        lines = "".join(json.dumps({"scene_id": scenes[i % 3], "query": query}) + "\n" for i, query in enumerate(asked)).encode()
        nothing, _ = bare_loop(server.address, [request_bytes("GET", "/healthz")] * number)
        table.row("generator: the bare loop over /healthz", f"{nothing / number * 1e6:.0f} us a request", "told only")
        # Caches fill, and each way is tried once before it counts.
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
        table.row(f"bare loop, {WORKERS} workers", f"{listed(loops)} s; median {number / loop:.0f} a second")
        table.row("batch, submitted and read", f"{listed(batches)} s; median {number / whole:.0f} a second")
        # Each round by itself: what the machine does beside it weighs on both halves of a round alike.
        ratios = [batch / loop for batch, loop in zip(batches, loops)]
        ratio = statistics.median(ratios)
        table.row("batch over loop, round by round", f"{listed(ratios)}; median {ratio:.2f}", "1.3 at most" if full else "told only",
                  not full or ratio <= 1.3)
        table.row("best batch over best loop", f"{min(batches) / min(loops):.2f}", "told only")
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
    """A very long list: how long it takes to be taken, and how much memory."""
    asked = questions(5000, 3)
    lines = "".join(json.dumps({"scene_id": scenes[i % 3], "query": asked[i % len(asked)]}) + "\n" for i in range(many)).encode()
    server.forget_peak()
    before, start = server.resident_mb(), time.time()
    batch = expect(connection.call("POST", "/v1/batches", lines, "application/jsonl"), 202)
    took = time.time() - start
    grown = server.peak_mb() - before
    table.row(f"{many} items submitted, {len(lines) / 1e6:.0f} MB", f"{took:.2f} s", "10 s" if full else "120 s, for busy machines",
              took < (10 if full else 120))
    table.row("memory at most, above what it was", f"{grown:.1f} MB", "100 MB", grown < 100)
    # While it is asked, the list must not come into memory either.
    time.sleep(5 if full else 1)
    grown = server.peak_mb() - before
    table.row("the same, after it was asked a while", f"{grown:.1f} MB", "100 MB", grown < 100)
    state = expect(connection.call("POST", f"/v1/batches/{batch['id']}/cancel"), 200)
    table.row("the list, as the server has it", f"{state['items']} items, {state['done']} asked, {state['state']}", f"{many} items, cancelled",
              (state["items"], state["state"]) == (many, "cancelled"))
