"""Reports which processes used the CPU during a measurement, so that figures of a busy machine are recognizable."""
import os
import time
from pathlib import Path

TICKS = os.sysconf("SC_CLK_TCK")


class Watch:
    """Watches CPU use from now on, for one server."""

    def __init__(self, server):
        self.server, self.began = server, time.time()
        self.before = self.look()

    def look(self):
        """Returns CPU seconds: of the whole machine, of the server, and of this process with its finished children."""
        fields = [int(word) for word in Path("/proc/stat").read_text().split("\n", 1)[0].split()[1:]]
        # Everything except idle and waiting for the disk; guests are counted among users.
        busy = sum(fields[:3] + fields[5:8]) / TICKS
        own = Path(f"/proc/{self.server.process.pid}/stat").read_text().rsplit(")", 1)[1].split()
        times = os.times()
        return busy, (int(own[11]) + int(own[12])) / TICKS, sum(times[:4])

    def row(self, table):
        """Adds a row with the average cores used since the start; the generator's processes must have ended."""
        span = time.time() - self.began
        busy, server, generator = ((now - before) / span for now, before in zip(self.look(), self.before))
        others = max(0.0, busy - server - generator)
        table.row("cores used: server, generator, others", f"{server:.2f}, {generator:.2f}, {others:.2f} of {os.cpu_count()}", "others 0")
        if others > 0.1 * os.cpu_count():
            table.note("Others were at work on this machine: times and ratios are theirs as well.")
