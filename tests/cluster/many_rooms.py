#!/usr/bin/env python3
"""Thousands of rooms in one database: does a search over selected rooms find what a search over all rooms would find?

usage: many_rooms.py --program PROGRAM --database postgres://… --log FILE [--rooms N] [--scenes-per-room N] [--vectors N] [--questions N]
       [--onnxruntime-lib FILE]

The database is empty, has the extension pgvector available, and belongs to a server whose superuser the URL names; FILE is that server's log
(scripts/test-vectors.sh starts one). Rooms consist of a dozen objects of the sample room, under names with a frequency distribution as in homes; embeddings
are synthetic, around a center for each name. The server selects rooms if there are more than a thousand scenes; several scenes per room reach that
number with fewer rooms, which are indexed faster. Needs only Python's standard library and psql.
"""
import argparse
import json
import random
import re
import shutil
import sys
import tempfile
import time
from pathlib import Path

sys.dont_write_bytecode = True
sys.path.insert(1, str(Path(__file__).resolve().parents[1] / "soak"))

from scans import Scans
from server import Server
from sql import Database
from table import Table
from wire import expect

ROOT = Path(__file__).resolve().parents[2]
# The most common first.
NAMES = """chair, table, lamp, pillow, book, picture, curtain, cabinet, window, door, plant, box, shelf, rug, desk, bed, sofa, cup, bottle, bowl, plate,
monitor, keyboard, mouse, laptop, television, remote control, clock, vase, basket, bag, backpack, jacket, shoe, towel, blanket, mirror, stool, bench, armchair,
nightstand, dresser, wardrobe, bookcase, trash can, printer, telephone, speaker, radiator, fan, heater, refrigerator, oven, microwave, toaster, kettle,
coffee machine, blender, sink, faucet, toilet, bathtub, shower, washing machine, dryer, ironing board, iron, vacuum cleaner, broom, bucket, ladder, toolbox,
drill, hammer, bicycle, skateboard, helmet, ball, guitar, piano, violin, drum, trumpet, harp, teddy bear, doll, toy car, puzzle, chessboard, globe, telescope,
microscope, camera, tripod, easel, candle, candlestick, lantern, umbrella, suitcase, hat, glove, scarf, crib, high chair, rocking chair, bean bag, hammock,
aquarium, birdcage, dog bed, cat tree, sewing machine, loom, typewriter, gramophone, radio, jukebox, dartboard, pool table, treadmill, dumbbell, yoga mat,
punching bag, trophy, medal, flag, map, whiteboard, projector, filing cabinet, safe, shredder, scanner, server rack, router, cash register, mannequin,
wine rack, barrel, anvil, sword, shield, totem, sundial, weather vane, theremin, astrolabe""".replace("\n", " ").split(", ")
# Words in the vocabulary of the tests' tiny encoder.
KNOWN = ["chair", "table", "sofa", "lamp", "plant", "mug", "book", "box", "door", "window", "desk", "laptop", "clock"]
COLORS = ["", "", "", "red ", "blue ", "green ", "white ", "black ", "brown "]
# Objects per room, and the number of rooms that one question may name.
THINGS, NAMED = 12, 1000
ID = "'01900000-0000-7000-8000-' || lpad(to_hex(i), 12, '0')"


def fill(rooms, scenes_per_room):
    """Creates rooms of a dozen objects of the sample room under other names."""
    names = ", ".join(f"'{name}'" for name in NAMES)
    return f"""
SELECT setseed(0.5);
CREATE TABLE things AS SELECT row_number() OVER (ORDER BY id) AS k, body::jsonb - 'support' - 'views' - 'things' - 'level' AS body FROM instances
    WHERE body::jsonb ->> 'structure' IS NULL LIMIT {THINGS};
CREATE TABLE names AS SELECT row_number() OVER () AS n, name FROM unnest(ARRAY[{names}]) AS name;
INSERT INTO parses (id, content_hash, settings_hash, settings, models, import_report, parse_report, extent, created_at, record_version)
    SELECT {ID}, content_hash, 'room ' || i, settings, jsonb_set(models::jsonb, '{{encoder}}', '"none"')::text, import_report, parse_report, extent, created_at,
    record_version FROM (SELECT * FROM parses LIMIT 1) AS one, generate_series(1, {rooms}) AS i;
INSERT INTO instances (parse_id, id, body, record_version)
    SELECT {ID}, k, (body || jsonb_build_object('id', k, 'given_name', name))::text, 1
    FROM (SELECT i, k, body, 1 + floor({len(NAMES)} * power(random(), 2.5))::int AS n FROM generate_series(1, {rooms}) AS i, things) AS room JOIN names USING (n);
INSERT INTO scenes (id, name, content_hash, parse_id, parse_version, created_at, updated_at)
    SELECT {ID}, 'room ' || i, content_hash, {ID.replace("to_hex(i)", f"to_hex(1 + (i - 1) % {rooms})")}, 1, created_at, updated_at
    FROM (SELECT * FROM scenes LIMIT 1) AS one, generate_series(1, {rooms * scenes_per_room}) AS i;
ANALYZE;
"""


