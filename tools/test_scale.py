#!/usr/bin/env python3
"""Checks the simulation of tools/scale.py: against closed formulas, against what was measured, and the page that has its tables.

usage: test_scale.py

Needs no server and no network; half a minute.
"""
import math
import random
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Callable, Dict, List, Sequence

import scale_table
from service_model import KINDS, Figures, Load, Size, check, least, simulate
from stations import Clock, Commit, Cores, Exponential, Kind, Lognormal, Places, Station, Step, Traffic, Writers, percentile

TOOLS = Path(__file__).resolve().parent
PAGE = TOOLS.parent / "docs" / "SCALE.md"
FIGURES = Figures()


def close(found: float, expected: float, share: float) -> None:
    assert abs(found - expected) <= share * expected, f"{found} is not within {share} of {expected}"


def one_station(make: Callable[[Clock], Station], step: Step, per_s: float, seconds: float, seed: int = 1) -> Traffic:
    """Requests that come by chance to a single station, after a while to warm up."""
    clock = Clock()
    traffic = Traffic(clock, {"station": make(clock)}, random.Random(seed))
    traffic.poisson(Kind("request", (step,)), per_s)
    clock.run(seconds / 5)
    traffic.reset()
    clock.run(seconds * 1.2)
    return traffic


def mean(values: Sequence[float]) -> float:
    return sum(values) / len(values)


def erlang_c(servers: int, busy: float) -> float:
    """The share of requests that wait where so many servers would be busy on the average (Erlang's second formula)."""
    no_wait = sum(busy ** k / math.factorial(k) for k in range(servers))
    wait = busy ** servers / math.factorial(servers) * servers / (servers - busy)
    return wait / (no_wait + wait)


def one_server_is_m_m_1() -> None:
    """Mean time in the station 1 / (mu - lambda), which is distributed exponentially; used lambda / mu."""
    traffic = one_station(lambda clock: Places(clock, 1), Step("station", Exponential(0.01)), 70, 4_000)
    took, meter = traffic.took["request"], traffic.stations["station"].meter
    close(mean(took), 1 / (100 - 70), 0.04)
    close(percentile(took, 0.99), math.log(100) / (100 - 70), 0.05)
    close(meter.used(), 0.7, 0.02)
    close(meter.mean_waiting(), 0.7 ** 2 / 0.3, 0.06)


def many_servers_are_m_m_c() -> None:
    """Places and cores alike, where no slice cuts the work: mean wait is C / (c mu - lambda)."""
    expected = 0.01 + erlang_c(8, 6.4) / (8 * 100 - 640)
    for make in (lambda clock: Places(clock, 8), lambda clock: Cores(clock, 8, 1e9)):
        traffic = one_station(make, Step("station", Exponential(0.01)), 640, 500)
        close(mean(traffic.took["request"]), expected, 0.03)
        close(traffic.stations["station"].meter.used(), 0.8, 0.02)


def small_slices_share_the_processor() -> None:
    """With slices far shorter than the work the mean is that of sharing, 1 / (mu - lambda), for any distribution of the work."""
    even = Step("station", Lognormal(0.01, 0.0100001))
    traffic = one_station(lambda clock: Cores(clock, 1, 0.0002), even, 60, 600)
    close(mean(traffic.took["request"]), 1 / (100 - 60), 0.06)


def low_work_gives_way() -> None:
    """Work without end beside questions costs each a slice at most."""
    clock = Clock()
    cores = Cores(clock, 2, 0.003)
    traffic = Traffic(clock, {"station": cores}, random.Random(1))
    cores.serve(Step("station", Lognormal(1e6, 1e6), strands=2, low=True), traffic.dice, lambda: None)
    traffic.poisson(Kind("question", (Step("station", Lognormal(0.001, 0.001)),)), 5)
    clock.run(200)
    # Two that come together have to share the core that is free first.
    assert percentile(traffic.took["question"], 0.99) < 0.0051 and max(traffic.took["question"]) > 0.002
    close(cores.meter.used(), 1.0, 0.001)


def a_lognormal_has_the_quantiles_it_was_given() -> None:
    told, dice = Lognormal(2.0, 9.0), random.Random(3)
    drawn = [told.draw(dice) for _ in range(100_000)]
    close(percentile(drawn, 0.5), 2.0, 0.02)
    close(percentile(drawn, 0.99), 9.0, 0.03)
    close(mean(drawn), told.mean, 0.02)


def answers_that_come_together_are_written_together() -> None:
    """A writer that does 100 transactions a second keeps 3,000 answers a second, and no transaction has more than it may have."""
    always = Lognormal(0.01, 0.01)
    commit = Commit(((1, always), (128, always)))
    for together, grows in ((128, False), (16, True)):
        make = partial(Writers, servers=1, commit=commit, together=together)
        traffic = one_station(make, Step("station", rows=1), 3_000, 5)
        assert traffic.stations["station"].meter.grew() == grows, together


def a_commit_lies_between_what_was_measured() -> None:
    commit = FIGURES.commit()
    assert commit.of(1).p50 < commit.of(8).p50 < commit.of(16).p50 < commit.of(265).p50
    assert commit.seconds_a_row(128) < commit.seconds_a_row(16) < commit.seconds_a_row(1)


