#!/usr/bin/env python3
"""Records the program's behavior and compares two recordings, for changes that must not alter it.

  scripts/behavior.py record PROGRAM OUT [--open FOLDER]
  scripts/behavior.py compare BEFORE AFTER

`record` runs PROGRAM without models or network (the steps below) and writes OUT: a JSON file for
each topic, with placeholders for ids, times, ports, paths and amounts, and OUT/data, the server's
data folder. At the end PROGRAM opens a copy of that, or of FOLDER, the `data` of an earlier
recording, to check that a new program reads what an old one wrote.
`compare` prints every difference and exits 1 if there is one. Text for people (details of
problems, messages, logs, standard error) is reported as "text" and does not count.

Steps are lines: `GET PATH PATH`, `POST PATH BODY BODY` (`@FILE` sends a file), `uniground WORDS |
WORDS`, `KEY SECRET` to send from then on, `# TOPIC`. $made is the last created object, $job the
last started job; `GET …/events` waits for its end.
"""

import contextlib
import hashlib
import http.client
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from string import Template

REPOSITORY = Path(__file__).resolve().parent.parent
ROOMS = REPOSITORY.parent / "shared/scenes"
QUESTIONS = 40  # most to ask in a room
PATIENCE_S = 1800
MOST_SHOWN = 30  # differences of one entry
NAMES = {"nobody": "00000000-0000-7000-8000-000000000000",
         "robot": '{"radius_m": 0.2, "height_m": 1.3, "eye_height_m": 1.2, "reach_m": 0.8}',
         "mcp": '"jsonrpc": "2.0", "id": 1, "method":'}