def fill_vectors(encoder, dim, rooms, most):
    """Creates an embedding of every object, near the center of its name."""
    noise = f"(SELECT array_agg(random() - 0.5) FROM generate_series(1, {dim}) WHERE n > 0)::vector({dim})"
    return f"""
SELECT setseed(0.25);
CREATE TABLE centers AS SELECT n, l2_normalize({noise}) AS center FROM names;
INSERT INTO instance_vectors (parse_id, encoder, embedding)
    SELECT parse_id, '{encoder}', l2_normalize(center + {noise}) FROM (SELECT {ID} AS parse_id, 1 + floor({len(NAMES)} * power(random(), 2.5))::int AS n
    FROM generate_series(1, {rooms}) AS i, generate_series(1, {max(1, most // rooms)})) AS seen JOIN centers USING (n);
ANALYZE instance_vectors;
"""


def asked(number):
    """Returns different questions."""
    dice, found = random.Random(4), []
    while len(found) < number:
        thing, other = dice.choice(COLORS) + dice.choice(NAMES), dice.choice(NAMES)
        question = f"the {thing}" if dice.random() < 0.5 else f"the {thing} next to the {other}"
        if question not in found:
            found.append(question)
    return found


def best(connection, question, scenes=None):
    """Returns status and belief of the best answer (0 for "not found"), whether rooms were selected among all, and the seconds it took."""
    start = time.time()
    body = {"query": question, "reasoner": "builtin", "top_k": 3, **({"scenes": scenes} if scenes else {})}
    told = expect(connection.call("POST", "/v1/ground", json.dumps(body).encode()), 200)
    rank = {"grounded": 3, "ambiguous": 2, "uncertain": 1, "no_match": 0}
    statuses = [(rank[answer["answer"]["status"]], answer["answer"]["confidence"]) for answer in told["answers"]]
    answers = [(status, round(confidence, 2) if status else 0) for status, confidence in statuses]
    return max(answers), told["narrowed"], time.time() - start


def by_names(table, connection, ids, questions):
    """Compares the best answer of the selected rooms with that of all rooms, which are asked a thousand at a time."""
    same, chosen, short, long, lost = 0, 0, [], [], []
    for question in questions:
        likely, narrowed, took = best(connection, question)
        every = [best(connection, question, ids[at:at + NAMED]) for at in range(0, len(ids), NAMED)]
        exact = max(found for found, _, _ in every)
        chosen += narrowed
        short.append(took)
        long.append(sum(took for _, _, took in every))
        same += likely >= exact
        if likely < exact:
            lost.append(f"{question}: {likely}, of all {exact}")
    table.equal("questions for which rooms were chosen", chosen, len(questions))
    table.row("answers as good as from all rooms", f"{same} of {len(questions)}", "90 % or more", same >= 0.9 * len(questions))
    table.row("median of a question, selected rooms and all rooms, s", f"{sorted(short)[len(short) // 2]:.2f}, {sorted(long)[len(long) // 2]:.2f}", "for information")
    for one in lost[:10]:
        table.note(one)


