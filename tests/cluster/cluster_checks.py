"""Checks after the disturbances.

When is a question paid for twice? The model records each call with the process that made it. A question with a stored answer must never be asked
again. Before that, a call may be repeated if its process was killed, or frozen for longer than its lease, while the call was in progress or its answer
not yet in the database, because there is no transaction that includes the model. Each such call excuses one repetition. Every other repetition is paid
twice. Reported separately are calls that a frozen process starts after its lease has expired; a process that has noticed the loss and claims the job
again is not counted there.
"""
import collections
import json

from kill_checks import comparable
from wire import Connection, request_bytes
from workload import instances

# Final states of jobs and answers.
OVER = {"succeeded", "failed", "cancelled"}
# Time between an answer's row in the database and its commit.
COMMIT_S = 0.5


# How long after it was frozen a process may still act on a lost lease.
AWAKE_S = 5.0
KILLED, STOPPED = "killed", "stopped"
LATE, KEPT, NOTHING = "late", "kept", "nothing"


def repeated_calls(calls, disturbances, kept_at, lease_s, claims=(), batch_of=lambda question: None):
    """Returns repeated calls by reason: KILLED and STOPPED are excused; LATE, KEPT (the answer was stored) and NOTHING are not. `claims` lists for
    each batch the times at which a process claimed it."""
    by_question, told = collections.defaultdict(list), collections.defaultdict(list)
    for call in sorted(calls, key=lambda call: call.arrived):
        by_question[call.question, call.turn].append(call)
    paused = [one for one in disturbances if one.how == STOPPED and one.until - one.at >= lease_s]
    killed = [one for one in disturbances if one.how == KILLED]
    def has_taken_it_again(call, woke_at):
        """Returns whether this process has claimed the batch since then."""
        batch = batch_of(call.question)
        since = max((at for of, at in claims if of == batch and woke_at <= at <= call.arrived), default=None)
        return since is not None and all(other.life == call.life for other in calls if since < other.arrived <= call.arrived and batch_of(other.question) == batch)

    for (question, _), made in by_question.items():
        kept, reasons = kept_at.get(question, float("inf")), []
        for at, call in enumerate(made):
            is_late = any(one.who == call.life and one.until <= call.arrived < one.until + AWAKE_S and not has_taken_it_again(call, one.until)
                          for one in paused)
            if at and is_late:
                told[LATE].append(call)
                continue
            if at:
                why = reasons.pop(0) if reasons else NOTHING
                told[KEPT if call.arrived > kept + COMMIT_S else why].append(call)
            # The reasons for which a question may be asked again.
            under_way = lambda found: any(one.who == call.life and call.arrived <= one.at < kept for one in found)
            reasons += [KILLED] if under_way(killed) else [STOPPED] if under_way(paused) else [LATE] if is_late else []
    return told


def storm(table, fleet, database, crowd, model, items):
    """Checks the run with the database's records and the model's call records."""
    count = collections.Counter(one.how for one in fleet.disturbances)
    kinds = collections.Counter(f"{one.who.split('-')[0]} {one.how}" for one in fleet.disturbances)
    table.row("disturbances", ", ".join(f"{kind} {number}" for kind, number in sorted(kinds.items())), "both", len(count) == 2)
    table.row("unexpected responses", len(crowd.complaints), "0", not crowd.complaints)
    for complaint in crowd.complaints[:5]:
        table.note(complaint[:400])
    jobs(table, database, crowd)
    answers(table, database, items)
    kept_at = {row["query"]: float(row["at"]) for row in
               database.rows("SELECT change AS query, min(extract(epoch FROM at)) AS at FROM witness WHERE what = 'answer' GROUP BY change")}
    asked = {item["query"] for batch in items for item in batch}
    calls = [call for call in model.calls if call.question in asked]
    claims = [(row["subject"], float(row["at"])) for row in
              database.rows("SELECT subject, extract(epoch FROM at) AS at FROM witness JOIN jobs USING (id) WHERE what = 'job' AND change = 'queued running'")]
    batch_of = {item["query"]: crowd.batches[number] for number, batch in enumerate(items) for item in batch}
    told = repeated_calls(calls, fleet.disturbances, kept_at, fleet.lease_s, claims, batch_of.get)
    table.row("model calls", f"{len(calls)} for {len(asked)} questions", "one each or more", len({call.question for call in calls}) == len(asked))
    table.row("repeated: in progress when their process was killed", len(told[KILLED]), "for information")
    table.row("repeated: in progress when their process was frozen past its lease", len(told[STOPPED]), "for information")
    for why, what in ((LATE, "made again: begun by a process that had lost its lease, or because of that"), (KEPT, "made again after the answer was kept"),
                      (NOTHING, "made again for no reason")):
        # A process that was frozen may send one more prepared call before it notices that it lost its lease.
        most = sum(one.how == STOPPED for one in fleet.disturbances) // 4 if why == LATE else 0
        table.row(what, len(told[why]), f"at most {most}" if most else "0", len(told[why]) <= most)
        for call in told[why][:3]:
            same = [other for other in calls if (other.question, other.turn) == (call.question, call.turn)]
            others = ", ".join(f"{other.life} {other.arrived - call.arrived:+.3f}" for other in same)
            kept = kept_at.get(call.question, 0) - call.arrived
            table.note(f"{why}: {call.question!r}, turn {call.turn}, by {call.life}; calls, seconds from it: {others}; kept {kept:+.3f}")


