"""The processes of a cluster: started, killed, frozen past their leases, continued, with their current addresses."""
import signal
import threading
import time
from dataclasses import dataclass

from server import Server

APIS, WORKERS = 2, 3


@dataclass
class Disturbance:
    """A process that was killed or frozen, and until when."""
    # `worker-2.0` is the first life of worker 2.
    who: str
    how: str
    at: float
    until: float


class Member:
    """A slot in the fleet, and its current process."""

    def __init__(self, fleet, name, command, flags):
        self.fleet, self.name, self.command, self.flags = fleet, name, command, flags
        self.life, self.server, self.is_stopped = -1, None, False

    @property
    def who(self):
        return f"{self.name}.{self.life}"

    def start(self):
        self.life += 1
        fleet = self.fleet
        # At the previous address, which proxies and callers know.
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
    """APIs and workers over one database and one file store."""

    def __init__(self, program, folder, database, model, lease_s, blobs=None):
        self.program, self.folder, self.database, self.model, self.lease_s = program, folder, database, model, lease_s
        self.has_store, self.blobs = blobs is not None, ["--blobs", blobs] if blobs else []
        self.members, self.disturbances, self.lock = [], [], threading.Lock()

    def data(self, name):
        """Returns the data folder: one for all processes, or one for each if there is an object store."""
        return self.folder / ("data-" + name if self.has_store else "data")

    def add(self, apis=APIS, workers=WORKERS):
        """Adds this many running APIs and workers."""
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
        """Returns the addresses of the APIs, including frozen ones, which callers cannot recognize."""
        return [member.server.address for member in self.of("api") if member.server.process.poll() is None and member.server.address]

    def disturb(self, member, how, pause_s):
        """Kills a process and starts another in its slot, or freezes it for a while."""
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
        """Sends SIGTERM to all and returns their exit codes."""
        for member in self.members:
            member.server.process.send_signal(signal.SIGTERM)
        return {member.who: member.server.terminate() for member in self.members}

    def __enter__(self):
        return self

    def __exit__(self, *_):
        for member in self.members:
            if member.server.process.poll() is None:
                # Frozen processes too.
                member.server.kill()
