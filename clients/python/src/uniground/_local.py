"""A private server on this machine, for as long as a program needs it: `uniground.serve` and `Client.local`."""

from __future__ import annotations

import importlib.util
import os
import queue
import secrets
import shutil
import signal
import subprocess
import sysconfig
import tempfile
import threading
import time
import weakref
from collections.abc import Sequence
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Optional, Union

import httpx

from uniground._wire import UnigroundError

if TYPE_CHECKING:
    from uniground._sync import Client

PROGRAM = "uniground"
STOP_TIMEOUT_S = 30.0
POLL_S = 0.05
# Variables for the program that a private server must not share with another server: its key, and where its data are.
NOT_INHERITED = ("API_KEY", "API_KEY_FILE", "ALLOWED_HOSTS", "BLOBS", "DATABASE", "DATA_DIR", "LISTEN", "ROLE", "WEBHOOK_URL")
NOT_FOUND = (
    "The program `uniground` was not found. Install the wheel uniground-server, or put a build on PATH. "
    "Or set UNIGROUND_PROGRAM to its path, or use Client(…) with the address of a server."
)

PathLike = Union[str, "os.PathLike[str]"]


def find_program() -> str:
    """Path of the program `uniground`: `UNIGROUND_PROGRAM`, else of the package `uniground-server`, else on PATH."""
    if named := os.environ.get("UNIGROUND_PROGRAM"):
        if found := shutil.which(named):
            return found
        raise UnigroundError("program_not_found", f"UNIGROUND_PROGRAM is {named!r}, which is not a program")
    # The package may carry the program itself, or install it beside this Python, which need not be on PATH.
    folders = [sysconfig.get_path("scripts")]
    spec = importlib.util.find_spec("uniground_server")
    for folder in (spec.submodule_search_locations or []) if spec else []:
        folders[:0] = [folder, os.path.join(folder, "bin")]
    for path in (os.pathsep.join(folders), None):
        if found := shutil.which(PROGRAM, path=path):
            return found
    raise UnigroundError("program_not_found", NOT_FOUND)


class Server:
    """A private server that was started by this program, and stops with it. Made by `serve`."""

    def __init__(
        self, data_dir: Optional[PathLike], models: PathLike, program: Optional[PathLike], options: Sequence[str], timeout_s: float
    ):
        command = [os.fspath(program or find_program()), "serve", "--listen", "127.0.0.1:0", *_model_options(models)]
        self.api_key = f"ug_{secrets.token_hex(16)}"
        """Of this server only; other users of the machine do not know it."""
        home = Path(tempfile.mkdtemp(prefix="uniground-"))
        self.data_dir = home / "data" if data_dir is None else Path(data_dir)
        """Where scenes and answers are stored; a temporary folder is removed when the server stops."""
        inherited = {name: value for name, value in os.environ.items() if name not in {f"UNIGROUND_{name}" for name in NOT_INHERITED}}
        log = home / "server.log"
        try:
            with log.open("wb") as errors:
                # A session of its own: Ctrl-C, or an interrupted cell of a notebook, must not stop the server.
                self._process = subprocess.Popen(  # noqa: S603, the program and the options are the caller's
                    [*command, "--data-dir", str(self.data_dir), *options],
                    env={**inherited, "UNIGROUND_API_KEY": self.api_key},
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.PIPE,
                    stderr=errors,
                    text=True,
                    start_new_session=True,
                )
        except OSError as error:
            shutil.rmtree(home, ignore_errors=True)
            raise UnigroundError("program_not_found", f"{command[0]} cannot be started: {error.strerror}") from error
        self._stop = weakref.finalize(self, _stop, self._process, _guard(self._process.pid), home, os.getpid())
        try:
            self.url = _wait_until_ready(self._process, log, time.monotonic() + timeout_s)
            """Its address."""
        except BaseException:
            self._stop()
            raise

    def client(self, *, timeout_s: float = 300.0, retries: int = 4) -> Client:
        """A client of this server."""
        from uniground._sync import Client

        return Client(self.url, self.api_key, timeout_s=timeout_s, retries=retries)

    def stop(self) -> None:
        """Stops the server, as leaving the block does. Its temporary folder is removed; a folder of yours stays."""
        self._stop()

    @property
    def is_running(self) -> bool:
        return self._process.poll() is None

    def __enter__(self) -> Server:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.url!r}, {'running' if self.is_running else 'stopped'})"


