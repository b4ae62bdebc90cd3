#!/usr/bin/env python3
"""An S3 object store on loopback: s3s-fs on a folder of its own. Can also run a command with one.

usage: object_store.py --server S3S_FS -- COMMAND...
(COMMAND gets the bucket in UNIGROUND_TEST_S3 and the connection in AWS_...)
"""
import argparse
import os
import pathlib
import signal
import socket
import subprocess
import sys
import tempfile
import time

BUCKET = "rooms"
# Credentials for this server only, which is not reachable from outside.
KEYS = {"AWS_ACCESS_KEY_ID": "loopback-id", "AWS_SECRET_ACCESS_KEY": "loopback-secret-of-a-test", "AWS_REGION": "us-east-1"}


class ObjectStore:
    """A server on a folder that outlives it."""

    def __init__(self, program, folder):
        self.program, self.folder = program, pathlib.Path(folder)
        self.bucket = self.folder / BUCKET
        self.bucket.mkdir(parents=True)
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.process = None
        self.start()

    def environment(self):
        """Returns the environment variables that tell a program about it."""
        return {**KEYS, "AWS_ENDPOINT_URL": f"http://127.0.0.1:{self.port}"}

    def start(self):
        command = [str(self.program), "--host", "127.0.0.1", "--port", str(self.port), "--access-key", KEYS["AWS_ACCESS_KEY_ID"],
                   "--secret-key", KEYS["AWS_SECRET_ACCESS_KEY"], str(self.folder)]
        self.process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env={**os.environ, "RUST_LOG": "off"})
        for _ in range(600):
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", self.port)) == 0:
                    return
            time.sleep(0.05)
        sys.exit("the object store does not start")

    def kill(self):
        self.process.kill()
        self.process.wait()

    def freeze(self):
        self.process.send_signal(signal.SIGSTOP)

    def thaw(self):
        self.process.send_signal(signal.SIGCONT)


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--server", required=True)
    parser.add_argument("command", nargs=argparse.REMAINDER)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        store = ObjectStore(args.server, folder)
        try:
            environment = {**os.environ, **store.environment(), "UNIGROUND_TEST_S3": f"s3://{BUCKET}"}
            # Without the dashes before the command.
            return subprocess.run(args.command[1:], env=environment, check=False).returncode
        finally:
            store.kill()


if __name__ == "__main__":
    sys.exit(main())