# Text for people: compared separately, because wording may change.
TEXTS = {"title", "detail", "message", "stderr", "log", "instructions", "summary", "description"}
# Fields that differ from run to run: numbers, and others.
VARYING = re.compile(r"(_ms|_s|seconds|elapsed|latency|_memory_mb)$|(^|(?<!checkpoints)_)bytes$")
ALWAYS_NEW = {"token", "machine", "day", "stamp", "blob_bytes", "last_used_at"}
UUID = re.compile(r"[0-9a-f]{8}-[0-9a-f]{4}-[0-9a-f]{4}-[0-9a-f]{4}-[0-9a-f]{12}")
KEY = re.compile(r"(ug_[0-9a-f]{8})(_[A-Za-z0-9_-]+)?")
REPLACED = [(re.compile(r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d[\d:.]*(Z| UTC|[+-]\d\d:\d\d)?"), "<time>"),
            (re.compile(r"(?<=127\.0\.0\.1):\d+"), ":<port>"),
            (re.compile(r"(?<=[?&]link=)[\w.]+"), "<signature>")]
PROGRESS = re.compile(r"^\s*\d+(\.\d+)? %")
DRAWN = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]|(?<=[─═ ])[─═ ]+")  # colors, and how wide tables are
AMOUNT = re.compile(r"\b(under )?\d+(\.\d+)? ?(ns|µs|ms|s|min|B|kB|KB|MB|GB)\b")

COMMANDS = """
# commands
uniground ground examples/living_room.zip 'the mug on the coffee table' | demo
uniground ground examples/living_room.zip 'the green fridge' --json
uniground demo --ask 'the red mug' --out asked
uniground import examples/living_room.zip --check | import examples/living_room.zip --check --json
uniground import examples/living_room.zip --report import-out --out import-out/scan.zip
uniground parse examples/living_room.zip --json --report parse-out
uniground eval examples --out eval-out | eval diff eval-out eval-out --json
uniground models list --json | completions bash | --version
uniground ground examples/none.zip x | parse | serve --listen nowhere
# openapi
uniground openapi
"""
UPLOAD = """
# scene-$room
POST /v1/scenes?name=$room @$archive
GET /v1/jobs/$job/events /v1/jobs/$job
"""
LOOK = """
GET $at $at/annotations $at/frames $at/changes?since=1 $at/report $at/report/instances.jpg
GET $at/instances?limit=1000 $at/instances?level=parts $at/instances?limit=3
GET $at/instances?limit=3&cursor=$t2 $at/instances/$t3 $at/instances/$t3/views/0.jpg
GET $at/instances/$t3/views/0.jpg?picture=crop $at/report/superpoints.jpg $at/report/frame-1.jpg
GET $at/graph $at/graph?level=all $at/graph?format=text $at/graph?format=graphml
GET $at/graph?around=$t3 $at/frames/1/photograph.jpg $at/frames/1/photograph.jpg?instances=true
GET $at/floor $at/floor.png $at/floor.png?height_m=1.3 $at/thumbnail.jpg
GET $at/cloud.ply $at/instances.ply $at/points.bin $at/embeddings.npy
GET $at/export?format=glb $at/export?format=ply $at/export?format=usdz $at/export?format=json
"""
SERVER = """
# questions-options
POST $at/ground {"query": "the stool", "top_k": 10, "direction_convention": "viewer"}
POST $at/ground {"query": "how many mugs are there?", "include": []}
POST $at/ground {"query": "the chair closest to me", "frame": "source", "min_confidence": 0.9,
    "observer": {"position": [0.0, -1.0, 1.5], "yaw_rad": 1.2}}
# answers
GET /v1/answers/$made /v1/answers/$made/prompt /v1/answers/$made/evidence/global.jpg
GET /v1/answers?scene_id=$scene&format=csv /v1/answers?scene_id=$scene&format=jsonl
GET /v1/answers?limit=3&status=grounded
# shortlist
POST $at/shortlist {"query": "the mug on the coffee table"} {"query": "the largest table"}
POST $at/shortlist {"query": "a green sofa", "top_k": 2} {"query": "the bathtub"}
POST $at/shortlist {"query": "the chair", "candidates": "fused", "calibrated": true}
# approach
POST $at/approach {"instance_id": $t3, "robot": $robot} {"instance_id": $t20, "robot": $robot}
POST $at/approach {"query": "the mug on the coffee table", "robot": $robot,
    "from": {"x": 1.43, "y": 0.16}} {"query": "the bathtub", "robot": $robot}
# find
POST /v1/ground {"query": "the red mug"} {"query": "a whiteboard", "scenes": ["$other"]}
POST /v1/links {"paths": ["$at/cloud.ply"]}
# corrections
POST $at/corrections {"kind": "rename", "instance_id": $t8, "name": "samovar"}
POST $at/corrections {"kind": "split", "instance_id": $whole} {"kind": "split", "instance_id": 999}
POST $at/corrections {"kind": "dismiss", "instance_ids": [$t9, $t10]}
GET $at/corrections $at/annotations $at/instances?limit=1000 $at/instances/$t9 $at/graph
GET $at/export?format=glb $at/export?format=ply $at/export?format=usdz $at/export?format=json
DELETE $at/corrections/$made
POST $at/corrections {"kind": "merge", "instance_ids": [$t11, $t12], "name": "stack"}
POST $at/ground {"query": "the samovar"} {"query": "the stack"}
GET $at/corrections $at/instances?limit=1000
# batch
POST /v1/batches {"label": "ten", "concurrency": 1, "defaults": {"scene_id": "$scene",
    "reasoner": "builtin"}, "items": [{"query": "the dining table"},{"query": "the door"},
    {"query": "where is the coffee table?", "top_k": 2},{"query": "the red sofa"},
    {"query": "the red mug"},{"query": "the bathtub"},{"query": "the largest table"},
    {"query": "the plant next to the door"},{"query": "x", "scene_id": "$nobody"},
    {"query": "x", "color": 1}]}
GET /v1/jobs/$job/events /v1/batches/$made /v1/batches/$made/results?from=8
GET /v1/batches/$made/results /v1/batches/$made/results?format=csv /v1/batches
GET /v1/answers?batch_id=$made
POST /v1/batches/$made/cancel
# growth
POST /v1/scenes/sample
GET /v1/jobs/$job/events $at/changes?to=$made $at/changes?to=$made&align=false $at/changes?to=$other
POST /v1/scenes/$made/parse {"settings": {"parsing": {"superpoints": {"voxel_m": 0.03}}}}
GET /v1/jobs/$job/events /v1/scenes/$made /v1/scenes/$made/instances?limit=1000
DELETE /v1/scenes/$made
POST $at/frames @examples/living_room.zip
GET /v1/jobs/$job/events
PATCH $at {"name": "front room", "labels": {"floor": "1"}, "map_frame_id": "map",
    "scene_to_map": {"rotation": [0.0, 0.0, 0.6, 0.8], "translation_m": [1.5, -2.0, 0.0]}}
POST $at/ground {"query": "the red sofa", "frame": "map"}
GET /v1/jobs/$job /v1/scenes?labels=floor%3D1 /v1/scenes?labels=floor%3D2
# errors
GET /v1/scenes/$nobody /v1/scenes/x /v1/nothing /nothing /v1/jobs/$nobody /v1/answers/$nobody
GET /v1/batches/$nobody $at/instances/9999 $at/export $at/export?format=doc /v1/scenes?limit=0
GET $at/changes?since=99 $at/graph?level=x /v1/scenes?cursor=x /v1/answers?since=yesterday
POST $at/ground {
POST $at/ground this is no JSON
POST $at/ground {"top_k": 1} {"query": ""} {"query": "x", "top_k": 0} {"query": "x", "y": 1}
POST $at/ground {"query": "the sofa", "reasoner": "vlm"}
POST $at/approach {"robot": {"radius_m": -1}}
POST $at/parse {"settings": {"parsing": {"speed": 1}}}
POST $at/names
POST /v1/scenes/import {"path": "/etc"}
POST /v1/scenes?name=text @questions.txt
PUT /v1/scenes {}
# mcp
POST /mcp {$mcp "initialize", "params": {"protocolVersion": "2025-06-18", "capabilities": {},
    "clientInfo": {"name": "test", "version": "1"}}} {$mcp "tools/list"} {$mcp "nothing"}
POST /mcp {$call "list_scenes", "arguments": {}}} {$call "list_objects", "arguments": {$in}}}
POST /mcp {$call "ground", "arguments": {"query": "the red sofa", $in}}}
POST /mcp {$call "get_object", "arguments": {"instance_id": $t3, $in}}}
POST /mcp {$call "render_view", "arguments": {"instance_id": $t3, $in}}}
# client
uniground scenes | scenes --json | key list --json | backup running --json
uniground ground --scene front 'the red sofa' | ground --scene nowhere 'the red sofa' --json
uniground ground --scene $scene 'the mug on the coffee table' --json
uniground find 'the red mug' | find 'the red mug' --json
uniground upload examples/living_room.zip --name client --json
uniground batch run questions.txt --scene $scene --out results.jsonl --concurrency 1 --json
# lists
GET /v1/jobs?limit=100 /v1/jobs?kind=parse&limit=2 /v1/answers?limit=100 /v1/scenes?limit=100
GET /v1/batches /v1/audit?limit=100 /v1/keys /v1/models /v1/stats /healthz /readyz /metrics / /docs
# scene-grown
"""
FOLDER = """
# folder
uniground doctor | doctor --json | doctor --repair --json | gc --dry-run --json | gc --json
uniground backup backup --json | restore backup --check --json
uniground restore backup --data-dir restored --json | doctor --data-dir restored --json
uniground migrate --from data --to moved --json | doctor --data-dir moved --json
uniground doctor --data-dir nowhere --json
"""
KEYS = """
# keys
POST /v1/scenes?name=large @questions.txt
POST /v1/keys {"name": "boss", "scope": "admin"}
GET /v1/keys /v1/scenes /healthz
KEY $secret
POST /v1/keys {"name": "old", "scope": "write", "expires_at": "2020-01-01T00:00:00Z"}
uniground key create client --scope write --json | key list --json
POST /v1/keys {"name": "robot", "scope": "read", "requests_per_minute": 60}
GET /v1/keys /v1/audit /v1/stats
DELETE /v1/keys/$nobody
KEY $secret
GET /v1/scenes /v1/keys /v1/audit
POST /v1/scenes/sample
KEY unknown
GET /v1/scenes
uniground scenes --json
"""
KEYS_AT_REST = """
uniground key create offline --data-dir keys --json | key list --data-dir keys --json
"""
OPENED = """
# opened
GET /readyz /v1/scenes?limit=100 /v1/answers?limit=100 /v1/batches /v1/jobs?limit=100
GET $at $at/instances?limit=1000 $at/corrections $at/graph $at/export?format=json
POST $at/ground {"query": "the lamp farthest from the door"}
"""


def parsed(text):
    try:
        value = json.loads(text)
    except ValueError:
        return None
    return value if isinstance(value, (dict, list)) else None


def without_descriptions(text):
    return json.loads(text, object_pairs_hook=lambda fields: {
        key: value for key, value in fields
        if not (key in ("description", "summary") and isinstance(value, str))})


def digest(content):
    return {"sha256": hashlib.sha256(content).hexdigest(), "size": len(content)}


class Normalizer:
    """Replaces values that differ between two runs of one program; ids are numbered in order of appearance."""

    def __init__(self, paths):
        self.paths, self.numbers = [(str(path), name) for path, name in paths], {}

    def number(self, kind, found):
        of_kind = self.numbers.setdefault(kind, {})
        return f"<{kind} {of_kind.setdefault(found, len(of_kind) + 1)}>"

    def text(self, text):
        for path, name in self.paths:
            text = text.replace(path, name)
        text = UUID.sub(lambda m: self.number("id", m[0]), text)
        text = KEY.sub(lambda m: self.number("key", m[1]) + ("_<secret>" if m[2] else ""), text)
        for pattern, name in REPLACED:
            text = pattern.sub(name, text)
        return text

    def lines(self, text):
        """Returns printed text without progress and without amounts of time and memory."""
        lines = [AMOUNT.sub("<amount>", DRAWN.sub("", self.text(line))).rstrip()
                 for line in text.splitlines() if not PROGRESS.match(line)]
        return [line for line in lines if line]

    def value(self, value, key="", varies=False):
        varies = varies or bool(VARYING.search(key))
        if key in ALWAYS_NEW or key == "next_cursor" and value is not None:
            return "<new>"
        if isinstance(value, dict):
            return {self.text(k): self.value(v, k, varies) for k, v in value.items()}
        if isinstance(value, list):
            return [self.value(item, key, varies) for item in value]
        if isinstance(value, str):
            if key == "content_hash":  # of a scene that has grown it comes from ids
                return self.number("hash", value)
            if value.startswith('{"') and parsed(value):
                return self.value(parsed(value))
            return digest(value.encode()) if len(value) > 5000 else self.text(value)
        return "<varies>" if varies and value is not None and value is not True else value

    def output(self, text):
        """Parses JSON output, as a whole or line by line; otherwise returns lines."""
        whole, lines = parsed(text), [parsed(line) for line in text.splitlines()]
        if whole is None and lines and None not in lines:
            whole = lines
        return self.lines(text) if whole is None else self.value(whole)

    def content(self, kind, content):
        """Returns the content of a reply or a file, by its type."""
        if "json" in kind or kind in ("text/plain", "application/graphml+xml"):
            return self.output(content.decode())
        if kind == "text/csv":
            rows = content.decode().splitlines()
            return {"header": rows[0], "rows": len(rows) - 1}
        if kind == "text/event-stream":
            return self.output(content.decode().strip().split("data: ")[-1])
        if "openmetrics" in kind:  # samples by name and labels, without values
            samples = [line for line in content.decode().splitlines() if line and line[0] != "#"]
            return sorted({re.sub(r'="[^"]*"|(?<=[\w}]) .*', "", sample) for sample in samples})
        return digest(content) if content else None


class Recording:
    """The program, its working folder, and its recorded behavior."""

    def __init__(self, program, out):
        self.program, self.out, self.topics, self.topic = program, out, {}, None
        self.work = Path(tempfile.mkdtemp(prefix="behavior-"))
        (self.work / "examples").symlink_to(REPOSITORY / "examples")
        (self.work / "models").mkdir()
        (self.work / "questions.txt").write_text("the red sofa\nthe door\nthe bathtub\n")
        self.environment = {k: v for k, v in os.environ.items() if not k.startswith("UNIGROUND_")}
        self.environment |= {"XDG_CACHE_HOME": f"{self.work}/cache", "UNIGROUND_DATA_DIR": "data",
                             "UNIGROUND_MASKS": "builtin", "UNIGROUND_ENCODER": "builtin"}
        self.begin_anew()

    def begin_anew(self):
        """Resets the numbering of ids for another data folder."""
        self.names = dict(NAMES)
        self.normal = Normalizer([(self.work, "<work>"), (self.out, "<out>"),
                                  (self.program, "uniground"), (REPOSITORY, "<repository>"),
                                  (Path(self.program).name, "uniground")])

    def note(self, label, entry, topic=None):
        entries = self.topics.setdefault(topic or self.topic, {})
        label = self.normal.text(label)
        again = sum(known.split(" (again ")[0] == label for known in entries)
        entries[f"{label} (again {again})" if again else label] = entry

    def play(self, steps):
        for step in steps.strip().replace("\n    ", " ").splitlines():
            step = Template(step).substitute(self.names)
            verb, _, rest = step.partition(" ")
            if verb == "#":
                self.topic = rest
                print(f"  {rest}", flush=True)
            elif verb == "KEY":
                self.environment["UNIGROUND_API_KEY"] = rest
            elif verb == "uniground":
                for command in rest.split(" | "):
                    self.run(shlex.split(command))
            elif verb == "GET":
                for path in rest.split():
                    self.call("GET", path)
            else:
                path, _, bodies = rest.partition(" ")
                for body in re.split(r"(?<=}) (?={)", bodies):
                    reply = self.call(verb, path, body)
                    made = reply.get("scene") or reply
                    if "progress" in made:
                        self.names["job"] = made["id"]
                    elif "id" in made:
                        self.names |= {"made": made["id"], "secret": made.get("secret"),
                                       "job": made.get("job_id")}

    def run(self, words):
        """Runs one command; if it writes a folder, records the files too."""
        done = subprocess.run([self.program, *words], cwd=self.work, env=self.environment,
                              capture_output=True, text=True, timeout=PATIENCE_S)
        entry = {"exit": done.returncode, "stderr": self.normal.lines(done.stderr)}
        if words == ["openapi"]:
            entry["stdout"] = without_descriptions(done.stdout)
        elif words[:2] != ["eval", "examples"]:  # its table has times; report.json tells the rest
            entry["stdout"] = self.normal.output(done.stdout)
        told = [after for word, after in zip(words, words[1:]) if word in ("--out", "--report")]
        for place in [self.work / word for word in told or ["demo-out"] * (words == ["demo"])]:
            for file in sorted(place.glob("*.*")) if place.is_dir() else [place]:
                if file.is_file() and file.suffix not in (".html", ".md"):
                    content = self.normal.content(file.suffix, file.read_bytes())
                    entry[f"file {file.name}"] = content
        self.note(f"uniground {shlex.join(words)}", entry)

    def send(self, method, path, body=None):
        """Sends one request and returns its response and content."""
        headers = {"accept": "application/json, text/event-stream"} if path == "/mcp" else {}
        if key := self.environment.get("UNIGROUND_API_KEY"):
            headers["authorization"] = f"Bearer {key}"
        if body:
            kind = "json" if body[0] == "{" else "zip" if "/scenes?" in path else "octet-stream"
            headers["content-type"] = f"application/{kind}"
            body = (self.work / body[1:]).read_bytes() if body[0] == "@" else body.encode()
        address = self.environment["UNIGROUND_SERVER"].split("//")[1]
        connection = http.client.HTTPConnection(address, timeout=PATIENCE_S)
        connection.request(method, path, body, headers)
        response = connection.getresponse()
        content = response.read()
        connection.close()
        return response, content

    def call(self, method, path, body=None):
        """Sends and records one request; returns the JSON of its reply, or {}."""
        response, content = self.send(method, path, body)
        kind = response.headers.get_content_type() if content else ""
        self.note(f"{method} {path} {body or ''}".strip(), {
            "status": response.status, "type": kind,
            "headers": sorted({name.lower() for name, _ in response.getheaders()}),
            "body": self.normal.content(kind, content)})
        reply = parsed(content.decode(errors="replace"))
        return reply if isinstance(reply, dict) else {}

    @contextlib.contextmanager
    def server(self, data, *flags):
        """Runs the program as a server on a data folder; commands meanwhile go to it."""
        command = [self.program, "serve", "--listen", "127.0.0.1:0", "--data-dir", data, *flags]
        log = self.work / f"{data}.log"
        with log.open("w") as file:
            process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=file, text=True,
                                       cwd=self.work, env=self.environment)
        try:
            address = process.stdout.readline().split() or sys.exit(log.read_text())
            self.environment["UNIGROUND_SERVER"] = address[-1]
            yield
        finally:
            process.terminate()
            exit_code = process.wait(120)
            lines = sorted(set(self.normal.lines(log.read_text())))
            self.note(log.name, {"exit": exit_code, "log": lines}, "servers")
            self.environment.pop("UNIGROUND_API_KEY", None)


