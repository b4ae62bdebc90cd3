#!/usr/bin/env python3
"""Measures answers with a vision-language model that is played by whoever looks at the pictures.

    scripts/eyes.py run --program target/release/uniground --box FOLDER --evidence full,photographs [--questions 16] [--seed 1]
                        [--serve-arg=ARG ...] --out REPORT.json ROOM.zip ...
    scripts/eyes.py next FOLDER

`run` parses the rooms once, then asks a sample of their questions in every evidence mode, each mode on a copy of the same parses, so that what was
found in one mode does not help another. Beside ROOM.zip stand ROOM.queries.json and ROOM.scene.json, as for `uniground eval`.

The model's endpoint is part of `run`: every request becomes FOLDER/NNN with prompt.txt, image_1.jpg, ... and waits for reply.txt. `next` prints the next
request that nobody has taken; several people may look side by side. They should know neither the code nor the annotations.

Printed are, for each mode and room: how often some instance of the scene, a candidate that was shown, and the answer cover the target (IoU 0.25 and 0.5), how
often the model pointed at the object, and how often that was right, absent objects told (no match, or what the closest object differs in), present objects
denied, calls, and prompt tokens (text by four characters, pictures by 28 x 28 pixels). Questions of the kind `false_premise` say something wrong of an object (another color or place); they count for
themselves: told are those whose answer has the object and says what `differs`. Needs Python's standard library, and Pillow to write the pictures as PNG.
"""

import argparse
import base64
import concurrent.futures
import http.server
import io
import itertools
import json
import os
import random
import re
import shutil
import socketserver
import struct
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from pathlib import Path

WAIT_S = 1500


def size_of_jpeg(data):
    """Returns width and height, from the first frame header."""
    at = 2
    while at + 9 < len(data):
        marker, length = data[at + 1], struct.unpack(">H", data[at + 2 : at + 4])[0]
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            height, width = struct.unpack(">HH", data[at + 5 : at + 9])
            return width, height
        at += 2 + length
    return 0, 0


def write_picture(path, data):
    """Writes a picture as PNG, which every viewer shows, or as it is where Pillow is missing. Returns its path."""
    try:
        from PIL import Image
    except ImportError:
        path = path.with_suffix(".jpg")
        path.write_bytes(data)
        return path
    path = path.with_suffix(".png")
    Image.open(io.BytesIO(data)).save(path)
    return path


class Endpoint(socketserver.ThreadingMixIn, http.server.HTTPServer):
    """An OpenAI-compatible endpoint whose replies are files."""

    daemon_threads = True

    def __init__(self, box):
        self.box, self.count = Path(box), itertools.count()
        self.box.mkdir(parents=True, exist_ok=True)
        super().__init__(("127.0.0.1", 0), Handler)
        threading.Thread(target=self.serve_forever, daemon=True).start()

    @property
    def url(self):
        return f"http://127.0.0.1:{self.server_port}/v1"


