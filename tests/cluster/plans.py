"""Query plans of the processes' real statements on large tables: PostgreSQL explains each as it runs (auto_explain), and none may scan a large
table.
"""
import json
import re
import time
from collections import Counter

from callers import Caller
from fleet import Fleet
from wire import Connection, expect

# Rows added to each table; batches have this many items each, because a request for a batch reads all its items.
MANY, OF_A_BATCH = 100_000, 500
# A table with this many rows is large. A statement that reads more rows of it scans the table, whatever index it uses.
LARGE, MOST = 50_000, 5_000
# The maximum number of times that a statement may do so with a plan made while the table was small.
FEW = 5
ID = "'01900000-0000-7000-8000-' || lpad(to_hex(i), 12, '0')"
# Older than all existing rows, and similar to them.
FILL = f"""
INSERT INTO jobs (id, kind, subject, payload, state, progress, attempts, created_at, started_at, finished_at)
SELECT {ID}, kind, {ID}, payload, 'succeeded', 1, 1, created_at, started_at, finished_at
FROM generate_series(1, {MANY}) AS i, (SELECT * FROM jobs WHERE kind = 'parse' AND state = 'succeeded' LIMIT 1) AS like_this;
INSERT INTO scenes (id, name, content_hash, parse_id, parse_version, job_id, created_at, updated_at)
SELECT {ID}, 'room ' || i, content_hash, parse_id, 1, {ID}, created_at, updated_at
FROM generate_series(1, {MANY}) AS i, (SELECT * FROM scenes WHERE parse_id IS NOT NULL LIMIT 1) AS like_this;
INSERT INTO answers (id, scene_id, parse_id, body, created_at)
SELECT {ID}, scene_id, parse_id, body, created_at
FROM generate_series(1, {MANY}) AS i, (SELECT * FROM answers LIMIT 1) AS like_this;
INSERT INTO question_keys (key, request, answer_id, created_at)
SELECT 'key ' || i, request, {ID}, created_at FROM generate_series(1, {MANY}) AS i, (SELECT * FROM question_keys LIMIT 1) AS like_this;
INSERT INTO idempotency_keys (key, scene_id, created_at, request)
SELECT 'key ' || i, scene_id, created_at, request FROM generate_series(1, {MANY}) AS i, (SELECT * FROM idempotency_keys LIMIT 1) AS like_this;
INSERT INTO batches (id, state, items, job_id, created_at, finished_at)
SELECT {ID}, 'succeeded', {OF_A_BATCH}, {ID}, created_at, finished_at
FROM generate_series(1, {MANY // OF_A_BATCH}) AS i, (SELECT * FROM batches WHERE state = 'succeeded' LIMIT 1) AS like_this;
INSERT INTO batch_items (batch_id, item, scene_id, request, answer_id, status)
SELECT {ID.replace("to_hex(i)", f"to_hex(1 + (i - 1) / {OF_A_BATCH})")}, (i - 1) % {OF_A_BATCH}, scene_id, request, {ID}, 'grounded'
FROM generate_series(1, {MANY}) AS i, (SELECT * FROM batch_items WHERE status IS NOT NULL LIMIT 1) AS like_this;
INSERT INTO audit (id, at, method, path, status)
SELECT {ID}, at, method, path, status FROM generate_series(1, {MANY}) AS i, (SELECT * FROM audit LIMIT 1) AS like_this;
ANALYZE;
"""
EXPLAINED = ["session_preload_libraries = 'auto_explain'", "auto_explain.log_min_duration = 0", "auto_explain.log_analyze = on",
             "auto_explain.log_timing = off", "auto_explain.log_format = json", "auto_explain.log_nested_statements = on"]
# A block of the log: its lines after the first begin with a tab.
PLAN = re.compile(r"duration: [0-9.]+ ms  plan:\n((?:\t.*\n)+)")


