#!/usr/bin/env python3
"""A server whose scans and parses are in an object store: on a machine without local copies, during an outage of the store, within the limit of
local copies, and with orphans in the store.

usage: object_store_outage.py --program PROGRAM --server S3S_FS
"""
import argparse
import hashlib
import io
import json
import os
import pathlib
import shutil
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.request
import zipfile

from database_outage import QUESTIONS, SCAN, Server, check, until, comparable_answer
from object_store import BUCKET, KEYS, ObjectStore

PREFIX = "a/site"
CACHE_BYTES = 25_000_000
COPIES = ("contents", "parses", "answers", "checkpoints")
AWAY_S = 20


class Site:
    """A data folder and its object store."""

    def __init__(self, program, store, folder):
        self.program, self.store, self.data = program, store, pathlib.Path(folder) / "data"
        self.environment = {**os.environ, **store.environment(), "UNIGROUND_BLOBS": f"s3://{BUCKET}/{PREFIX}"}
        self.objects = store.bucket / PREFIX

    def serve(self, *arguments):
        return Server(self.program, self.data, *arguments, environment=self.environment)

    def run(self, *arguments, **more):
        """Runs a command on the stopped server's folder."""
        return subprocess.run([self.program, *arguments], env=self.environment, capture_output=True, text=True, check=False, **more)

    def forget_copies(self):
        """Deletes local copies, as on a machine that was replaced."""
        for kind in COPIES:
            shutil.rmtree(self.data / "blobs" / kind)

    def folders(self, kind):
        """Returns the names of the folders of a kind in the store."""
        return {folder.name for folder in (self.objects / kind).glob("*") if any(path.is_file() for path in folder.rglob("*"))}

    def bytes_of_copies(self):
        files = [path for kind in COPIES[:3] for path in (self.data / "blobs" / kind).rglob("*")]
        return sum(path.stat().st_size for path in files if path.is_file())


def another_scan(number):
    """Returns the same room with another hash."""
    archive = io.BytesIO(SCAN.read_bytes())
    with zipfile.ZipFile(archive, "a") as scan:
        scan.comment = f"copy {number}".encode()
    return archive.getvalue()


def upload(server, scan):
    made = server.call("POST", "/v1/scenes", scan, "application/zip")
    return made[2]["scene"]["id"] if made[0] in (200, 201, 202) else made


def ready(server, scene):
    until(f"the parse of {scene}", lambda: server.call("GET", f"/v1/scenes/{scene}")[2]["status"] in ("ready", "failed"), 300)
    return server.call("GET", f"/v1/scenes/{scene}")[2]


def fetched(server, path):
    """Returns the bytes of a file."""
    with urllib.request.urlopen(server.url + path, timeout=60) as reply:
        return reply.read()


def ask(server, scene, query):
    return server.call("POST", f"/v1/scenes/{scene}/ground", {"query": query})


def everything(server, scene):
    """Returns everything that a client can read of a scene, for comparison."""
    pictures = [picture["url"] for picture in server.call("GET", f"/v1/scenes/{scene}/report")[2]["pictures"]]
    frames = server.call("GET", f"/v1/scenes/{scene}/frames")[2]["frames"]
    paths = [f"/v1/scenes/{scene}/{file}" for file in
             ("cloud.ply", "instances.ply", "points.bin", "thumbnail.jpg", "export?format=glb", "instances/1/views/0.jpg", "instances",
              f"frames/{frames[0]['index']}/photograph.jpg")]
    files = {path: hashlib.sha256(fetched(server, path)).hexdigest() for path in paths + pictures}
    return files, [comparable_answer(ask(server, scene, query)[2]) for query in QUESTIONS]


def a_machine_without_copies(site):
    server = site.serve()
    try:
        scene = upload(server, SCAN.read_bytes())
        ready(server, scene)
        before = everything(server, scene)
    finally:
        server.stop()
    site.forget_copies()
    server = site.serve()
    try:
        check(f"a machine without copies shows the same {len(before[0])} files, byte for byte, and gives the same answers",
              everything(server, scene) == before)
        # Other settings of the last stages, with the first parse's checkpoints in the object store.
        job = server.call("POST", f"/v1/scenes/{scene}/parse", {"settings": {"parsing": {"merging": {"thresholds": [0.8, 0.7, 0.6, 0.5, 0.4]}}}})
        scene_now = ready_again(server, scene, job)
        reused = [stage["stage"] for stage in scene_now["report"]["stages"] if stage["reused"]]
        check(f"another parse goes on from stages that were put there ({', '.join(reused)})", len(reused) > 1)
    finally:
        server.stop()
    return scene