def jobs(table, database, crowd):
    """Checks that every job finished once and stayed finished."""
    ends = collections.Counter()
    left = 0
    for row in database.rows("SELECT id, change FROM witness WHERE what = 'job'"):
        before, after = row["change"].split()
        ends[row["id"]] += after in OVER
        left += before in OVER
    stored = database.rows("SELECT id, kind, state, attempts, interruptions, error_code, error FROM jobs")
    kinds = collections.Counter((row["kind"], row["state"]) for row in stored)
    table.row("jobs", ", ".join(f"{kind} {state} {number}" for (kind, state), number in sorted(kinds.items())), "all succeeded",
              {state for _, state in kinds} == {"succeeded"})
    for row in stored:
        if row["state"] != "succeeded":
            table.note(f"job: {row}")
    table.equal("jobs that ended more than once, or never", sum(ends[row["id"]] != 1 for row in stored), 0)
    table.equal("jobs that went on after their end", left, 0)
    doubled = database.value("SELECT count(*) - count(DISTINCT subject) FROM jobs WHERE kind = 'parse'")
    table.equal("scenes with two parses, though one was asked for", int(doubled), 0)
    lost = set(crowd.uploads.values()) - {row["id"] for row in stored}
    table.equal("jobs that callers were told of, lost", len(lost), 0)
    taken_up = sum(int(row["attempts"]) > 1 for row in stored)
    table.row("jobs that were taken over", f"{taken_up}, at most {max(int(row['attempts']) for row in stored)} attempts", "some", taken_up > 0)


def answers(table, database, items):
    """Checks that every batch item was closed once, by one answer."""
    number = sum(len(batch) for batch in items)
    closed = collections.Counter(row["id"] for row in database.rows("SELECT id FROM witness WHERE what = 'item'"))
    table.row("items of batches", f"{len(closed)} closed, {sum(count > 1 for count in closed.values())} of them more than once",
              f"{number}, 0", (len(closed), set(closed.values())) == (number, {1}))
    failed = database.value("SELECT count(*) FROM batch_items WHERE status = 'failed'")
    table.equal("items that failed", int(failed), 0)
    made = collections.Counter(row["change"] for row in database.rows("SELECT change FROM witness WHERE what = 'answer'"))
    asked = {item["query"] for batch in items for item in batch}
    table.equal("questions of batches with several answers, or none", sum(made[query] != 1 for query in asked), 0)


def replicas(table, fleet, crowd, scenes, expected):
    """Checks that all APIs return the same, byte for byte, and the same as an undisturbed server."""
    connections = [Connection(address, 60) for address in fleet.addresses()]
    every = [*scenes, *crowd.uploads]
    paths = [f"/v1/scenes/{scene}{rest}" for scene in every for rest in ("", "/instances?limit=1000&level=all", "/graph", "/points.bin")]
    paths += [f"/v1/answers/{answer}" for answer in crowd.given] + [f"/v1/jobs/{job}" for job in crowd.uploads.values()]
    paths += [f"/v1/batches/{batch}{rest}" for batch in crowd.batches.values() for rest in ("", "/results", "/results?format=csv")]
    paths += [f"/v1/{kind}?limit=100" for kind in ("scenes", "jobs", "answers", "batches")]
    differ = []
    for path in paths:
        told = [connection.call("GET", path) for connection in connections]
        if {reply.status for reply in told} != {200} or len({reply.body for reply in told}) != 1:
            differ.append(f"{path}: {[(reply.status, len(reply.body)) for reply in told]}")
    table.row("equal at all APIs", f"{len(paths) - len(differ)} of {len(paths)} paths", "all", not differ)
    for difference in differ[:5]:
        table.note(difference)
    # Scenes without a parse were reported above.
    parsed = [scene for scene in every if connections[-1].call("GET", f"/v1/scenes/{scene}").json()["status"] == "ready"]
    table.equal("different parses of the same room", len({instances(connections[-1], scene) for scene in parsed}), 1)
    results = [connections[0].call("GET", f"/v1/batches/{batch}/results").body.splitlines() for _, batch in sorted(crowd.batches.items())]
    found, wanted = ([comparable(line) for batch in told for line in batch] for told in (results, expected))
    unlike = [pair for pair in zip(found, wanted) if pair[0] != pair[1]]
    table.equal("answers unlike those of one server that nobody disturbs", len(unlike) + abs(len(found) - len(wanted)), 0)
    for one, other in unlike[:2]:
        table.note(f"unlike: {json.dumps(one)[:600]}\n    {json.dumps(other)[:600]}")
    acknowledged(table, connections, crowd)
    gone = every[-1]
    connections[0].call("DELETE", f"/v1/scenes/{gone}")
    statuses = [connection.call("GET", f"/v1/scenes/{gone}").status for connection in connections]
    table.equal("a scene deleted at one API, at all of them", statuses, [404] * len(connections))


def acknowledged(table, connections, crowd):
    """Checks that single answers are stored as returned, and replayed by every API for the same key."""
    lost = sum(connection.call("GET", f"/v1/answers/{answer}").body != body for connection in connections for answer, (_, _, _, body) in crowd.given.items())
    table.row("single answers acknowledged", f"{len(crowd.given)}, lost or changed {lost}", "lost 0", lost == 0 and len(crowd.given) > 0)
    others = 0
    for answer, (path, asked, key, _) in list(crowd.given.items())[:10]:
        request = request_bytes("POST", path, json.dumps(asked).encode(), headers=[("idempotency-key", key)])
        replies = [connection.send(request) for connection in connections]
        others += sum(reply.status != 200 or reply.json()["id"] != answer for reply in replies)
    table.equal("the same key at every API: other answers", others, 0)


def ends(table, codes):
    """Checks how processes ended after SIGTERM."""
    table.row("exit codes after SIGTERM", ", ".join(f"{who} {code}" for who, code in codes.items()), "all 0", set(codes.values()) == {0})
