"""Clients that send mixed requests, each over its own persistent connection, in a process separate from the driver.

Each client pauses between two requests, as people and robots do: the measurement is the latency under this traffic, not the throughput of a machine.
One process drives 32 clients; its own overhead is measured against /healthz.
"""
import asyncio
import json
import multiprocessing
import random
import time

from wire import read_head, request_bytes

# Requests of a hundred.
MIX = {"ground": 50, "shortlist": 10, "scenes": 5, "batches": 3, "scene": 4, "instances": 6, "view": 5, "answer": 9, "evidence": 3,
       "events": 3, "healthz": 2}
THINK_S = 0.2
CLIENTS_PER_PROCESS = 32
# How long a client follows a job's events.
EVENTS_S = 2.0
PATIENCE_S = 60


class Client:
    """One client, whose requests depend only on its seed."""

    def __init__(self, address, scenes, questions, mix, think_s, seed):
        self.address, self.scenes, self.questions = address, scenes, questions
        self.kinds, self.weights, self.think_s = list(mix), list(mix.values()), think_s
        self.dice, self.answers, self.job = random.Random(seed), [], None
        self.reader = self.writer = None
        # Kind, start time, latency in seconds, status; 0 for a broken connection.
        self.told, self.closed_idle = [], 0

    def request(self, kind):
        """Returns path and body of a request of this kind."""
        scene = self.dice.choice(self.scenes)
        answer = self.answers[-1] if self.answers else None
        if kind == "ground" or answer is None and kind in ("answer", "evidence"):
            return "ground", f"/v1/scenes/{scene}/ground", {"query": self.dice.choice(self.questions), "reasoner": "builtin"}
        if kind == "shortlist":
            return kind, f"/v1/scenes/{scene}/shortlist", {"query": self.dice.choice(self.questions)}
        paths = {"scenes": "/v1/scenes?limit=5", "batches": "/v1/batches?limit=5", "scene": f"/v1/scenes/{scene}",
                 "instances": f"/v1/scenes/{scene}/instances?limit=50", "view": f"/v1/scenes/{scene}/instances/1/views/0.jpg",
                 "answer": f"/v1/answers/{answer}", "evidence": f"/v1/answers/{answer}/evidence/global.jpg", "healthz": "/healthz"}
        return kind, paths[kind], None

    async def connect(self):
        return await asyncio.open_connection(*self.address, limit=1 << 22)

    async def ask(self, data):
        """Returns status and body; uses a new connection if the old one was closed meanwhile."""
        for fresh in (False, True):
            if self.writer is None:
                self.reader, self.writer = await self.connect()
                fresh = True
            try:
                self.writer.write(data)
                head = await self.reader.readuntil(b"\r\n\r\n")
            except (OSError, asyncio.IncompleteReadError) as error:
                self.writer.close()
                self.writer = None
                if fresh or getattr(error, "partial", b""):
                    raise
                self.closed_idle += 1
                continue
            status, headers = read_head(head[:-4])
            body = await self.reader.readexactly(int(headers.get("content-length", 0)))
            if headers.get("connection") == "close":
                self.writer.close()
                self.writer = None
            return status, body
        raise ConnectionError("closed twice")

    async def events(self):
        """Follows the newest job for a while and returns the time to its first event."""
        reader, writer = await self.connect()
        try:
            start = time.time()
            writer.write(request_bytes("GET", f"/v1/jobs/{self.job}/events"))
            status, _ = read_head((await reader.readuntil(b"\r\n\r\n"))[:-4])
            if status == 200:
                await reader.readuntil(b"\n\n")
            took = time.time() - start
            try:
                while status == 200 and await asyncio.wait_for(reader.read(1 << 16), max(0.01, start + EVENTS_S - time.time())):
                    pass
            except asyncio.TimeoutError:
                pass
            return start, took, status
        finally:
            writer.close()

    async def live(self, until):
        await asyncio.sleep(self.dice.random() * self.think_s)
        while (start := time.time()) < until:
            kind = self.dice.choices(self.kinds, self.weights)[0]
            try:
                if kind == "events" and self.job:
                    start, took, status = await asyncio.wait_for(self.events(), PATIENCE_S)
                else:
                    kind, path, body = self.request("scenes" if kind == "events" else kind)
                    data = request_bytes("POST" if body else "GET", path, json.dumps(body).encode() if body else b"")
                    start = time.time()
                    status, reply = await asyncio.wait_for(self.ask(data), PATIENCE_S)
                    took = time.time() - start
                    if kind == "ground" and status == 200:
                        self.answers = [json.loads(reply)["id"]]
                    elif kind == "scenes" and status == 200:
                        self.job = json.loads(reply)["scenes"][0]["job_id"]
            except (OSError, EOFError, asyncio.TimeoutError):
                took, status, self.writer = time.time() - start, 0, None
            self.told.append((kind, start, took, status))
            await asyncio.sleep(self.dice.expovariate(1 / self.think_s) if self.think_s else 0)


def one_process(pipe, clients, until):
    async def everybody():
        await asyncio.gather(*[client.live(until) for client in clients])
    asyncio.run(everybody())
    pipe.send(([told for client in clients for told in client.told], sum(client.closed_idle for client in clients)))


class Load:
    """Runs this many clients until a time."""

    def __init__(self, address, scenes, questions, clients, until, mix=None, think_s=THINK_S, seed=0):
        self.parts, context = [], multiprocessing.get_context("fork")
        everybody = [Client(address, scenes, questions, mix or MIX, think_s, seed + i) for i in range(clients)]
        for at in range(0, clients, CLIENTS_PER_PROCESS):
            here, there = context.Pipe(duplex=False)
            process = context.Process(target=one_process, args=(there, everybody[at:at + CLIENTS_PER_PROCESS], until), daemon=True)
            process.start()
            there.close()
            self.parts.append((process, here))

    def told(self):
        """Waits for the end and returns every request, and how often a connection was closed while idle."""
        told, closed = [], 0
        for process, pipe in self.parts:
            part, idle = pipe.recv()
            process.join()
            told, closed = told + part, closed + idle
        return told, closed


def percentile_ms(seconds, share):
    """Returns a percentile in milliseconds; NaN without values."""
    ordered = sorted(seconds)
    return ordered[min(len(ordered) - 1, int(len(ordered) * share))] * 1e3 if ordered else float("nan")
