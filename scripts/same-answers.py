#!/usr/bin/env python3
"""Compares the answers of two versions of uniground: the sample scene and its questions through both, byte for byte except for ids and times.

scripts/same-answers.py path/to/uniground path/to/other/uniground [scan.zip queries.json]
"""

import json
import re
import subprocess
import sys
import tempfile
import urllib.error
import urllib.request
from pathlib import Path

EXAMPLES = Path(__file__).parent.parent / "examples"
VARIANTS = [
    {},
    {"top_k": 10, "direction_convention": "viewer"},
    {"observer": {"position": [0.0, -1.0, 1.5], "yaw_rad": 1.2}, "include": ["candidates", "trace"]},
]


class Server:
    def __init__(self, program, folder):
        command = [program, "serve", "--listen", "127.0.0.1:0", "--data-dir", folder, "--masks", "rgbd", "--encoder", "attributes"]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
        self.url = self.process.stdout.readline().split()[-1]

    def call(self, path, body=None, media_type="application/json"):
        data = json.dumps(body).encode() if isinstance(body, (dict, list)) else body
        request = urllib.request.Request(self.url + path, data, {"content-type": media_type})
        try:
            with urllib.request.urlopen(request) as response:
                return response.read()
        except urllib.error.HTTPError as error:
            return error.read()


# Fields that differ between two runs of the same version.
CHANGING = re.compile(rb'"timings_ms":\{[^}]*\}|[0-9a-f]{8}-[0-9a-f]{4}-[0-9a-f]{4}-[0-9a-f]{4}-[0-9a-f]{12}')


def told(program, scan, queries):
    with tempfile.TemporaryDirectory() as folder:
        server = Server(program, folder)
        try:
            created = json.loads(server.call("/v1/scenes?name=room", scan, "application/zip"))
            scene = created["scene"]["id"]
            server.call(f"/v1/jobs/{created['job']['id']}/events")
            replies = [("instances", server.call(f"/v1/scenes/{scene}/instances?limit=1000"))]
            for query in queries:
                for variant in VARIANTS:
                    replies.append((f"{query} {variant}", server.call(f"/v1/scenes/{scene}/ground", {"query": query, **variant})))
                replies.append((f"shortlist {query}", server.call(f"/v1/scenes/{scene}/shortlist", {"query": query})))
            for bad in [b"{", b"{}", b'{"query": ""}', b'{"query": "x", "top_k": 0}', b'{"query": "x", "y": 1}']:
                replies.append((f"bad {bad}", server.call(f"/v1/scenes/{scene}/ground", bad)))
            return replies
        finally:
            server.process.terminate()
            server.process.wait()


def main():
    ours, theirs = sys.argv[1:3]
    scan, queries = (
        (Path(p) for p in sys.argv[3:5]) if len(sys.argv) > 3 else (EXAMPLES / "living_room.zip", EXAMPLES / "living_room.queries.json")
    )
    questions = [entry["query"] for entry in json.loads(queries.read_text())]
    replies = [told(program, scan.read_bytes(), questions) for program in (ours, theirs)]
    # Two servers that both refuse everything would also give equal answers.
    if not any(b'"box":{"center"' in reply for _, reply in replies[0]):
        sys.exit("neither version found anything: there is nothing to compare")
    unlike = 0
    for (what, one), (_, other) in zip(*replies):
        one, other = CHANGING.sub(b"", one), CHANGING.sub(b"", other)
        if one != other:
            unlike += 1
            at = next((i for i, (a, b) in enumerate(zip(one, other)) if a != b), min(len(one), len(other)))
            print(f"{what}\n  {one[max(0, at - 80) : at + 120]!r}\n  {other[max(0, at - 80) : at + 120]!r}")
    print(f"{len(replies[0])} replies to {len(questions)} questions compared, {unlike} differ")
    sys.exit(unlike > 0)


main()