def ready_again(server, scene, job):
    check(f"it is parsed again ({job[0]})", job[0] == 202)
    id = job[2]["id"]
    until("the second parse", lambda: server.call("GET", f"/v1/jobs/{id}")[2]["state"] in ("succeeded", "failed"), 300)
    return server.call("GET", f"/v1/scenes/{scene}")[2]


def away(site, scene):
    """The store is killed, and then frozen: requests get clear 503s, nothing is left half written, and the server recovers by itself."""
    store = site.store
    for how, leave, come_back in (("gone", store.kill, store.start), ("silent", store.freeze, store.thaw)):
        site.forget_copies()
        server = site.serve()
        try:
            known = upload(server, another_scan(f"before {how}"))
            check(f"it answers ({how})", ask(server, scene, QUESTIONS[0])[0] == 200)
            leave()
            gone = time.monotonic()
            status, headers, problem = server.call("GET", f"/v1/scenes/{scene}/cloud.ply")
            took = time.monotonic() - gone
            check(f"a file that would have to be brought is a {status} {problem['code']} with Retry-After, after {took:.1f} s",
                  (status, problem["code"]) == (503, "blobs_busy") and headers["retry-after"] is not None and took < 30)
            scenes = len(server.call("GET", "/v1/scenes?limit=100")[2]["scenes"])
            status, _, problem = server.call("POST", "/v1/scenes", another_scan(f"while {how}"), "application/zip")
            check(f"an upload is a {status} {problem['code']}, and makes no scene",
                  (status, problem["code"]) == (503, "blobs_busy") and len(server.call("GET", "/v1/scenes?limit=100")[2]["scenes"]) == scenes)
            check("a scene that is in memory is asked about all the same", ask(server, scene, QUESTIONS[1])[0] == 200)
            check("/readyz says no, /healthz does not mind", not server.ready() and server.call("GET", "/healthz")[0] == 200)
            time.sleep(max(0.0, AWAY_S - (time.monotonic() - gone)))
            come_back()
            back = time.monotonic()
            until("/readyz", server.ready)
            print(f"ready {time.monotonic() - back:.1f} s after the store was back", flush=True)
            check("the file is there", len(fetched(server, f"/v1/scenes/{scene}/cloud.ply")) > 0)
            check("the parse that was under way ends well", ready(server, known)["status"] == "ready")
            again = upload(server, another_scan(f"while {how}"))
            check("the upload works, and so does its parse", ready(server, again)["status"] == "ready")
        finally:
            server.stop()


def within_the_bound(site):
    server = site.serve("--blobs-cache-bytes", str(CACHE_BYTES))
    try:
        scenes, most = [], 0
        for number in range(3):
            scenes.append(upload(server, another_scan(number)))
            ready(server, scenes[-1])
            most = max(most, site.bytes_of_copies())
        answers = {comparable_answer(ask(server, scene, QUESTIONS[0])[2]) for scene in scenes for _ in range(2)}
        for scene in scenes:
            fetched(server, f"/v1/scenes/{scene}/points.bin")
        until("copies within their bound", lambda: site.bytes_of_copies() <= CACHE_BYTES, 10)
        kept = sum(path.stat().st_size for path in site.objects.rglob("*") if path.is_file() and "checkpoints" not in path.parts)
        check(f"copies stay within {CACHE_BYTES} bytes ({site.bytes_of_copies()} now, {most} at most after a parse) of {kept} in the store",
              most <= CACHE_BYTES < kept)
        check("all rooms are answered alike", len(answers) == 1)
    finally:
        server.stop()
    return scenes


def deleted(site, scenes):
    server = site.serve()
    try:
        before = {kind: site.folders(kind) for kind in COPIES}
        check("a scene is deleted", server.call("DELETE", f"/v1/scenes/{scenes[0]}")[0] == 204)
        one_less = lambda: all(len(site.folders(kind)) == len(before[kind]) - 1 for kind in ("contents", "parses", "checkpoints"))
        until("its objects go", one_less, 30)
        check("its objects go, and nobody else's", one_less())
    finally:
        server.stop()


def put(place, files):
    for name, text in files.items():
        (place / name).parent.mkdir(parents=True, exist_ok=True)
        (place / name).write_text(text)