def rooms():
    """Returns the archives: the sample room's, and those of the two smallest annotated rooms."""
    annotated = [file for file in ROOMS.glob("*.zip") if file.with_suffix(".queries.json").exists()]
    if not annotated:
        print(f"note: no annotated rooms in {ROOMS}: only the sample room is asked about")
    smallest = sorted(annotated, key=lambda file: file.stat().st_size)[:2]
    return [REPOSITORY / "examples/living_room.zip", *smallest]


def record_server(recording):
    """Records scenes, questions, and everything else. Returns what is read again after reopening."""
    names, asked, of_sample = recording.names, [], {}
    recording.play("# empty\nGET /v1/scenes /v1/jobs /v1/answers /v1/batches /v1/keys /v1/stats")
    for archive in rooms():
        names |= {"room": archive.stem, "archive": str(archive)}
        recording.play(UPLOAD)
        scene, at = names["made"], f"/v1/scenes/{names['made']}"
        found = recording.call("GET", f"{at}/instances?limit=1000&level=all")
        things = [each["id"] for each in found["instances"]
                  if each["level"] == "thing" and not each.get("structure")]
        names |= {"at": at} | {f"t{i}": thing for i, thing in enumerate(things)}
        names["whole"] = next(each["things"][0] for each in found["instances"]
                              if each["level"] == "part")
        recording.play(LOOK)
        recording.play(f"# questions-{archive.stem}")
        for entry in json.loads(archive.with_suffix(".queries.json").read_text())[:QUESTIONS]:
            question = json.dumps({"query": entry["query"]})
            asked.append(recording.call("POST", f"{at}/ground", question)["id"])
        of_sample = of_sample or names | {"scene": scene, "in": f'"scene_id": "{scene}"'}
    call = names["mcp"] + ' "tools/call", "params": {"name":'
    names |= of_sample | {"other": scene, "made": asked[0], "call": call}
    recording.play(SERVER)
    recording.play(LOOK)
    return {"scene": names["scene"], "answers": {path: recording.send("GET", path)[1].decode()
            for path in (f"/v1/answers/{asked[0]}", f"/v1/answers/{asked[-1]}")}}