def run(table, program, folder, database, model, scenes, scans, log, blobs, lease_s):
    """Fills the tables and adds the rows."""
    began = time.time()
    database.run(FILL)
    table.row("tables filled", f"{MANY} rows more in each of {FILL.count('INSERT INTO') - 1}, {time.time() - began:.0f} s")
    name = database.value("SELECT current_database()")
    large = {row["relname"] for row in database.rows(f"SELECT relname FROM pg_class WHERE relkind = 'r' AND reltuples >= {LARGE}")}
    for setting in EXPLAINED:
        database.run(f"ALTER DATABASE {name} SET {setting}")
    with Fleet(program, folder, database.address, model, lease_s, blobs).add(1, 1) as fleet:
        # Startup statements are not checked here.
        time.sleep(2)
        at = log.stat().st_size
        hot(Caller(fleet), fleet, scenes, scans)
        fleet.end()
    for setting in EXPLAINED:
        database.run(f"ALTER DATABASE {name} RESET {setting.split(' =')[0]}")
    with log.open(encoding="utf-8", errors="replace") as lines:
        lines.seek(at)
        judge(table, lines.read(), large)


def hot(caller, fleet, scenes, scans):
    """Sends frequent requests, often enough for PostgreSQL to use generic plans."""
    connection = Connection(fleet.addresses()[0], 60)
    get = lambda path: expect(connection.call("GET", path), 200)
    for at in range(12):
        scene = scenes[at % len(scenes)]
        answer = caller.json("POST", f"/v1/scenes/{scene}/ground", 200, body={"query": f"the {at}th chair", "reasoner": "builtin"}, key=f"hot-{at}")
        for path in (f"/v1/answers/{answer['id']}", f"/v1/answers?limit=20&scene_id={scene}", "/v1/answers?limit=20", "/v1/answers?limit=20&status=grounded",
                     "/v1/scenes?limit=20", f"/v1/scenes/{scene}", f"/v1/scenes/{scene}/instances?limit=50", "/v1/batches?limit=20", "/v1/jobs?limit=20",
                     "/v1/jobs?limit=20&kind=parse", "/v1/jobs?limit=20&state=queued", f"/v1/jobs?limit=20&subject={scene}"):
            get(path)
        connection.call("GET", "/readyz")
    items = "".join(json.dumps({"scene_id": scenes[0], "query": f"the {at}th lamp", "reasoner": "builtin"}) + "\n" for at in range(40)).encode()
    batch = caller.json("POST", "/v1/batches", 202, body=items, media_type="application/jsonl", key="hot")
    job = caller.upload(scans, "hot")
    assert caller.finished(job["job"]["id"])["state"] == "succeeded"
    assert caller.finished(batch["job_id"])["state"] == "succeeded"
    assert len(connection.call("GET", f"/v1/batches/{batch['id']}/results").body.splitlines()) == 40
    caller.json("POST", f"/v1/scenes/{job['scene']['id']}/parse", 202, body={})
    caller.call("PATCH", f"/v1/scenes/{job['scene']['id']}", body={"name": "renamed"})
    caller.call("DELETE", f"/v1/scenes/{job['scene']['id']}")


def judge(table, log, large):
    """Returns plan nodes on large tables that read too many rows, by statement."""
    plans = [json.loads(block) for block in PLAN.findall(log)]
    table.row("statements explained while they ran", len(plans), "hundreds", len(plans) > 300)
    bad, worst = Counter(), {}
    for plan in plans:
        for node in nodes(plan["Plan"]):
            seen = (node.get("Actual Rows", 0) + node.get("Rows Removed by Filter", 0)) * max(1, node.get("Actual Loops", 1))
            if node.get("Relation Name") in large and (node["Node Type"].endswith("Seq Scan") or seen > MOST):
                statement = " ".join(plan["Query Text"].split())
                bad[statement] += 1
                worst[statement] = max(worst.get(statement, (-1, "")), (seen, f"{node['Node Type']} over {node['Relation Name']}"))
    # A plan that a connection made while the table was small is used until the table's statistics are read again: a few times, then no more.
    table.equal("statements that look at a large table from end to end", sum(count > FEW for count in bad.values()), 0)
    for statement, count in bad.most_common(10):
        seen, what = worst[statement]
        table.note(f"{count} times {what}, up to {seen:.0f} rows: {statement[:400]}")


def nodes(plan):
    yield plan
    for part in plan.get("Plans", []):
        yield from nodes(part)
