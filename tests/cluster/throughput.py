"""Parses per hour with one worker and with two, alternately, on the current machine."""
from callers import Caller
from fleet import Fleet


def run(table, program, folder, database, model, scans, blobs, lease_s, number, rounds):
    """Adds the rows. The best of several rounds counts, because other load only makes a round longer."""
    rates = {1: [], 2: []}
    for at in range(rounds):
        for workers in rates:
            with Fleet(program, folder, database.address, model, lease_s, blobs).add(1, workers) as fleet:
                rates[workers].append(parses_an_hour(database, fleet, scans, f"throughput-{workers}-{at}", number))
                fleet.end()
    listed = ", ".join(f"{one:.0f} and {two:.0f}" for one, two in zip(*rates.values()))
    table.row(f"parses per hour of {number} scans, with one worker and with two", f"{listed}; the best {max(rates[2]) / max(rates[1]):.2f} times", "for information")


def parses_an_hour(database, fleet, scans, name, number):
    """Returns the rate from the first started parse to the last finished one, as recorded by the database."""
    caller = Caller(fleet)
    jobs = [caller.upload(scans, f"{name}-{at}")["job"]["id"] for at in range(number)]
    for job in jobs:
        caller.finished(job)
    listed = ", ".join(f"'{job}'" for job in jobs)
    took_s = database.value(f"SELECT extract(epoch FROM max(finished_at::timestamptz) - min(started_at::timestamptz)) FROM jobs WHERE id IN ({listed})")
    return number / float(took_s) * 3600
