"""Checks after the kills.

When is an item paid for twice? The server returns an answer only after it is stored on the disk. So after every kill a copy of the database
tells which items have an answer. A question with a stored answer must never reach the model again, and within one life of the server no call
is made twice. A call in progress at a kill may be repeated. Two numbers are reported: calls with an incomplete reply, and calls whose complete
reply had been handed to the system but whose answer was not on the disk. The second kind cannot be avoided without a transaction that
includes the model; it is limited by the number of concurrent calls.

Answers must equal those of the undisturbed run, except for these fields: `id` and `scene_id` (different in every folder), `evidence`
and the `view` of candidates and alternatives (paths with these ids), `timings_ms`, and `latency_ms` of the calls in `trace`.
"""
import collections
import json

from records import Records
from wire import expect
from workload import instances

# US dollars of rounding error in sums of floats.
EPSILON_USD = 1e-6


def comparable(line):
    """Returns a line of results without the fields that differ between two runs."""
    result = json.loads(line)
    answer = result.get("answer") or {}
    for field in ("id", "scene_id", "evidence", "timings_ms"):
        answer.pop(field, None)
    for thing in (answer.get("candidates") or []) + (answer.get("alternatives") or []):
        thing.pop("view", None)
    for call in (answer.get("trace") or {}).get("calls", []):
        call.pop("latency_ms", None)
    return {"item": result["item"], "status": result["status"], "query": result["query"], "error": result.get("error"), "answer": answer}


def answers(lines):
    return [comparable(line) for line in lines]


class FinalState:
    """What the last server reports before it stops."""

    def __init__(self, server, batch, uploader, asker):
        connection = server.connection()
        self.exit_code = None
        self.followed = batch.followed
        self.batch = expect(connection.call("GET", f"/v1/batches/{batch.id}"), 200)
        self.results = connection.call("GET", f"/v1/batches/{batch.id}/results").body.splitlines()
        self.scenes, cursor = [], ""
        while cursor is not None:
            page = expect(connection.call("GET", f"/v1/scenes?limit=100{cursor and '&cursor=' + cursor}"), 200)
            self.scenes += page["scenes"]
            cursor = page["next_cursor"]
        by_id = {scene["id"]: scene for scene in self.scenes}
        self.lost_scenes = [name for name, scene in uploader.scenes.items() if scene not in by_id]
        self.parsed = [(by_id[scene]["parse_version"], instances(connection, scene)) for scene in uploader.scenes.values() if scene in by_id]
        self.lost_jobs = [job for job in uploader.jobs if connection.call("GET", f"/v1/jobs/{job}").status != 200]
        asked = [json.loads(line) for line in self.results]
        asked = [line["answer_id"] for line in asked if (line.get("answer") or {}).get("usage", {}).get("vlm_calls")]
        self.transcripts = len(asked)
        self.lost_transcripts = [id for id in asked if connection.call("GET", f"/v1/answers/{id}/prompt").status != 200]
        self.answers_given, self.not_stored = len(asker.given), asker.not_stored
        self.lost_answers = sum(connection.call("GET", f"/v1/answers/{id}").body != body for id, body in asker.given.items())


def under_way(storm, number_of):
    """Returns for every kill the questions that were asked but have no stored answer: those with an incomplete reply, and those whose reply was
    complete, with the time between delivery and kill."""
    by_life = collections.defaultdict(dict)
    for call in storm.model.calls:
        by_life[call.life][call.question] = call
    cut, unkept, most = [], [], 0
    for at, life in enumerate(storm.lives):
        lost = [call for question, call in by_life[at].items() if number_of[question] not in life.kept]
        whole = [call for call in lost if call.delivered is not None and call.delivered <= life.killed]
        cut += [call for call in lost if call not in whole]
        unkept += [life.killed - call.delivered for call in whole]
        most = max(most, len(lost))
    return cut, unkept, most


def paid_twice(storm, number_of):
    """Returns calls for a question whose answer was stored before an earlier kill; calls made twice within one life; and calls repeated for
    another reason."""
    kept_since = {}
    for at, life in enumerate(storm.lives):
        for item in life.kept:
            kept_since.setdefault(item, at)
    numbers = collections.Counter((call.question, call.turn, call.life) for call in storm.model.calls)
    after_kept = sum(call.life > kept_since.get(number_of[call.question], len(storm.lives)) for call in storm.model.calls)
    within = sum(count - 1 for count in numbers.values())
    again = len(storm.model.calls) - len({(call.question, call.turn) for call in storm.model.calls})
    return after_kept, within, again


def judge_batch_job(table, batch):
    """Checks that the batch's job continued after every kill. Interruptions count only while a job makes no progress."""
    table.row("batch delayed although it made progress", len(batch.put_off_wrongly), "0", not batch.put_off_wrongly)
    table.row("batch delays in total, and restarts by this script", batch.put_off, "for information")
    table.equal("batch paused though nobody asked for it", batch.paused, 0)
    for what in batch.put_off_wrongly[:3]:
        table.note(f"put off {what}")