def by_looks(table, database, connection, log, words):
    """Compares the server's vector search statement with the same statement without the index."""
    at = log.stat().st_size
    database.run("ALTER SYSTEM SET log_min_duration_statement = 0")
    database.run("SELECT pg_reload_conf()")
    time.sleep(1)
    for word in words:
        best(connection, f"the {word}")
    database.run("ALTER SYSTEM RESET log_min_duration_statement")
    database.run("SELECT pg_reload_conf()")
    time.sleep(1)
    with log.open(encoding="utf-8", errors="replace") as lines:
        lines.seek(at)
        statements = re.findall(r"execute [^:]*: (SELECT parse_id, max\(cosine\).*?)\n[^\t\n]*DETAIL:  [Pp]arameters: ([^\n]*)", lines.read(), re.S)
    table.equal("statements that look for vectors, in the log", len(statements), len(words))
    found, wanted, took = 0, 0, []
    for statement, parameters in statements:
        for number, value in re.findall(r"\$(\d+) = '((?:[^']|'')*)'", parameters):
            statement = statement.replace(f"${number}", f"'{value}'")
        one, all_of_them = near(database, statement, "on"), near(database, statement, "off")
        found, wanted = found + len(one[0] & all_of_them[0]), wanted + len(all_of_them[0])
        took.append((one[1], all_of_them[1]))
    recall = found / max(1, wanted)
    table.row("nearest rooms found by the index", f"{found} of {wanted} ({recall:.3f})", ".95 or more", recall >= 0.95)
    middle = lambda at: sorted(pair[at] for pair in took)[len(took) // 2] if took else 0
    table.row("median of that statement, with the index and without, ms", f"{middle(0):.0f}, {middle(1):.0f}", "for information")


def near(database, statement, index):
    """Returns the rooms that a statement finds, and its milliseconds on the server."""
    settings = f"SET enable_indexscan = {index}; SET enable_seqscan = {'off' if index == 'on' else 'on'}; SET hnsw.ef_search = 1000; "
    rooms = {line.split(",")[0] for line in database.run(settings + statement, "--csv").splitlines()[1:]}
    plan = database.run(settings + "EXPLAIN (ANALYZE, TIMING OFF) " + statement)
    assert ("instance_vectors_" in plan.split("Index Scan using")[-1].split(" on ")[0]) == (index == "on"), plan
    return rooms, float(re.search(r"Execution Time: ([0-9.]+)", plan)[1])


def run(table, options, folder):
    database, scans = Database(options.database), Scans(6)
    bundles = ROOT / "crates/uniground-models/tests/data"
    # A draft would be a parse more than there are rooms.
    flags = ["--database", options.database, "--vectors", "pgvector", "--models", bundles, "--masks", "builtin", "--encoder", "tiny-dual-encoder",
             "--parse", "full-only", "--onnxruntime-lib", options.onnxruntime_lib]
    with Server(options.program.resolve(), folder / "data", folder / "log", *flags) as server:
        server.ready()
        connection = server.connection(600)
        made = expect(connection.call("POST", "/v1/scenes", scans.variant("first"), "application/zip"), 202)
        until(lambda: connection.call("GET", f"/v1/scenes/{made['scene']['id']}").json()["status"] == "ready")
        until(lambda: int(database.value("SELECT count(*) FROM instance_vectors")) > 0)
        start = time.time()
        database.run(fill(options.rooms, options.scenes_per_room))
        rooms = options.rooms + 1
        until(lambda: int(database.value("SELECT count(*) FROM parses WHERE indexed = changes")) == rooms)
        table.row("rooms indexed in the background", f"{rooms} in {time.time() - start:.0f} s", "all")
        seen = database.rows("SELECT encoder, vector_dims(embedding) AS dim FROM instance_vectors LIMIT 1")[0]
        start = time.time()
        database.run(fill_vectors(seen["encoder"], int(seen["dim"]), options.rooms, options.vectors))
        number = database.value("SELECT count(*) FROM instance_vectors")
        table.row("vectors", f"{number} of {seen['dim']} numbers, {time.time() - start:.0f} s", "for information")
        # The server rereads the set of names after ten seconds.
        time.sleep(11)
        ids = [row["id"] for row in database.rows("SELECT id FROM scenes ORDER BY id")]
        by_names(table, connection, ids, asked(options.questions))
        by_looks(table, database, connection, options.log, KNOWN)
        table.equal("exit code after SIGTERM", server.terminate(), 0)


def until(holds, most_s=600):
    end = time.time() + most_s
    while not holds():
        if time.time() > end:
            raise AssertionError(f"the condition was not reached within {most_s} s")
        time.sleep(0.5)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--program", required=True, type=Path, help="the binary under test")
    parser.add_argument("--database", required=True, help="an empty PostgreSQL database")
    parser.add_argument("--log", required=True, type=Path, help="the log of its server")
    parser.add_argument("--rooms", type=int, default=1300)
    parser.add_argument("--scenes-per-room", type=int, default=1)
    parser.add_argument("--vectors", type=int, default=8_000)
    parser.add_argument("--questions", type=int, default=20)
    parser.add_argument("--onnxruntime-lib", type=Path, default=ROOT / ".onnxruntime/libonnxruntime.so", help="ONNX Runtime's library")
    options = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="many-rooms-"))
    table = Table(f"{options.rooms} rooms, scenes of each {options.scenes_per_room}, {options.vectors} vectors, {options.questions} questions")
    try:
        run(table, options, folder)
    finally:
        table.print()
        shutil.rmtree(folder, ignore_errors=True)
    print("everything held" if not table.failed else "did not hold: " + "; ".join(table.failed))
    sys.exit(bool(table.failed))


if __name__ == "__main__":
    main()
