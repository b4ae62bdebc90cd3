"""Parses an hour with one worker and with two, on the machine as it is."""
from callers import Caller
from fleet import Fleet


def run(table, program, folder, database, model, scans, blobs, lease_s, number):
    """The rows of it: from the first parse begun to the last one ended, as the database has it."""
    rates = []
    for workers in (1, 2):
        with Fleet(program, folder, database.address, model, lease_s, blobs).add(1, workers) as fleet:
            caller = Caller(fleet)
            jobs = [caller.upload(scans, f"throughput-{workers}-{at}")["job"]["id"] for at in range(number)]
            for job in jobs:
                caller.finished(job)
            fleet.end()
        listed = ", ".join(f"'{job}'" for job in jobs)
        took = database.value(f"SELECT extract(epoch FROM max(finished_at::timestamptz) - min(started_at::timestamptz)) FROM jobs WHERE id IN ({listed})")
        rates.append(number / float(took))
    table.row(f"parses of {number} scans, by one and by two workers", f"{rates[0] * 3600:.0f} and {rates[1] * 3600:.0f} an hour, {rates[1] / rates[0]:.2f} times",
              "told only")
