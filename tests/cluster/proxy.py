#!/usr/bin/env python3
"""The proxy of deploy/compose.yaml in front of two API processes: uploads, events and disconnects pass through it, and callers do not notice
when an API dies.

usage: proxy.py --program PROGRAM --database postgres://…        (an empty database; needs Debian's caddy. scripts/test-cluster.sh)
"""
import argparse
import socket
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

sys.dont_write_bytecode = True
sys.path.insert(1, str(Path(__file__).resolve().parents[1] / "soak"))

from callers import Caller
from fleet import Fleet
from kills import CalmFleet, LEASE_S
from model import Model
from scans import Scans
from table import Table
from wire import Connection, expect, read_head, request_bytes

CADDYFILE = Path(__file__).resolve().parents[2] / "deploy" / "compose" / "Caddyfile"
# No request and no state change may take longer.
PATIENCE_S = 30
TUS = [("tus-resumable", "1.0.0")]


class Proxy:
    """Caddy with the deployed configuration, except for addresses."""

    def __init__(self, folder, apis):
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.address = probe.getsockname()
        text = CADDYFILE.read_text().replace("\n:8080 {", f"\n:{self.address[1]} {{\n\tbind 127.0.0.1")
        for at, api in enumerate(apis, 1):
            text = text.replace(f"api-{at}:8080", "{}:{}".format(*api))
        file = folder / "Caddyfile"
        file.write_text(text)
        command = ["caddy", "run", "--adapter", "caddyfile", "--config", file]
        self.process = subprocess.Popen(command, stderr=(folder / "caddy.log").open("w"), env={"HOME": str(folder), "PATH": "/usr/bin:/bin"})

    def connection(self):
        return Connection(self.address, PATIENCE_S)

    def __enter__(self):
        until("the proxy", lambda: self.connection().call("GET", "/readyz").status == 200)
        return self

    def __exit__(self, *_):
        self.process.kill()
        self.process.wait()


def until(what, true):
    """Waits until a condition holds and returns its value."""
    end = time.time() + PATIENCE_S
    while time.time() < end:
        try:
            if found := true():
                return found
        except OSError:
            pass
        time.sleep(0.05)
    raise AssertionError(f"{what}: not reached within {PATIENCE_S} s")


def counted(fleet, beginning):
    """Returns each API's sum over the metric lines with this prefix."""
    texts = [Connection(address).call("GET", "/metrics").body.decode() for address in fleet.addresses()]
    return [sum(float(line.rsplit(" ", 1)[1]) for line in text.splitlines() if line.startswith(beginning)) for text in texts]


def uploads_in_parts(table, proxy, fleet, scans):
    """Checks that all parts of an upload reach the same API, and that both APIs get uploads: the proxy hashes ids, which are random, so further
    uploads follow while one API has got none."""
    parts = 'uniground_http_requests_total{method="PATCH",route="/v1/uploads/{upload_id}"'
    connection, by_api, torn = proxy.connection(), [0, 0], 0
    for at in range(40):
        if at >= 8 and min(by_api) > 0:
            break
        scan = scans.variant(f"part-{at}")
        before = counted(fleet, parts)
        made = connection.send(request_bytes("POST", "/v1/uploads", headers=[*TUS, ("upload-length", len(scan))]))
        path, third = made.headers["location"], len(scan) // 3
        path = path[path.index("/v1/"):]
        for offset in (0, third, 2 * third):
            data = scan[offset:offset + third] if offset < 2 * third else scan[offset:]
            headers = [*TUS, ("upload-offset", offset)]
            status = connection.send(request_bytes("PATCH", path, data, "application/offset+octet-stream", headers)).status
            if status != 204:
                raise AssertionError(f"part at {offset}: {status}")
        came = [int(now - then) for now, then in zip(counted(fleet, parts), before)]
        torn += sorted(came) != [0, 3]
        by_api = [whole + (one > 0) for whole, one in zip(by_api, came)]
    table.equal("uploads in parts that came to several APIs", torn, 0)
    table.row("uploads in parts by API", str(by_api), "both more than 0", min(by_api) > 0)