class Handler(http.server.BaseHTTPRequestHandler):
    def log_message(self, *_):
        pass

    def do_GET(self):
        self.answer(200, {"object": "list", "data": [{"id": "eyes", "object": "model"}]})

    def do_POST(self):
        body = json.loads(self.rfile.read(int(self.headers["content-length"])))
        folder = self.server.box / f"{next(self.server.count):04d}"
        folder.mkdir()
        lines, pictures, tokens = [], 0, 0
        for message in body["messages"]:
            parts = message["content"]
            lines.append(f"--- {message['role']} ---")
            for part in parts if isinstance(parts, list) else [{"type": "text", "text": parts}]:
                if part["type"] == "text":
                    lines.append(part["text"])
                    tokens += len(part["text"]) // 4
                    continue
                data = base64.b64decode(part["image_url"]["url"].split(",", 1)[1])
                pictures += 1
                width, height = size_of_jpeg(data)
                file = write_picture(folder / f"image_{pictures}", data)
                tokens += width * height // (28 * 28)
                lines.append(f"[Image {pictures}: {file.name}, {width} x {height}]")
        if body.get("response_format"):
            lines += ["--- the reply must follow this schema ---", json.dumps(body["response_format"])]
        (folder / "prompt.tmp").write_text("\n".join(lines))
        (folder / "prompt.tmp").rename(folder / "prompt.txt")
        reply, until = folder / "reply.txt", time.time() + WAIT_S
        while not reply.exists() and time.time() < until:
            time.sleep(0.3)
        if not reply.exists():
            return self.answer(503, {"error": {"message": "nobody has looked"}})
        text = reply.read_text()
        usage = {"prompt_tokens": tokens, "completion_tokens": len(text) // 4, "total_tokens": tokens + len(text) // 4}
        message = {"index": 0, "finish_reason": "stop", "message": {"role": "assistant", "content": text}}
        self.answer(200, {"id": folder.name, "object": "chat.completion", "created": 0, "model": "eyes", "choices": [message], "usage": usage})

    def answer(self, status, body):
        data = json.dumps(body).encode()
        self.send_response(status)
        self.send_header("content-type", "application/json")
        self.send_header("content-length", str(len(data)))
        self.end_headers()
        self.wfile.write(data)


def print_next(box):
    """Takes the next request and prints it."""
    until = time.time() + 400
    while time.time() < until:
        for folder in sorted(Path(box).glob("[0-9]*")):
            if not (folder / "prompt.txt").exists():
                continue
            try:
                (folder / "taken").mkdir()
            except FileExistsError:
                continue
            print((folder / "prompt.txt").read_text())
            print("\nPictures:", *sorted(map(str, folder.glob("image_*"))))
            print(f"Write the reply to {folder}/reply.tmp, then rename it to reply.txt")
            return
        if (Path(box) / "done").exists():
            print("ALL DONE")
            return
        time.sleep(0.5)
    print("NOTHING YET, ask again")


class Server:
    """A running service."""

    def __init__(self, program, data, arguments):
        self.log = open(f"{data}.log", "w")
        command = [program, "serve", "--listen", "127.0.0.1:0", "--data-dir", data, *arguments]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=self.log, text=True)
        for line in self.process.stdout:
            found = re.search(r"http://[0-9.:]+", line)
            if found:
                self.url = found.group(0)
                break
        else:
            raise SystemExit(f"the service did not start: see {data}.log")
        threading.Thread(target=self.process.stdout.read, daemon=True).start()

    def call(self, method, path, body=None, timeout_s=3 * WAIT_S):
        data = json.dumps(body).encode() if isinstance(body, dict) else body
        kind = "application/json" if isinstance(body, dict) else "application/zip"
        request = urllib.request.Request(self.url + path, data=data, method=method, headers={"content-type": kind} if data else {})
        try:
            with urllib.request.urlopen(request, timeout=timeout_s) as reply:
                return json.loads(reply.read())
        except urllib.error.HTTPError as error:
            return {"failed": error.code, "why": error.read().decode(errors="replace")}

    def stop(self):
        self.process.terminate()
        self.process.wait()


def box_of(box):
    """Returns the low and the high corner of a box in the API's form, or in that of annotations."""
    if "center" in box:
        return [[c + sign * s / 2 for c, s in zip(box["center"], box["size"])] for sign in (-1, 1)]
    return [box["min"], box["max"]]


def iou(a, b):
    """Returns the IoU of two boxes; 0 where one is missing."""
    if not a or not b:
        return 0.0
    (low_a, high_a), (low_b, high_b) = box_of(a), box_of(b)
    volume = lambda low, high: max(1e-9, (high[0] - low[0]) * (high[1] - low[1]) * (high[2] - low[2]))
    both = 1.0
    for i in range(3):
        side = min(high_a[i], high_b[i]) - max(low_a[i], low_b[i])
        if side <= 0:
            return 0.0
        both *= side
    return both / (volume(low_a, high_a) + volume(low_b, high_b) - both)


def sampled(room, count, seed):
    """Returns (kind, question, target or None): of every kind in turn."""
    truth = {o["id"]: o for o in json.loads(room.with_suffix(".scene.json").read_text())["objects"]}
    by_kind = {}
    for question in json.loads(room.with_suffix(".queries.json").read_text()):
        kind = question.get("kind") if question.get("target_id") is not None else "absent"
        by_kind.setdefault(kind, []).append(question)
    order = random.Random(seed)
    for questions in by_kind.values():
        order.shuffle(questions)
    picked = []
    while len(picked) < count and any(by_kind.values()):
        for kind in sorted(by_kind):
            if by_kind[kind] and len(picked) < count:
                question = by_kind[kind].pop()
                picked.append((kind, question["query"], truth.get(question.get("target_id"))))
    return picked


def asked(server, scene, room, evidence, kind, query, target):
    """Asks one question and returns its row."""
    question = {"query": query, "reasoner": "vlm", "evidence": evidence}
    answer = server.call("POST", f"/v1/scenes/{scene}/ground", question)
    known = server.call("GET", f"/v1/scenes/{scene}/instances?limit=1000&level=all").get("instances", [])
    notes = (answer.get("trace") or {}).get("corrections") or []
    return {
        "room": room,
        "evidence": evidence,
        "kind": kind,
        "query": query,
        "target": target and target["name"],
        "failed": answer.get("why"),
        "status": answer.get("status"),
        "confidence": answer.get("confidence"),
        "differs": answer.get("differs"),
        "left_out": (answer.get("trace") or {}).get("left_out"),
        "iou": iou(answer.get("box"), target),
        "shown": max([iou(c.get("box"), target) for c in answer.get("candidates") or []] or [0.0]),
        "any": max([iou(i.get("box"), target) for i in known] or [0.0]),
        "pointed": any("the model saw" in note for note in notes),
        "notes": notes,
        "calls": (answer.get("usage") or {}).get("vlm_calls", 0),
        "tokens": (answer.get("usage") or {}).get("prompt_tokens", 0),
        "evidence_ms": (answer.get("timings_ms") or {}).get("evidence"),
        "answer": answer.get("answer"),
        "answer_id": answer.get("id"),
    }