def serve(
    data_dir: Optional[PathLike] = None,
    models: PathLike = "builtin",
    *,
    program: Optional[PathLike] = None,
    options: Sequence[str] = (),
    timeout_s: float = 60.0,
) -> Server:
    """Starts a private server on a free port and returns when it is ready. A context manager; the server also stops when Python ends.

    `data_dir` keeps scenes for the next time; left out, they go when the server stops. `models` is `builtin` (no neural networks), `auto`
    (what the folder `./models` has) or a folder of model bundles. `options` are other options of `uniground serve`, such as
    `["--fetch-models"]`. `program` is the path of `uniground`; left out, `UNIGROUND_PROGRAM`, the package `uniground-server` and PATH
    tell. `timeout_s` bounds the start.
    """
    return Server(data_dir, models, program, options, timeout_s)


def _model_options(models: PathLike) -> list[str]:
    if models in ("builtin", "auto"):
        return ["--masks", str(models), "--encoder", str(models)]
    if not Path(models).is_dir():
        raise ValueError(f"models must be 'builtin', 'auto' or a folder of model bundles, not {os.fspath(models)!r}")
    return ["--masks", "auto", "--encoder", "auto", "--models", os.fspath(models)]


def _guard(pid: int) -> Optional[subprocess.Popen[bytes]]:
    """Stops the server when this program ends without stopping it, killed for example: then the guard's input ends."""
    script = f"read -r _; kill -s TERM -- -{pid}"
    try:
        return subprocess.Popen(  # noqa: S603, a script of ours
            ["/bin/sh", "-c", script], stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
        )
    except OSError:
        # A container without a shell.
        return None


def _wait_until_ready(process: subprocess.Popen[str], log: Path, end: float) -> str:
    lines: queue.SimpleQueue[str] = queue.SimpleQueue()
    threading.Thread(target=_read, args=(process.stdout, lines), daemon=True).start()
    line = ""
    while not line.startswith("listening on "):
        try:
            line = lines.get(timeout=max(0.0, end - time.monotonic()))
        except queue.Empty:
            raise UnigroundError("server_not_started", f"The server is not ready in time.\n{_last_lines(log)}") from None
        if not line:
            raise UnigroundError("server_not_started", f"The server ended while it was starting.\n{_last_lines(log)}")
    url = line.split()[-1]
    while not _is_ready(url):
        if process.poll() is not None or time.monotonic() > end:
            raise UnigroundError("server_not_started", f"The server does not get ready.\n{_last_lines(log)}")
        time.sleep(POLL_S)
    return url


def _read(out: IO[str], lines: queue.SimpleQueue[str]) -> None:
    """To the end, so that the server never waits for somebody to read; an empty line tells that it is over."""
    with out:
        for line in out:
            lines.put(line)
    lines.put("")


def _is_ready(url: str) -> bool:
    try:
        return httpx.get(f"{url}/readyz", timeout=5.0, trust_env=False).is_success
    except httpx.TransportError:
        return False


def _last_lines(log: Path) -> str:
    return "\n".join(log.read_text(errors="replace").splitlines()[-10:])


def _stop(process: subprocess.Popen[str], guard: Optional[subprocess.Popen[Any]], home: Path, owner: int) -> None:
    if os.getpid() != owner:
        # A fork of the program that owns the server.
        return
    _signal(process, signal.SIGTERM)
    try:
        process.wait(STOP_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        _signal(process, signal.SIGKILL)
        process.wait()
    if guard is not None:
        guard.kill()
        guard.wait()
        if guard.stdin is not None:
            guard.stdin.close()
    shutil.rmtree(home, ignore_errors=True)


def _signal(process: subprocess.Popen[str], number: signal.Signals) -> None:
    """To the whole group: the program may be a script that runs the server."""
    if process.poll() is None:
        os.killpg(process.pid, number)
