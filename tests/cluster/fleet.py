"""The processes of a cluster: started, killed, stopped past their leases, continued, and looked up where they listen now."""
import signal
import threading
import time
from dataclasses import dataclass

from server import Server

APIS, WORKERS = 2, 3


@dataclass
class Disturbance:
    """A process that was killed, or stood still, and until when."""
    # `worker-2.0` is the first life of worker 2.
    who: str
    how: str
    at: float
    until: float


class Member:
    """A place in the fleet, and the process that has it now."""

    def __init__(self, fleet, name, command, flags):
        self.fleet, self.name, self.command, self.flags = fleet, name, command, flags
        self.life, self.server, self.is_stopped = -1, None, False

    @property
    def who(self):
        return f"{self.name}.{self.life}"

    def start(self):
        self.life += 1
        fleet = self.fleet
        # Where the one before listened: proxies and callers know it there.
        listen = "127.0.0.1:0" if self.server is None else "{}:{}".format(*self.server.address)
        self.server = Server(fleet.program, fleet.data(self.name), fleet.folder / f"{self.name}.log", "--database", fleet.database,
                             "--lease-s", fleet.lease_s, *fleet.blobs, *self.flags, *fleet.model.flags_of(f"{self.who}/v1"), command=self.command, listen=listen)
        self.server.ready()

    def kill(self):
        self.server.kill()

    def stop(self):
        self.is_stopped = True
        self.server.process.send_signal(signal.SIGSTOP)

    def go_on(self):
        self.server.process.send_signal(signal.SIGCONT)
        self.is_stopped = False

    def is_there(self):
        return self.server is not None and self.server.process.poll() is None and not self.is_stopped


class Fleet:
    """APIs and workers over one database and one store of files."""

    def __init__(self, program, folder, database, model, lease_s, blobs=None):
        self.program, self.folder, self.database, self.model, self.lease_s = program, folder, database, model, lease_s
        self.has_store, self.blobs = blobs is not None, ["--blobs", blobs] if blobs else []
        self.members, self.disturbances, self.lock = [], [], threading.Lock()

    def data(self, name):
        """One folder for all; where there is a store of files, one for each."""
        return self.folder / ("data-" + name if self.has_store else "data")

    def add(self, apis=APIS, workers=WORKERS):
        """So many more of each, at work."""
        for kind, number, command, flags in (("api", apis, "serve", ["--role", "api"]),
                                             ("worker", workers, "worker", ["--kinds", "parse,naming,batch", "--concurrency", 1])):
            for _ in range(number):
                at = 1 + sum(member.name.startswith(kind) for member in self.members)
                member = Member(self, f"{kind}-{at}", command, flags)
                member.start()
                self.members.append(member)
        return self

    def of(self, kind):
        return [member for member in self.members if member.name.startswith(kind)]

    def addresses(self):
        """Where the APIs listen, those that stand still included: a caller can not know."""
        return [member.server.address for member in self.of("api") if member.server.process.poll() is None and member.server.address]

    def disturb(self, member, how, pause_s):
        """Kills a process, and starts another in its place; or has it stand still for a while."""
        at = time.time()
        if how == "killed":
            member.kill()
            who = member.who
            time.sleep(pause_s)
            member.start()
        else:
            member.stop()
            who = member.who
            time.sleep(pause_s)
            member.go_on()
        with self.lock:
            self.disturbances.append(Disturbance(who, how, at, time.time()))

    def end(self):
        """SIGTERM to all; their exit codes."""
        for member in self.members:
            member.server.process.send_signal(signal.SIGTERM)
        return {member.who: member.server.terminate() for member in self.members}

    def __enter__(self):
        return self

    def __exit__(self, *_):
        for member in self.members:
            if member.server.process.poll() is None:
                # Also one that stands still.
                member.server.kill()
