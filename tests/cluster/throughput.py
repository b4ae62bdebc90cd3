"""Parses an hour with one worker and with two, in turns, on the machine as it is."""
from callers import Caller
from fleet import Fleet


def run(table, program, folder, database, model, scans, blobs, lease_s, number, rounds):
    """The rows of it. Of several rounds the best counts: what else is at work on the machine only makes them longer."""
    rates = {1: [], 2: []}
    for at in range(rounds):
        for workers in rates:
            with Fleet(program, folder, database.address, model, lease_s, blobs).add(1, workers) as fleet:
                rates[workers].append(parses_an_hour(database, fleet, scans, f"throughput-{workers}-{at}", number))
                fleet.end()
    listed = ", ".join(f"{one:.0f} and {two:.0f}" for one, two in zip(*rates.values()))
    table.row(f"parses an hour of {number} scans, by one worker and by two", f"{listed}; the best {max(rates[2]) / max(rates[1]):.2f} times", "told only")


def parses_an_hour(database, fleet, scans, name, number):
    """From the first parse begun to the last one ended, as the database has it."""
    caller = Caller(fleet)
    jobs = [caller.upload(scans, f"{name}-{at}")["job"]["id"] for at in range(number)]
    for job in jobs:
        caller.finished(job)
    listed = ", ".join(f"'{job}'" for job in jobs)
    took_s = database.value(f"SELECT extract(epoch FROM max(finished_at::timestamptz) - min(started_at::timestamptz)) FROM jobs WHERE id IN ({listed})")
    return number / float(took_s) * 3600
