"""A server that the program starts for itself."""

from __future__ import annotations

import asyncio
import os
import signal
import subprocess
import sys
import sysconfig
import time
from pathlib import Path

import httpx
import pytest
from served import PROGRAM

import uniground
from uniground import AsyncClient, Client, UnigroundError
from uniground._local import find_program


def answers(url: str) -> bool:
    try:
        return httpx.get(f"{url}/healthz").is_success
    except httpx.TransportError:
        return False


def test_a_question_needs_no_server_started_by_hand(few_frames: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # What other servers and clients are told by variables is not for this one.
    monkeypatch.setenv("UNIGROUND_SERVER", "http://127.0.0.1:9")
    monkeypatch.setenv("UNIGROUND_DATABASE", "postgres://nobody@127.0.0.1:9/none")
    with Client.local() as client:
        assert client.upload(few_frames, name="my room").wait(timeout_s=120).ask("the sofa").status in ("grounded", "uncertain")
        assert client.scene("my room").status == "ready"
        with pytest.raises(UnigroundError, match="unauthorized"):
            Client(client.server, "ug_somebody_else_12345").call("GET", "/v1/stats")
        assert client._local is not None
        home = client._local.data_dir
        assert home.exists()
    assert not answers(client.server)
    assert not home.parent.exists()


def test_a_folder_of_yours_is_kept(few_frames: Path, tmp_path: Path) -> None:
    with uniground.serve(tmp_path / "data") as server:
        stored = server.client().upload(few_frames, parse=False, name="kept")
        assert repr(server) == f"Server('{server.url}', running)"
        with pytest.raises(UnigroundError, match="another server uses this data folder") as second:
            uniground.serve(tmp_path / "data")
        assert second.value.code == "server_not_started"
        assert server.is_running
    assert repr(server) == f"Server('{server.url}', stopped)"
    server.stop()
    with Client.local(tmp_path / "data") as client:
        assert client.scene("kept").id == stored.id


def test_the_asynchronous_client_has_one_too() -> None:
    async def scenes() -> int:
        async with await AsyncClient.local() as client:
            assert answers(client.server)
            return len([scene async for scene in client.scenes()])

    assert asyncio.run(scenes()) == 0


@pytest.mark.parametrize("end", ["pass", "raise SystemExit(3)", "os.kill(os.getpid(), signal.SIGKILL)"])
def test_the_server_ends_with_the_program(end: str) -> None:
    script = f"import os, signal\nfrom uniground import Client\nclient = Client.local()\nprint(client.server, flush=True)\n{end}"
    url = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60).stdout.strip()
    assert url.startswith("http://127.0.0.1:")
    left = time.monotonic() + 20
    while answers(url):
        assert time.monotonic() < left, "the server is still there"
        time.sleep(0.1)


def test_an_interrupt_does_not_stop_the_server() -> None:
    """As a notebook interrupts a cell: all processes of the group get the signal."""
    script = (
        "import os, signal\nfrom uniground import Client\n"
        # A shell starts background jobs with this signal ignored.
        "signal.signal(signal.SIGINT, signal.default_int_handler)\nclient = Client.local()\n"
        "try:\n    os.killpg(0, signal.SIGINT)\n    signal.pause()\nexcept KeyboardInterrupt:\n    print(len([*client.scenes()]))"
    )
    ran = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60, start_new_session=True)
    assert (ran.stdout, ran.returncode) == ("0\n", 0), ran.stderr


def test_the_program_is_found_where_it_may_be(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    assert find_program() == str(PROGRAM)
    monkeypatch.setenv("UNIGROUND_PROGRAM", str(tmp_path / "nothing"))
    with pytest.raises(UnigroundError, match="which is not a program"):
        Client.local()

    monkeypatch.delenv("UNIGROUND_PROGRAM")
    monkeypatch.setattr(sysconfig, "get_path", lambda _: str(tmp_path / "scripts"))
    monkeypatch.setenv("PATH", str(tmp_path / "path"))
    with pytest.raises(UnigroundError) as missing:
        Client.local()
    assert missing.value.code == "program_not_found"
    assert "Install the wheel uniground-server" in missing.value.detail

    def put(folder: Path) -> str:
        folder.mkdir(parents=True)
        (folder / "uniground").symlink_to(PROGRAM)
        return str(folder / "uniground")

    on_path = put(tmp_path / "path")
    assert find_program() == on_path
    beside_python = put(tmp_path / "scripts")
    assert find_program() == beside_python
    in_package = put(tmp_path / "site" / "uniground_server" / "bin")
    (tmp_path / "site" / "uniground_server" / "__init__.py").touch()
    monkeypatch.syspath_prepend(tmp_path / "site")
    assert find_program() == in_package


def test_what_can_not_start_says_why(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="models must be 'builtin', 'auto' or a folder of model bundles"):
        Client.local(models=tmp_path / "none")
    with pytest.raises(UnigroundError, match="--no-such-option") as refused:
        Client.local(options=["--no-such-option"])
    assert refused.value.code == "server_not_started"
    silent = tmp_path / "silent"
    silent.write_text("#!/bin/sh\nexec sleep 60\n")
    silent.chmod(0o755)
    with pytest.raises(UnigroundError, match="not ready in time"):
        uniground.serve(program=silent, timeout_s=0.2)
    with pytest.raises(UnigroundError, match="cannot be started"):
        uniground.serve(program=tmp_path / "none")


def test_a_script_may_run_the_program(tmp_path: Path) -> None:
    """As a console script of a package may: not replaced by the server, but its parent."""
    script = tmp_path / "uniground"
    script.write_text(f"#!{sys.executable}\nimport subprocess, sys\nsubprocess.run([{str(PROGRAM)!r}, *sys.argv[1:]])\n")
    script.chmod(0o755)
    with uniground.serve(program=script) as server:
        assert answers(server.url)
    left = time.monotonic() + 20
    while answers(server.url):
        assert time.monotonic() < left, "the server is still there"
        time.sleep(0.1)


def test_a_fork_does_not_stop_the_server() -> None:
    with uniground.serve() as server:
        child = os.fork()
        if child == 0:
            server.stop()
            os.kill(os.getpid(), signal.SIGKILL)
        os.waitpid(child, 0)
        assert answers(server.url)
