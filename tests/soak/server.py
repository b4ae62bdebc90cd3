"""The program under test as a process: started, observed from outside, killed."""
import collections
import json
import os
import signal
import subprocess
from pathlib import Path

from wire import Connection


class Server:
    """`uniground serve`, or another listening command, on a data folder, with its log next to it. It may not listen yet: `ready` waits for that."""

    def __init__(self, program, data, log, *flags, command="serve", listen="127.0.0.1:0"):
        environment = {name: value for name, value in os.environ.items() if not name.startswith("UNIGROUND_")}
        # Ignores models in ./models, because these measurements need none.
        environment |= {"UNIGROUND_MASKS": "builtin", "UNIGROUND_ENCODER": "builtin"}
        words = [program, command, "--listen", listen, "--data-dir", data, "--log-format", "json", *flags]
        with open(log, "ab") as log_file:
            self.process = subprocess.Popen([str(word) for word in words], stdout=subprocess.PIPE, stderr=log_file, env=environment)
        self.address = None

    def ready(self):
        """Waits until the server listens."""
        line = self.process.stdout.readline().decode()
        if "listening on" not in line:
            raise RuntimeError(f"the server did not start: {line!r}, exit code {self.process.wait()}")
        host, port = line.split("http://")[1].strip().rsplit(":", 1)
        self.address = (host, int(port))
        return self

    def connection(self, timeout_s=60.0):
        return Connection(self.address, timeout_s)

    def kill(self):
        """Sends SIGKILL: the process cannot clean up."""
        self.process.kill()
        self.process.wait()
        self.process.stdout.close()

    def terminate(self, within_s=60):
        """Sends SIGTERM and returns the exit code."""
        self.process.send_signal(signal.SIGTERM)
        try:
            return self.process.wait(within_s)
        finally:
            self.kill()

    def status_mb(self, field):
        """Returns a memory figure of the process from the kernel, in megabytes."""
        for line in Path(f"/proc/{self.process.pid}/status").read_text().splitlines():
            if line.startswith(field + ":"):
                return int(line.split()[1]) / 1024
        return 0.0

    def resident_mb(self):
        return self.status_mb("VmRSS")

    def peak_mb(self):
        """Returns the peak resident memory since the last reset."""
        return self.status_mb("VmHWM")

    def forget_peak(self):
        Path(f"/proc/{self.process.pid}/clear_refs").write_text("5")

    def __enter__(self):
        return self

    def __exit__(self, *_):
        # No run leaves a server running, however it ends.
        if self.process.poll() is None:
            self.kill()


def log_lines(log, levels=("ERROR",)):
    """Counts the log lines of these levels by message, with one full line as an example."""
    numbers, examples = collections.Counter(), {}
    for line in Path(log).read_text(errors="replace").splitlines():
        try:
            entry = json.loads(line)
        except ValueError:
            # A panic writes plain text.
            entry = {"level": "ERROR", "fields": {"message": line[:120]}} if "panicked" in line else {}
        if isinstance(entry, dict) and entry.get("level") in levels:
            message = entry.get("fields", {}).get("message") or entry.get("message") or "?"
            numbers[message] += 1
            examples.setdefault(message, line)
    return numbers, examples


def doctor(program, data):
    """Returns exit code and output of `uniground doctor` on a stopped server's folder."""
    done = subprocess.run([program, "doctor", "--data-dir", data], capture_output=True, text=True)
    return done.returncode, done.stdout + done.stderr