def record_opened(recording, folder):
    """Records a copy of a folder that a server has left."""
    kept = json.loads((folder.parent / "kept.json").read_text())
    shutil.copytree(folder, recording.work / "opened")
    recording.begin_anew()
    recording.names["at"] = f"/v1/scenes/{kept['scene']}"
    with recording.server("opened"):
        recording.play(OPENED)
        for path, told in kept["answers"].items():
            same = recording.send("GET", path)[1].decode() == told
            recording.note(f"GET {path}, byte for byte", {"same": same})
    recording.play("uniground doctor --data-dir opened --json")


def record(program, out, folder):
    program, out = str(Path(program).resolve()), Path(out).resolve()
    out.mkdir(parents=True, exist_ok=True)
    if any(out.iterdir()):
        sys.exit(f"{out} is not empty")
    recording = Recording(program, out)
    try:
        recording.play(COMMANDS)
        recording.begin_anew()
        with recording.server("data"):
            kept = record_server(recording)
        shutil.copytree(recording.work / "data", out / "data")
        (out / "kept.json").write_text(json.dumps(kept, indent=1) + "\n")
        recording.play(FOLDER)
        recording.begin_anew()
        with recording.server("keys", "--max-upload-bytes", "9"):
            recording.play(KEYS)
        recording.play(KEYS_AT_REST)
        record_opened(recording, Path(folder).resolve() if folder else out / "data")
    finally:
        for topic, entries in recording.topics.items():
            text = json.dumps(entries, indent=1, sort_keys=True, ensure_ascii=False)
            (out / f"{topic}.json").write_text(text + "\n")
        shutil.rmtree(recording.work)
    print(f"{sum(map(len, recording.topics.values()))} entries in {len(recording.topics)} files")


