"""A flood that costs its sender nothing: event streams that nobody reads, silent connections, stalled uploads. Runs in its own process."""
import asyncio
import collections
import multiprocessing
import random

from wire import read_head, request_bytes

UPLOAD = (b"POST /v1/scenes HTTP/1.1\r\nhost: localhost\r\ncontent-type: application/zip\r\ncontent-length: 1000000\r\n\r\nPK")


class Flood:
    """Opens `streams` connections that request a job's events and stay open, and `uploads` that stop after two bytes. Closed connections are
    opened again."""

    def __init__(self, address, job, streams, uploads):
        self.over = multiprocessing.get_context("fork").Event()
        self.mine, theirs = multiprocessing.Pipe(duplex=False)
        self.process = multiprocessing.get_context("fork").Process(
            target=stand, args=(address, job, streams, uploads, self.over, theirs), daemon=True)
        self.process.start()
        theirs.close()

    def leave(self):
        """Ends the flood and returns how often each status was received; 0 stands for a failed connection."""
        self.over.set()
        told = self.mine.recv()
        self.process.join()
        return told


def stand(address, job, streams, uploads, over, pipe):
    told = {"streams": collections.Counter(), "uploads": collections.Counter(), "open": 0}
    events = request_bytes("GET", f"/v1/jobs/{job}/events")

    async def one(kind, data, seed):
        dice = random.Random(seed)
        # All connections open within two seconds.
        await asyncio.sleep(dice.random() * 2)
        while True:
            writer = None
            try:
                reader, writer = await asyncio.open_connection(*address)
                told["open"] += 1
                writer.write(data)
                status, _ = read_head((await reader.readuntil(b"\r\n\r\n"))[:-4])
                told[kind][status] += 1
                while await reader.read(1 << 16):
                    pass
            except (OSError, asyncio.IncompleteReadError):
                told[kind][0] += 1
            finally:
                if writer:
                    told["open"] -= 1
                    writer.close()
            # A connection closed as idle is reopened at once; a refused one waits a while.
            await asyncio.sleep(dice.uniform(0.1, 1) if kind == "streams" else dice.uniform(5, 10))

    async def everybody():
        kinds = [("streams", events)] * streams + [("uploads", UPLOAD)] * uploads
        tasks = [asyncio.create_task(one(*kind, seed)) for seed, kind in enumerate(kinds)]
        while not over.is_set():
            await asyncio.sleep(0.2)
        told["open at the end"] = told["open"]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
    asyncio.run(everybody())
    pipe.send({kind: dict(count) if isinstance(count, collections.Counter) else count for kind, count in told.items()})
