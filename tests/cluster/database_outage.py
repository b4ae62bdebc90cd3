#!/usr/bin/env python3
"""An outage of the database under a running server: clear 503s, no data lost, automatic recovery.

usage: database_outage.py --program PROGRAM --database postgres://… --stop COMMAND --start COMMAND
(COMMANDs stop and start the database server; scripts/test-postgres.sh sets them.)
"""
import argparse
import json
import pathlib
import shlex
import subprocess
import sys
import tempfile
import threading
import time
import urllib.error
import urllib.request

ROOT = pathlib.Path(__file__).resolve().parents[2]
SCAN = ROOT / "examples" / "living_room.zip"
QUESTIONS = ["the red sofa", "the mug on the coffee table", "the lamp closest to the window"]
ITEMS = 3000
AWAY_S = 8


class Server:
    """A server on a data folder, with further arguments."""

    def __init__(self, program, folder, *arguments, environment=None):
        command = [program, "serve", "--listen", "127.0.0.1:0", "--data-dir", str(folder), "--masks", "builtin", "--encoder", "builtin", *arguments]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, env=environment)
        self.url = self.process.stdout.readline().split()[-1]

    def call(self, method, path, body=None, media_type="application/json"):
        """Returns status, headers and JSON of a call."""
        data = body if isinstance(body, (bytes, type(None))) else json.dumps(body).encode()
        request = urllib.request.Request(self.url + path, data, {"content-type": media_type}, method=method)
        try:
            with urllib.request.urlopen(request, timeout=60) as reply:
                return reply.status, reply.headers, json.loads(reply.read() or b"null")
        except urllib.error.HTTPError as error:
            return error.code, error.headers, json.loads(error.read() or b"null")

    def ready(self):
        return self.call("GET", "/readyz")[0] == 200

    def stop(self):
        self.process.terminate()
        return self.process.wait(60)


def until(what, true, seconds=60):
    """Waits until a condition holds."""
    end = time.monotonic() + seconds
    while not true():
        if time.monotonic() > end:
            sys.exit(f"FAILED: {what}: not reached within {seconds} s")
        time.sleep(0.1)


def check(what, holds):
    print(f"{'passed' if holds else 'FAILED'}: {what}", flush=True)
    if not holds:
        sys.exit(1)


def comparable_answer(answer):
    """Returns an answer without the fields that differ between two answers."""
    return json.dumps({key: answer[key] for key in ("status", "answer", "box", "confidence")}, sort_keys=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    for name in ("program", "database", "stop", "start"):
        parser.add_argument(f"--{name}", required=True)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        server = Server(args.program, pathlib.Path(folder) / "data", "--database", args.database)
        try:
            outage(server, args)
        finally:
            server.stop()


def outage(server, args):
    made = server.call("POST", "/v1/scenes", SCAN.read_bytes(), "application/zip")[2]
    scene = made["scene"]["id"]
    until("the parse", lambda: server.call("GET", f"/v1/scenes/{scene}")[2]["status"] == "ready")
    ask = lambda query: server.call("POST", f"/v1/scenes/{scene}/ground", {"query": query})
    before = [ask(query)[2] for query in QUESTIONS]
    items = [{"scene_id": scene, "query": QUESTIONS[i % len(QUESTIONS)]} for i in range(ITEMS)]
    batch = server.call("POST", "/v1/batches", {"items": items})[2]["id"]
    until("the batch's first answers", lambda: server.call("GET", f"/v1/batches/{batch}")[2]["done"] > 0)

    subprocess.run(shlex.split(args.stop), check=True, stdout=subprocess.DEVNULL)
    gone = time.monotonic()
    statuses = []
    until("a 503", lambda: statuses.append(server.call("GET", f"/v1/scenes/{scene}")) or statuses[-1][0] == 503, 20)
    status, headers, problem = statuses[-1]
    check(f"a call without its database is a {status} with a code ({problem['code']}) and Retry-After",
          status == 503 and headers["retry-after"] is not None and headers["content-type"] == "application/problem+json")
    check("no call is told 500", all(status < 500 or status == 503 for status, _, _ in statuses))
    check("/readyz says no, /healthz does not mind", not server.ready() and server.call("GET", "/healthz")[0] == 200)
    time.sleep(max(0.0, AWAY_S - (time.monotonic() - gone)))
    subprocess.run(shlex.split(args.start), check=True, stdout=subprocess.DEVNULL)
    back = time.monotonic()
    until("/readyz", server.ready)
    print(f"ready {time.monotonic() - back:.1f} s after the database was back", flush=True)

    kept = [server.call("GET", f"/v1/answers/{answer['id']}")[2] for answer in before]
    check("answers given before are kept as they were", kept == before)
    check("the same questions get the same answers", [comparable_answer(ask(query)[2]) for query in QUESTIONS] == list(map(comparable_answer, before)))
    state = lambda: server.call("GET", f"/v1/batches/{batch}")[2]
    until("the batch's end", lambda: state()["state"] == "succeeded", 300)
    end = state()
    check(f"each of {ITEMS} items of the batch under way is answered once: {json.dumps(end['by_status'])}", end["done"] == ITEMS and "failed" not in end["by_status"])
    lines = urllib.request.urlopen(f"{server.url}/v1/batches/{batch}/results?format=jsonl", timeout=60).read().splitlines()
    ids = {json.loads(line)["answer"]["id"] for line in lines}
    check("and each has an answer of its own", len(lines) == len(ids) == ITEMS)
    with tempfile.TemporaryDirectory() as other:
        command = [args.program, "serve", "--listen", "127.0.0.1:0", "--data-dir", other, "--database", args.database]
        second = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    check("a server with another folder is kept out", second.returncode != 0 and "do not belong together" in second.stderr)


if __name__ == "__main__":
    main()