def the_same_seed_gives_the_same() -> None:
    load = Load(200, model_share=0.1, cold_share=0.3, pictures_per_s=5, finds_per_s=1, parses_per_hour=1_200)
    size = Size(8, model_places=100)
    first, again, other = (simulate(FIGURES, load, size, 20, seed) for seed in (1, 1, 2))
    assert first.took_ms == again.took_ms and first.stations == again.stations
    assert first.took_ms != other.took_ms and set(first.took_ms) == set(KINDS)


def what_is_too_much_is_told() -> None:
    """Each station in turn, and which it is."""
    roomy = Size(64, 8, 8, 8, 1_000, 8)
    for load, size, full in ((Load(3_000), Size(2), "cores"), (Load(20_000), replace(roomy, databases=1), "writers"),
                             (Load(20, model_share=1.0), replace(roomy, model_places=8), "model"),
                             (Load(1, parses_per_hour=4_000), replace(roomy, workers=1), "workers"),
                             (Load(1, parses_per_hour=4_000, networks="gpu"), replace(roomy, workers=100, gpus=1), "gpus"),
                             (Load(1, finds_per_s=3, find_rooms=1_000), replace(roomy, finders=1), "finders")):
        came = simulate(FIGURES, load, size, 5)
        assert came.saturated() == [full] and came.bottleneck() == full, (full, came.stations)
        little = replace(load, questions_per_s=1, model_share=0.0, parses_per_hour=0, finds_per_s=0)
        assert not simulate(FIGURES, little, size, 5).saturated()


def the_fewest_hold_and_one_less_does_not() -> None:
    load = Load(2_000, cold_share=0.5)
    size = Size(databases=4)
    found = least(FIGURES, load, size, "cores", "question", 30, 5)
    assert found and simulate(FIGURES, load, replace(size, cores=found), 5).p99_ms("question") <= 30
    fewer = simulate(FIGURES, load, replace(size, cores=found - 1), 5)
    assert fewer.p99_ms("question") > 30 or fewer.stations["cores"][1] > FIGURES.number("most_used")
    # A call of the model takes seconds whatever there is.
    assert least(FIGURES, Load(5, model_share=1.0), Size(8), "model_places", "model question", 100, 60) is None


def lacking(lines: List[str]) -> List[str]:
    """Of these lines, those that are not in the page."""
    page = PAGE.read_text().splitlines()
    return [line for line in lines if line not in page]


def what_was_measured_comes_out() -> None:
    """Within a factor of two for the p99 of a question in mixed traffic; the factors of the others stand beside them."""
    rows = check(FIGURES)
    assert all(1 / factor <= simulated / measured <= factor for _, measured, simulated, factor in rows), rows
    told = run("--check")
    assert "FAILED" not in told and lacking([line.rstrip() for line in told.splitlines()]) == [], told


def the_paper_and_the_simulation_agree() -> None:
    """Planned to be 80 % used, everything is used as much as that at most, and what is asked for is what is used."""
    cell = scale_table.Cell(FIGURES, 100_000, 1_000)
    load = cell.load(cell.cold_share)
    used, asked = simulate(FIGURES, load, cell.size(load), 20).stations["cores"][:2]
    assert used <= FIGURES.number("most_used")
    close(used, asked, 0.05)


def every_figure_has_a_source() -> None:
    told: Dict[str, Dict] = {**FIGURES.raw["times_ms"], **FIGURES.raw["numbers"], "commit": FIGURES.raw["commit_ms"]}
    assert all(figure["source"] and figure["what"] for figure in told.values())


def the_page_has_the_tables_of_now() -> None:
    missing = lacking(scale_table.inputs(FIGURES) + scale_table.tables(FIGURES))
    assert not missing, "docs/SCALE.md lacks:\n" + "\n".join(missing)


def the_commands_of_the_page_run() -> None:
    commands = [line for line in PAGE.read_text().splitlines() if line.startswith("python3 tools/scale.py")]
    assert len(commands) >= 4, commands
    for command in commands:
        words = command.split("#")[0].split()[2:]
        if "--table" not in words:
            assert run(*words).strip(), command


def run(*words: str) -> str:
    done = subprocess.run([sys.executable, str(TOOLS / "scale.py"), *words], capture_output=True, text=True, cwd=TOOLS.parent)
    assert done.returncode == 0, f"{words}: {done.stdout}{done.stderr}"
    return done.stdout


def main() -> None:
    checks = [one_server_is_m_m_1, many_servers_are_m_m_c, small_slices_share_the_processor, low_work_gives_way,
              a_lognormal_has_the_quantiles_it_was_given, answers_that_come_together_are_written_together,
              a_commit_lies_between_what_was_measured, the_same_seed_gives_the_same, what_is_too_much_is_told,
              the_fewest_hold_and_one_less_does_not, what_was_measured_comes_out, the_paper_and_the_simulation_agree,
              every_figure_has_a_source, the_page_has_the_tables_of_now, the_commands_of_the_page_run]
    for one in checks:
        one()
        print(f"{one.__name__.replace('_', ' ')}: well")


if __name__ == "__main__":
    main()