def judge(table, storm, told, expected, parses, data, full):
    """Checks the batch, its cost, uploads and jobs."""
    number = len(storm.items)
    number_of = {item["query"]: at for at, item in enumerate(storm.items)}
    kinds = collections.Counter(life.moment for life in storm.lives)
    table.row("moments", ", ".join(f"{kind} {count}" for kind, count in sorted(kinds.items())))
    working = sum(0 < life.open_items < number for life in storm.lives)
    # A busy machine starts slowly: most of five kills can come before the batch runs.
    wanted, held = ("more than half", 2 * working > len(storm.lives)) if full else ("at least one", working > 0)
    table.row("kills while the batch was running", f"{working} of {len(storm.lives)}", wanted, held)

    table.row("the batch", f"{told.batch['state']}, {told.batch['done']} of {number} done",
              "succeeded", (told.batch["state"], told.batch["done"]) == ("succeeded", number))
    seen = collections.Counter(json.loads(line)["item"] for line in told.results)
    table.equal("items lost", number - len(seen), 0)
    with Records(data) as records:
        several = sum(count > 1 for query, count in records.answers_by_query().items() if query in number_of)
        failed = [job for job in records.jobs() if job["state"] == "failed"]
        open_jobs = [job for job in records.jobs() if job["state"] in ("queued", "running")]
        spent, left = records.spent_usd(), records.reserved_usd()
    table.equal("items doubled, in the results or among kept answers", sum(count - 1 for count in seen.values()) + several, 0)
    table.equal("items failed", told.batch["by_status"].get("failed", 0), 0)
    table.row("results followed through all servers", "the same, byte for byte" if told.followed == told.results else "others",
              "the same", told.followed == told.results)
    answered = answers(told.results)
    unlike = sum(a != b for a, b in zip(answered, expected)) + abs(len(answered) - len(expected))
    table.equal("answers unlike those of the undisturbed run", unlike, 0)
    for one, other in [(a, b) for a, b in zip(answered, expected) if a != b][:2]:
        table.note(f"unlike: {json.dumps(one)[:700]}\n    {json.dumps(other)[:700]}")

    cut, unkept, most = under_way(storm, number_of)
    after_kept, within, again = paid_twice(storm, number_of)
    table.equal("calls for an item whose answer was kept", after_kept, 0)
    table.equal("calls made twice within one life", within, 0)
    table.row("questions in progress at a kill: reply incomplete", len(cut), "for information")
    longest = f", the longest {max(unkept) * 1e3:.0f} ms before" if unkept else ""
    table.row("questions in progress at a kill: reply complete, not stored", f"{len(unkept)}{longest}", "for information")
    table.row("most in progress at one kill", most, "4 at most", most <= 4)
    table.row("repeated calls, all for these reasons", f"{again} of {len(storm.model.calls)}",
              f"{2 * (len(cut) + len(unkept))} at most", again <= 2 * (len(cut) + len(unkept)))

    # Money reserved at a kill counts as spent. Beyond that, the spent amount is at least the cost of the stored answers and at most the cost of all
    # calls.
    kept_usd = sum((json.loads(line).get("answer") or {}).get("usage", {}).get("cost_usd", 0.0) for line in told.results)
    every_usd = sum(call.cost_usd for call in storm.model.calls)
    settled = spent - sum(storm.reserved.values())
    held = kept_usd - EPSILON_USD <= settled <= every_usd + EPSILON_USD
    table.row("spent, without amounts reserved at kills, USD", f"{settled:.6f}", f"{kept_usd:.6f} to {every_usd:.6f}", held)
    table.row("reserved at kills, counted as spent, USD", f"{sum(storm.reserved.values()):.6f} in {len(storm.reserved)} calls")
    table.row("still reserved, USD", f"{left:.6f}", "0", left == 0)
    agrees = abs(told.batch["cost_usd"] - kept_usd) < EPSILON_USD
    table.row("cost reported by the batch, USD", f"{told.batch['cost_usd']:.6f}", f"{kept_usd:.6f}", agrees)

    names = collections.Counter(scene["name"] for scene in told.scenes)
    table.row("uploads", f"{len(told.parsed)} acknowledged, lost {len(told.lost_scenes)}, duplicated {sum(n - 1 for n in names.values())}",
              "lost 0, duplicated 0", not told.lost_scenes and max(names.values()) == 1)
    others = sum(found != parses[version > 1] for version, found in told.parsed)
    table.row("parses that differ from the undisturbed run", others, "0", others == 0)
    table.row("single answers acknowledged", f"{told.answers_given}, lost or changed {told.lost_answers}", "lost 0", told.lost_answers == 0)
    # The disk is not full, so there is no reason for this.
    table.equal("single answers given, but not kept", told.not_stored, 0)
    table.row("prompts of the batch's answers", f"{told.transcripts}, lost {len(told.lost_transcripts)}", "lost 0", not told.lost_transcripts)
    table.row("jobs", f"failed {len(failed)}, not over {len(open_jobs)}, lost {len(told.lost_jobs)}", "0, 0, 0",
              not failed and not open_jobs and not told.lost_jobs)
    for job in failed + open_jobs:
        table.note(f"job: {job}")
    table.row("unexpected answers and connections", len(storm.complaints), "0", not storm.complaints)
    for complaint in storm.complaints[:5]:
        table.note(f"should not be: {complaint[:400]}")
    table.equal("exit code of the last server", told.exit_code, 0)


def judge_folder(table, code, text):
    """Checks with the doctor that the stopped server's folder is intact. The last start has removed what kills left behind."""
    table.row("doctor", text.strip().splitlines()[-1][-60:], "whole", code == 0)
    if code:
        table.note(text[:2000])
