"""A real server with built-in parts, and the sample scan parsed on it once."""

from __future__ import annotations

import json
import os
import subprocess
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from uniground import Client, Scene

ROOT = Path(__file__).parents[3]
SAMPLE = ROOT / "examples/living_room.zip"
PROGRAM = Path(os.environ.get("UNIGROUND_PROGRAM", ROOT / "target/release/uniground")).resolve()
KEY = "ug_python_tests_0123456789"


@contextmanager
def running(data: Path) -> Iterator[str]:
    """The address of a server that keeps its data in a folder, until the block ends."""
    assert PROGRAM.exists(), f"there is no {PROGRAM}: build it, or name another in UNIGROUND_PROGRAM"
    options = ["--listen", "127.0.0.1:0", "--data-dir", str(data), "--masks", "builtin", "--encoder", "builtin"]
    with (data.parent / "server.log").open("a") as log:
        server = subprocess.Popen(
            [str(PROGRAM), "serve", *options],
            env={**os.environ, "UNIGROUND_API_KEY": KEY},
            stdout=subprocess.PIPE,
            stderr=log,
            text=True,
        )
    try:
        assert server.stdout is not None
        line = server.stdout.readline()
        assert line.startswith("listening on "), (data.parent / "server.log").read_text()
        yield line.split()[-1]
    finally:
        server.terminate()
        server.wait(30)


@pytest.fixture(scope="session")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with running(tmp_path_factory.mktemp("server") / "data") as url:
        yield url


@pytest.fixture(autouse=True)
def environment(monkeypatch: pytest.MonkeyPatch, server: str) -> None:
    """As it is in a shell where the command line reaches the server."""
    monkeypatch.setenv("UNIGROUND_SERVER", server)
    monkeypatch.setenv("UNIGROUND_API_KEY", KEY)
    # For documentation that starts a server of its own.
    monkeypatch.setenv("UNIGROUND_PROGRAM", str(PROGRAM))


@pytest.fixture(scope="session")
def scene(server: str) -> Scene:
    return Client(server, KEY).upload(SAMPLE, name="living room", idempotency_key="sample").wait(timeout_s=120)


@pytest.fixture
def client(server: str) -> Iterator[Client]:
    with Client() as client:
        yield client


@pytest.fixture(scope="session")
def few_frames(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Every sixth frame of the sample: quick to parse, for what asks little of the result."""
    file = tmp_path_factory.mktemp("scans") / "few_frames.zip"
    with zipfile.ZipFile(SAMPLE) as sample, zipfile.ZipFile(file, "w") as few:
        manifest = json.loads(sample.read("scene.json"))
        manifest["frames"] = manifest["frames"][::6]
        few.writestr("scene.json", json.dumps(manifest))
        for name in [name for frame in manifest["frames"] for name in (frame["color"], frame["depth"], frame["pose"])]:
            few.writestr(name, sample.read(name))
    return file