def leaves(value, path=(), text=False):
    """Yields every single value with its path, and whether it is text for people."""
    if isinstance(value, dict) and value:
        for key, inner in value.items():
            for_people = text or key in TEXTS and not isinstance(inner, dict)
            yield from leaves(inner, (*path, key), for_people)
    elif isinstance(value, list) and value:
        for i, inner in enumerate(value):  # lines for people go by what they say, not by number
            yield from leaves(inner, (*path, inner if text else f"[{i}]"), text)
    else:
        yield path, (value, text)


def compare(before, after):
    files = {file.name for folder in (before, after) for file in Path(folder).glob("*.json")}
    counts, entries = {"difference": 0, "text": 0}, 0
    for name in sorted(files - {"kept.json"}):
        paths = [Path(folder, name) for folder in (before, after)]
        sides = [json.loads(path.read_text()) if path.exists() else {} for path in paths]
        for label in sorted({*sides[0], *sides[1]}):
            entries += 1
            old, new = (dict(leaves(side[label])) if label in side else {} for side in sides)
            different = [path for path in {**old, **new} if old.get(path) != new.get(path)]
            different = different if old and new else [()]
            for i, path in enumerate(different):
                pair = [side.get(path, ("<missing>" if side == {} or path else "<recorded>", False))
                        for side in (old, new)]
                kind = "text" if pair[0][1] or pair[1][1] else "difference"
                counts[kind] += 1
                if i == 0:
                    print(f"{name}: {label[:200]}")
                if i < MOST_SHOWN:
                    shown = [json.dumps(leaf, ensure_ascii=False)[:300] for leaf, _ in pair]
                    print(f"  {kind} at {'.'.join(path).replace('.[', '[')[:150] or 'the whole'}")
                    print(f"    before {shown[0]}\n    after  {shown[1]}")
            if len(different) > MOST_SHOWN:
                print(f"    … and {len(different) - MOST_SHOWN} more there")
    print(f"{entries} entries compared: {counts['difference']} differences, "
          f"{counts['text']} texts that differ")
    return counts["difference"] > 0 or entries == 0


match sys.argv[1:]:
    case ["record", program, out]:
        record(program, out, None)
    case ["record", program, out, "--open", folder]:
        record(program, out, folder)
    case ["compare", before, after]:
        sys.exit(compare(before, after))
    case _:
        sys.exit(__doc__)