def uploads_pass(table, proxy, fleet, scans):
    """Checks that the proxy streams an upload to an API before its end."""
    scan, connection = scans.variant("slow"), proxy.connection()
    connection.open()
    request = request_bytes("POST", "/v1/scenes?name=slow", scan, "application/zip")
    connection.socket.sendall(request[:len(request) // 2])
    seen = until("an upload under way", lambda: sum(counted(fleet, "uniground_uploads_in_flight")) == 1)
    connection.socket.sendall(request[len(request) // 2:])
    table.row("an upload is at the API before its end", f"{seen}, then {connection.read_reply().status}", "True, then 202", True)


def events_pass(table, proxy, fleet, job):
    """Checks that events are streamed, and that the API notices a disconnected caller behind the proxy."""
    connection = proxy.connection()
    connection.open()
    connection.socket.sendall(request_bytes("GET", f"/v1/jobs/{job}/events"))
    status, headers = read_head(connection.until(b"\r\n\r\n"))
    first = next(connection.chunks())
    state = expect(proxy.connection().call("GET", f"/v1/jobs/{job}"), 200)["state"]
    table.row("a first event, and the job's state then", f"{status} {headers.get('content-type')}, {len(first)} bytes, {state}",
              "before its end", status == 200 and state in ("queued", "running"))
    open_before = sum(counted(fleet, "uniground_http_event_streams"))
    connection.close()
    until("the end of the stream behind the proxy", lambda: sum(counted(fleet, "uniground_http_event_streams")) == 0)
    table.row("open event streams, and after the caller disconnected", f"{open_before:.0f}, 0", "1, 0", open_before == 1)


def nobody_notices(table, proxy, fleet, scene):
    """Checks that callers keep getting answers while an API is killed, restarted and stopped."""
    told, stop = [], threading.Event()

    def ask():
        while not stop.is_set():
            try:
                told.append(proxy.connection().call("GET", f"/v1/scenes/{scene}").status)
            except OSError as error:
                told.append(type(error).__name__)
            time.sleep(0.01)
    threads = [threading.Thread(target=ask, daemon=True) for _ in range(4)]
    for thread in threads:
        thread.start()
    api = fleet.of("api")[0]
    time.sleep(1)
    api.kill()
    time.sleep(2)
    api.start()
    # Until the proxy has noticed that the API is ready.
    time.sleep(4)
    api.server.terminate()
    time.sleep(2)
    api.start()
    time.sleep(4)
    stop.set()
    for thread in threads:
        thread.join(PATIENCE_S)
    wrong = [status for status in told if status != 200]
    # A kill interrupts the requests in progress: four callers ask at a time.
    table.row("answers while an API is killed, started, stopped and started", f"{len(told)}, not 200: {wrong}", "8 not 200 at most", len(wrong) <= 8)
    routes = 'uniground_http_requests_total{method="GET",route="/v1/scenes/{scene_id}"'
    table.row("answered by each API since its last start", str([int(number) for number in counted(fleet, routes)]), "both more than 0", min(counted(fleet, routes)) > 0)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--program", required=True, type=Path)
    parser.add_argument("--database", required=True)
    options = parser.parse_args()
    table, scans, model = Table("the proxy before two APIs"), Scans(6), Model()
    with tempfile.TemporaryDirectory() as folder:
        folder = Path(folder)
        with Fleet(options.program.resolve(), folder, options.database, model, LEASE_S).add(2, 1) as fleet:
            with Proxy(folder, fleet.addresses()) as proxy:
                created = Caller(CalmFleet(proxy)).upload(scans, "first")
                table.equal("/metrics through the proxy", proxy.connection().call("GET", "/metrics").status, 404)
                events_pass(table, proxy, fleet, created["job"]["id"])
                uploads_pass(table, proxy, fleet, scans)
                uploads_in_parts(table, proxy, fleet, scans)
                nobody_notices(table, proxy, fleet, created["scene"]["id"])
    table.print()
    print("everything held" if not table.failed else "did not hold: " + "; ".join(table.failed))
    sys.exit(bool(table.failed))


if __name__ == "__main__":
    main()
