"""Clients of a cluster whose processes are killed: each asks another API when one does not answer, with the same idempotency key."""
import json
import random
import threading
import time

from wire import Connection, expect, request_bytes

# How long to wait for an API before asking another.
PATIENCE_S = 5.0
# Statuses after which a request may be repeated.
AGAIN = (409, 429, 503)


class Caller:
    """Asks one API after another until there is an answer. `strange` collects unexpected responses."""

    def __init__(self, fleet, seed=0, until_s=600):
        self.fleet, self.dice, self.until_s, self.strange = fleet, random.Random(seed), until_s, []

    def call(self, method, path, body=None, media_type="application/json", key=None):
        """Returns the reply. Repeats after 409, 429, 503 and broken connections, so a request that creates something needs an idempotency key."""
        data = b"" if body is None else body if isinstance(body, bytes) else json.dumps(body).encode()
        request = request_bytes(method, path, data, media_type, [("idempotency-key", key)] if key else [])
        end, why = time.time() + self.until_s, "no API is there"
        while time.time() < end:
            addresses = self.fleet.addresses()
            self.dice.shuffle(addresses)
            for address in addresses:
                connection = Connection(address, PATIENCE_S)
                try:
                    reply = connection.send(request)
                except OSError as error:
                    why = f"{type(error).__name__}: {error}"
                    continue
                finally:
                    connection.close()
                if reply.status not in AGAIN:
                    if reply.status >= 500:
                        self.strange.append(f"{method} {path}: {reply.status} {reply.body[:200]!r}")
                    return reply
                why = f"{reply.status} {reply.body[:200]!r}"
            time.sleep(0.1)
        raise AssertionError(f"{method} {path} had no answer within {self.until_s} s: {why}")

    def json(self, method, path, *statuses, **rest):
        return expect(self.call(method, path, **rest), *statuses)

    def upload(self, scans, name):
        return self.json("POST", f"/v1/scenes?name={name}", 202, body=scans.variant(name), media_type="application/zip", key=name)

    def finished(self, job):
        """Waits for a job's end and returns the job."""
        end = time.time() + self.until_s
        while time.time() < end:
            found = self.json("GET", f"/v1/jobs/{job}", 200)
            if found["state"] in ("succeeded", "failed", "cancelled"):
                return found
            time.sleep(0.3)
        raise AssertionError(f"the job {job} is not over after {self.until_s} s: {found}")


    def batch(self, items, key, told=lambda batch: None):
        """Submits a batch and waits for its end; passes its id to `told` as soon as it is known."""
        lines = "".join(json.dumps(item) + "\n" for item in items).encode()
        batch = self.json("POST", f"/v1/batches?label={key}", 202, body=lines, media_type="application/jsonl", key=key)["id"]
        told(batch)
        end = time.time() + self.until_s
        while time.time() < end:
            state = self.json("GET", f"/v1/batches/{batch}", 200)
            if state["state"] == "paused":
                raise AssertionError(f"the batch was paused: {state}")
            if state["state"] in ("succeeded", "cancelled"):
                return batch
            time.sleep(0.3)
        raise AssertionError(f"the batch is not over after {self.until_s} s: {state}")


class Clients:
    """All clients at once: uploads, batches, single questions. Remembers what was acknowledged."""

    def __init__(self, fleet, scans, scenes, batches, single, parses, until_s):
        self.fleet, self.scans, self.scenes, self.items, self.single, self.parses, self.until_s = fleet, scans, scenes, batches, single, parses, until_s
        # Jobs by scene, batches by number, and answers by id: with their question, key and bytes.
        self.uploads, self.batches, self.given, self.complaints = {}, {}, {}, []
        self.stop, self.callers = threading.Event(), []
        work = [(self.send, part) for part in range(2)] + [(self.submit, number) for number in range(len(batches))] + [(self.ask, 0)]
        self.threads = [threading.Thread(target=self.live, args=one, daemon=True) for one in work]
        for thread in self.threads:
            thread.start()

    def caller(self, seed):
        caller = Caller(self.fleet, seed, self.until_s)
        self.callers.append(caller)
        return caller

    def live(self, work, number):
        try:
            work(number)
        except Exception as error:  # pylint: disable=broad-except
            self.complaints.append(f"{work.__name__} {number}: {type(error).__name__}: {error}")

    def send(self, part):
        """Uploads every second scan, faster than they are parsed."""
        caller = self.caller(100 + part)
        for at in range(part, self.parses, 2):
            created = caller.upload(self.scans, f"room-{at}")
            self.uploads[created["scene"]["id"]] = created["job"]["id"]
            time.sleep(0.2)

    def submit(self, number):
        """Submits a batch and waits for its end."""
        self.caller(200 + number).batch(self.items[number], f"batch-{number}", lambda batch: self.batches.update({number: batch}))

    def ask(self, _):
        """Asks single questions, each under an idempotency key."""
        caller = self.caller(300)
        for at, query in enumerate(self.single):
            if self.stop.is_set():
                return
            path, body = f"/v1/scenes/{self.scenes[at % len(self.scenes)]}/ground", {"query": query, "reasoner": "builtin"}
            reply = caller.call("POST", path, body=body, key=f"single-{at}")
            answer = expect(reply, 200)
            if answer["stored"]:
                self.given[answer["id"]] = (path, body, f"single-{at}", reply.body)
            time.sleep(0.05)

    def is_over(self):
        """Returns whether all started work is done; single questions continue until then."""
        return not any(thread.is_alive() for thread in self.threads[:-1])

    def end(self):
        """Waits for all clients and all parses."""
        for thread in self.threads[:-1]:
            thread.join(self.until_s)
        self.stop.set()
        self.threads[-1].join(self.until_s)
        self.complaints += [f"{thread.name} is not over" for thread in self.threads if thread.is_alive()]
        self.complaints += [strange for caller in self.callers for strange in caller.strange]
        caller = Caller(self.fleet, 400, self.until_s)
        for job in self.uploads.values():
            try:
                found = caller.finished(job)
                if found["state"] != "succeeded":
                    self.complaints.append(f"a parse came to {found}")
            except AssertionError as error:
                self.complaints.append(str(error))
                return
