"""Client workloads for a server that is killed: upload, reparse, submit a batch, follow it, ask. Each continues with the next server where the
last one stopped.
"""
import json
import random
import re
import time

from wire import expect, request_bytes

# Non-default settings, so that there is something to parse.
OTHER_SETTINGS = {"settings": {"parsing": {"superpoints": {"voxel_m": 0.035}}}}
BUILTIN = {"reasoner": "builtin"}
IDS = re.compile(rb"[0-9a-f]{8}-[0-9a-f]{4}-[0-9a-f]{4}-[0-9a-f]{4}-[0-9a-f]{12}")


def follow_job(connection, job_id, pause_s=0.1):
    """Waits for a job's end and returns the job."""
    while True:
        job = expect(connection.call("GET", f"/v1/jobs/{job_id}"), 200)
        if job["state"] in ("succeeded", "failed", "cancelled"):
            return job
        time.sleep(pause_s)


def send_slowly(connection, data, seconds):
    """Sends a request in sixteen pieces, so that a kill interrupts it half received."""
    connection.open()
    step = len(data) // 16 + 1
    for at in range(0, len(data), step):
        connection.socket.sendall(data[at:at + step])
        time.sleep(seconds / 16)
    return connection.read_reply()


def upload(connection, scans, name, seconds=0.0):
    """Uploads a variant under its name and idempotency key."""
    data = request_bytes("POST", f"/v1/scenes?name={name}", scans.variant(name), "application/zip", [("idempotency-key", name)])
    return expect(send_slowly(connection, data, seconds) if seconds else connection.send(data), 202)


def instances(connection, scene):
    """Returns a scene's instances, byte for byte except for scene ids."""
    reply = connection.call("GET", f"/v1/scenes/{scene}/instances?limit=1000&level=all")
    expect(reply, 200)
    return IDS.sub(b"", reply.body)


class Uploader:
    """Uploads a variant, waits for its parse, reparses it with other settings, and repeats."""

    def __init__(self, scans, most, seed):
        self.scans, self.most, self.dice = scans, most, random.Random(seed)
        # Acknowledged scenes by name, and the names of scenes parsed with both settings.
        self.scenes, self.parsed_again = {}, []
        self.jobs, self.begun = set(), 0

    def live(self, server):
        connection = server.connection()
        while len(self.parsed_again) < self.most:
            name = f"variant-{len(self.parsed_again)}"
            self.begun = len(self.parsed_again) + 1
            created = upload(connection, self.scans, name, self.dice.uniform(0.0, 0.4))
            known = self.scenes.setdefault(name, created["scene"]["id"])
            if known != created["scene"]["id"]:
                raise AssertionError(f"{name} made the scene {known}, and then {created['scene']['id']}")
            self.jobs.add(created["job"]["id"])
            follow_job(connection, created["job"]["id"])
            again = expect(connection.call("POST", f"/v1/scenes/{known}/parse", OTHER_SETTINGS), 202)
            self.jobs.add(again["id"])
            follow_job(connection, again["id"])
            self.parsed_again.append(name)


class Batch:
    """Submits one batch under an idempotency key until it is accepted; then follows its results and reads each once."""

    def __init__(self, items):
        self.lines = "".join(json.dumps(item) + "\n" for item in items).encode()
        self.id, self.followed = None, []
        # Jobs that this script cancelled so that the batch restarts at once; how often the batch was paused for another reason.
        self.stopped, self.paused = set(), 0
        # How often its job waited for a retry, and why that was wrong, if it was.
        self.put_off, self.put_off_wrongly = 0, []

    def live(self, server):
        connection = server.connection()
        if self.id is None:
            data = request_bytes("POST", "/v1/batches?label=soak", self.lines, "application/jsonl", [("idempotency-key", "soak")])
            self.id = expect(send_slowly(connection, data, 0.3), 202)["id"]
        while True:
            for line in connection.stream(f"/v1/batches/{self.id}/results?follow=true&from={len(self.followed)}"):
                self.followed.append(line)
            batch = expect(connection.call("GET", f"/v1/batches/{self.id}"), 200)
            if batch["state"] in ("succeeded", "cancelled"):
                return
            if batch["state"] == "paused":
                self.paused += batch["job_id"] not in self.stopped
                expect(connection.call("POST", f"/v1/batches/{self.id}/resume"), 200)
            time.sleep(0.1)


class Asker:
    """Asks the built-in reasoner and remembers every answer."""

    def __init__(self, scenes, questions):
        self.scenes, self.questions, self.given = scenes, questions, {}
        # Answers that were returned with the note that they could not be stored.
        self.next, self.not_stored = 0, 0

    def live(self, server):
        connection = server.connection()
        while True:
            query, scene = self.questions[self.next % len(self.questions)], self.scenes[self.next % len(self.scenes)]
            self.next += 1
            reply = connection.call("POST", f"/v1/scenes/{scene}/ground", {"query": query, **BUILTIN})
            answer = expect(reply, 200)
            if answer["stored"]:
                self.given[answer["id"]] = reply.body
            else:
                self.not_stored += 1
            time.sleep(0.05)