def describe(title, rows):
    wrong_of_it = [row for row in rows if row["kind"] == "false_premise"]
    present = [row for row in rows if row["target"] and row["kind"] != "false_premise"]
    absent = [row for row in rows if not row["target"]]
    share = lambda key, of=present: "/".join(f"{sum(row[key] >= at for row in of) / max(len(of), 1):.3f}" for at in (0.25, 0.5))
    pointed = [row for row in present if row["pointed"]]
    mean = lambda key: sum(row[key] or 0 for row in rows) / max(len(rows), 1)
    print(
        f"{title}: {len(present)} questions, in the scene {share('any')}, shown {share('shown')}, answer {share('iou')}; "
        f"pointed {len(pointed)}, right {sum(row['iou'] >= 0.25 for row in pointed)}; "
        f"denied {sum(row['status'] == 'no_match' for row in present)}; absent told {sum(row['status'] == 'no_match' or bool(row['differs']) for row in absent)} of {len(absent)}; "
        f"calls {mean('calls'):.2f}, prompt tokens {mean('tokens'):.0f}; failed {sum(bool(row['failed']) for row in rows)}"
    )
    grounded = [row for row in rows if row["status"] == "grounded" and row["kind"] != "false_premise"]
    print(f"    grounded {len(grounded)}, right {sum(row['iou'] >= 0.25 for row in grounded)}")
    if wrong_of_it:
        told = sum(bool(row["differs"]) and row["iou"] >= 0.25 for row in wrong_of_it)
        unnoticed = sum(row["status"] == "grounded" for row in wrong_of_it)
        print(f"    false premises {len(wrong_of_it)}, told {told}, not noticed {unnoticed}")
    if rows:
        print(f"    evidence p95 {sorted(row['evidence_ms'] or 0 for row in rows)[len(rows) * 95 // 100]:.0f} ms")


def run(args):
    endpoint = Endpoint(args.box)
    rooms = [Path(room) for room in args.rooms]
    with tempfile.TemporaryDirectory() as work:
        parsed = f"{work}/parsed"
        server = Server(args.program, parsed, ["--parse", "full-only", *args.serve_arg])
        scenes = {}
        for room in rooms:
            scene = server.call("POST", f"/v1/scenes?name={room.stem}", room.read_bytes())
            scenes[room.stem] = scene["scene"]["id"]
            while (status := server.call("GET", f"/v1/scenes/{scenes[room.stem]}").get("status")) not in ("ready", "failed"):
                time.sleep(1)
            print(f"{room.stem}: {status}", flush=True)
        server.stop()
        rows = []
        for evidence in args.evidence.split(","):
            data = f"{work}/{evidence}"
            shutil.copytree(parsed, data)
            server = Server(args.program, data, [*args.serve_arg, "--vlm-url", endpoint.url, "--vlm-model", "eyes", "--vlm-timeout-s", str(WAIT_S)])
            tasks = [(room.stem, *question) for room in rooms for question in sampled(room, args.questions, args.seed)]
            ask = lambda task: asked(server, scenes[task[0]], task[0], evidence, *task[1:])
            with concurrent.futures.ThreadPoolExecutor(args.parallel) as threads:
                rows += threads.map(ask, tasks)
            server.stop()
        (endpoint.box / "done").mkdir(exist_ok=True)
    Path(args.out).write_text(json.dumps(rows, indent=1))
    for evidence in args.evidence.split(","):
        of_mode = [row for row in rows if row["evidence"] == evidence]
        for room in rooms:
            describe(f"{evidence}, {room.stem}", [row for row in of_mode if row["room"] == room.stem])
        describe(f"{evidence}, all", of_mode)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    commands = parser.add_subparsers(required=True)
    looking = commands.add_parser("next", help="print the next request that nobody has taken")
    looking.add_argument("box")
    looking.set_defaults(run=lambda args: print_next(args.box))
    running = commands.add_parser("run", help="ask questions about annotated rooms")
    running.add_argument("--program", default="target/release/uniground")
    running.add_argument("--box", required=True)
    running.add_argument("--evidence", default="full,photographs")
    running.add_argument("--questions", type=int, default=16)
    running.add_argument("--seed", type=int, default=1)
    running.add_argument("--parallel", type=int, default=4)
    running.add_argument("--serve-arg", action="append", default=[])
    running.add_argument("--out", required=True)
    running.add_argument("rooms", nargs="+")
    running.set_defaults(run=run)
    args = parser.parse_args()
    args.run(args)


if __name__ == "__main__":
    sys.exit(main())
