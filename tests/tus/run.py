"""Two existing tus clients against a real server that is killed during the upload: Python's tuspy, with checksums, and tus-js-client if Node
is installed. Each uploads the sample scan in parts, loses its server, and resumes at its offset.

    python tests/tus/run.py --program target/release/uniground
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import socket
import subprocess
import tempfile
import urllib.request
from pathlib import Path
from typing import Any

from tusclient.client import TusClient
from tusclient.exceptions import TusCommunicationError, TusUploadFailed

ROOT = Path(__file__).parents[2]
SAMPLE = ROOT / "examples/living_room.zip"
PART_BYTES = 500_000
KEY = "a-key-for-tests-0123456789abcdef0123456789"


class Server:
    """A server on one address across kills."""

    def __init__(self, program: str, data: Path) -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.address = f"127.0.0.1:{free.getsockname()[1]}"
        self.command = [program, "serve", "--listen", self.address, "--data-dir", str(data), "--masks", "builtin", "--encoder", "builtin"]
        self.log = data.parent / "log"
        self.start()

    def start(self) -> None:
        with self.log.open("a") as log:
            environment = os.environ | {"UNIGROUND_API_KEY": KEY}
            self.process = subprocess.Popen(self.command, stdout=subprocess.PIPE, stderr=log, text=True, env=environment)
        assert self.process.stdout is not None
        assert self.process.stdout.readline().startswith("listening on "), self.log.read_text()

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()

    def get(self, path: str) -> dict[str, Any]:
        request = urllib.request.Request(f"http://{self.address}{path}", headers={"authorization": f"Bearer {KEY}"})
        with urllib.request.urlopen(request) as reply:
            return json.load(reply)

    def check(self, client: str, upload: str, name: str) -> None:
        told = self.get(f"/v1/uploads/{upload.rsplit('/', 1)[1]}")
        assert told["state"] == "done" and told["offset"] == SAMPLE.stat().st_size, told
        scene = self.get(f"/v1/scenes/{told['scene_id']}")
        assert scene["name"] == name and scene["job_id"] == told["job_id"], scene
        print(f"{client}: {told['offset']} bytes in parts of {PART_BYTES}, the server killed in between; scene {scene['status']}")


def tuspy(server: Server) -> None:
    client = TusClient(f"http://{server.address}/v1/uploads", headers={"Authorization": f"Bearer {KEY}"})
    wanted = {"filename": SAMPLE.name, "name": "by tuspy"}
    uploader = client.uploader(str(SAMPLE), chunk_size=PART_BYTES, metadata=wanted, upload_checksum=True)
    uploader.upload(stop_at=2 * PART_BYTES)
    server.kill()
    try:
        uploader.upload_chunk()
        raise AssertionError("the server did not answer")
    except (TusCommunicationError, TusUploadFailed, OSError):
        server.start()
    again = client.uploader(str(SAMPLE), chunk_size=PART_BYTES, url=uploader.url, upload_checksum=True)
    assert again.offset == 2 * PART_BYTES, again.offset
    again.upload()
    server.check("tuspy", again.url, "by tuspy")


def tus_js_client(server: Server) -> None:
    script = [str(ROOT / "tests/tus/client.mjs"), f"http://{server.address}/v1/uploads", str(SAMPLE), KEY, str(PART_BYTES)]
    with subprocess.Popen(["node", *script], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as client:
        assert client.stdin is not None and client.stdout is not None
        # The client reports after two parts and continues when it is told to; the rest happens in the client.
        upload = client.stdout.readline().strip()
        server.kill()
        print("go on", file=client.stdin, flush=True)
        # Until it has failed to reach the server at least once.
        assert client.stdout.readline() == "lost\n"
        server.start()
        assert client.wait() == 0 and client.stdout.read() == f"{2 * PART_BYTES}\n"
    server.check("tus-js-client", upload, "by tus-js-client")


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--program", default=str(ROOT / "target/release/uniground"))
    program = parser.parse_args().program
    with tempfile.TemporaryDirectory() as folder:
        server = Server(program, Path(folder) / "data")
        try:
            tuspy(server)
            if shutil.which("node") and (ROOT / "web/node_modules/tus-js-client").exists():
                tus_js_client(server)
            else:
                print("skipped: tus-js-client, there is no node, or web/node_modules is not installed")
        finally:
            server.kill()


main()