def orphans_and_torn(site, scenes):
    """Orphans are collected after the grace period and not before; files without a seal are never read."""
    sealed = {".sha256sums": f"# 0001\n{hashlib.sha256(b'x').hexdigest()}  cloud.ply\n", "0001/cloud.ply": "x"}
    scan = another_scan("torn")
    hash = hashlib.sha256(scan).hexdigest()
    put(site.objects / "contents" / hash / "0002", {"scene.json": "{}", "cloud.ply": "torn"})
    put(site.objects / "parses" / "orphan", sealed)
    put(site.objects / "answers" / "orphan" / "0001", {"prompt.json": "{}"})
    server = site.serve()
    try:
        scene = upload(server, scan)
        check("an upload beside a torn one of the same scan is parsed", ready(server, scene)["status"] == "ready")
        files = everything(server, scene)
    finally:
        server.stop()
    check("and reads nothing of it", all(b"torn" != path.read_bytes() for path in (site.data / "blobs/contents" / hash).rglob("*") if path.is_file()))

    def orphaned(grace_s):
        told = site.run("gc", "--json", "--data-dir", str(site.data), "--blobs-grace-s", str(grace_s))
        if told.returncode != 0:
            sys.exit(f"FAILED: gc: {told.stderr}")
        return [kind["entries"] for kind in json.loads(told.stdout)["removed"] if kind["kind"] == "orphaned objects"]

    check("what is young stays, whoever it belongs to", orphaned(3600) == [0] and "orphan" in site.folders("parses"))
    time.sleep(2)
    removed = orphaned(1)
    check(f"what is old and nobody's goes: {removed}", removed == [3])
    check("none of it is left", "orphan" not in site.folders("parses") | site.folders("answers") and not (site.objects / "contents" / hash / "0002" / "cloud.ply").exists())
    check("doctor finds nothing wrong", site.run("doctor", "--data-dir", str(site.data)).returncode == 0)
    site.forget_copies()
    server = site.serve()
    try:
        check("and nothing of anybody's is gone", everything(server, scene) == files and all(ask(server, scene, QUESTIONS[0])[0] == 200 for scene in scenes))
    finally:
        server.stop()


def links(site, scene):
    """Signed links to the object store return the same bytes, and nothing else."""
    server = site.serve()
    try:
        files = {file: fetched(server, f"/v1/scenes/{scene}/{file}") for file in ("cloud.ply", "instances.ply", "points.bin")}
    finally:
        server.stop()
    site.forget_copies()
    server = site.serve("--blobs-redirect")
    try:
        for file, expected in files.items():
            with urllib.request.urlopen(f"{server.url}/v1/scenes/{scene}/{file}", timeout=60) as reply:
                link, same = reply.geturl(), reply.read() == expected
            check(f"{file} comes from the object store, as it was", same and link.startswith(f"http://127.0.0.1:{site.store.port}/{BUCKET}/"))
        try:
            status = urllib.request.urlopen(link.replace("/points.bin", "/cloud.ply"), timeout=60).status
        except urllib.error.HTTPError as error:
            status = error.code
        check(f"a link to one file is none to another ({status})", status == 403)
        check("nothing large was brought for that", site.bytes_of_copies() < 100_000)
    finally:
        server.stop()


def refusals(site):
    """Options that do not work with an object store are refused with a reason."""
    data = ("--data-dir", str(site.data))
    elsewhere = {**site.environment, "UNIGROUND_BLOBS": "folder"}
    for what, told in (
        ("backup", site.run("backup", str(site.data.parent / "backup"), *data)),
        ("a dry run", site.run("gc", "--dry-run", *data)),
        ("without --blobs", subprocess.run([site.program, "doctor", *data], env=elsewhere, capture_output=True, text=True, check=False)),
    ):
        check(f"{what}: {told.stderr.strip().splitlines()[-1]}", told.returncode != 0 and f"s3://{BUCKET}/{PREFIX}" in told.stderr)
    seal = next((site.objects / "parses").glob("*/.sha256sums"))
    (lost,) = [path for path in (seal.parent).glob("*/cloud.ply")]
    lost.rename(lost.with_suffix(".lost"))
    told = site.run("doctor", *data)
    check("doctor tells of an object that is lost", told.returncode != 0 and "cloud.ply missing" in told.stdout)
    lost.with_suffix(".lost").rename(lost)
    log = site.data.parent / "log"
    with log.open("w") as to:
        process = subprocess.Popen([site.program, "serve", "--listen", "127.0.0.1:0", *data], env={**site.environment, "RUST_LOG": "debug,hyper=trace"},
                                   stdout=subprocess.PIPE, stderr=to, text=True)
        process.stdout.readline()
        time.sleep(2)
        process.terminate()
        process.wait(60)
    text = log.read_text()
    check("no key is logged, whatever is", KEYS["AWS_SECRET_ACCESS_KEY"] not in text and len(text) > 1000)


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--program", required=True)
    parser.add_argument("--server", required=True)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        store = ObjectStore(args.server, pathlib.Path(folder) / "store")
        try:
            site = Site(args.program, store, folder)
            scene = a_machine_without_copies(site)
            away(site, scene)
            scenes = within_the_bound(site)
            deleted(site, scenes)
            orphans_and_torn(site, [scene, *scenes[1:]])
            links(site, scene)
            refusals(site)
        finally:
            store.kill()


if __name__ == "__main__":
    main()
