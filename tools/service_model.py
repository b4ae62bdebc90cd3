"""uniground as stations: what a question, a picture and a parse go through, with service times of scale.json.

Questions share the cores with parses, which give way; answers go to the database's one writer; a model's calls have places of their own.
"""
import json
import math
import random
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Dict, List, Optional, Tuple

from stations import Clock, Commit, Cores, Elsewhere, Kind, Lognormal, Places, Station, Step, Traffic, Writers, percentile

FIGURES = Path(__file__).resolve().with_name("scale.json")
SEED = 1
# A search ends at so many times what the work itself needs: more do not help.
MOST_TIMES = 64


class Figures:
    """What was measured or assumed."""

    def __init__(self, file: Path = FIGURES) -> None:
        self.raw = json.loads(file.read_text())

    def time(self, name: str) -> Lognormal:
        told = self.raw["times_ms"][name]
        return Lognormal(told["p50"] / 1e3, told["p99"] / 1e3)

    def commit(self) -> Commit:
        return Commit(tuple((at["rows"], Lognormal(at["p50"] / 1e3, at["p99"] / 1e3)) for at in self.raw["commit_ms"]["points"]))

    def number(self, name: str) -> float:
        return self.raw["numbers"][name]["value"]

    def together(self) -> int:
        return int(self.number("rows_together"))


@dataclass(frozen=True)
class Load:
    """What is asked of the service."""
    questions_per_s: float = 100.0
    # Of them, those a vision-language model decides.
    model_share: float = 0.0
    # Of these, those whose pictures have to be drawn.
    new_pictures: float = 1.0
    # Of all questions, those about a room that is not in memory.
    cold_share: float = 0.0
    pictures_per_s: float = 0.0
    # Questions about many rooms, and how many.
    finds_per_s: float = 0.0
    find_rooms: int = 100
    parses_per_hour: float = 0.0
    # Where the networks of a parse run: none, cores, gpu.
    networks: str = "none"


@dataclass(frozen=True)
class Size:
    """How many of everything there are."""
    cores: int = 2
    workers: int = 1
    gpus: int = 1
    databases: int = 1
    model_places: int = 8
    # Processes that look into many rooms, one question each at a time.
    finders: int = 1


KINDS = ("question", "model question", "picture", "find", "parse")


def sure(seconds: float) -> Lognormal:
    """A time that is always the same."""
    return Lognormal(seconds, seconds)


def kinds_of(figures: Figures, load: Load, size: Size) -> List[Tuple[Kind, float]]:
    """Every kind of request, with how many come in a second."""
    kept = Step("writers", rows=1)
    asked = Step("cores", figures.time("question"))
    read = Step("cores", figures.time("first_question"), share=load.cold_share)
    call = figures.time("model_call")
    model = (asked, read, Step("cores", figures.time("model_new"), share=load.new_pictures, strands=2),
             Step("cores", figures.time("model_again"), share=1 - load.new_pictures), Step("model", call),
             Step("model", call, share=figures.number("calls_second")), Step("model", call, share=figures.number("calls_third")), kept)
    with_model = load.questions_per_s * load.model_share
    return [(Kind("question", (asked, read, kept)), load.questions_per_s - with_model),
            (Kind("model question", model), with_model),
            (Kind("picture", (Step("cores", figures.time("picture")),)), load.pictures_per_s),
            (Kind("find", find_steps(figures, load), place="finders"), load.finds_per_s),
            (Kind("parse", parse_steps(figures, load.networks, size.cores), place="workers"), load.parses_per_hour / 3600)]


def find_steps(figures: Figures, load: Load) -> Tuple[Step, ...]:
    """Rooms that are asked about often are in memory; where there are more than fit, all are read anew."""
    one = figures.time("look_warm" if load.find_rooms <= figures.number("rooms_in_memory") else "look_cold")
    looks = sure(load.find_rooms * one.mean)
    return Step("cores", looks, strands=int(figures.number("looks_at_once"))), Step("writers", rows=1)


def parse_steps(figures: Figures, networks: str, cores: int) -> Tuple[Step, ...]:
    strands = min(cores, int(figures.number("parse_strands")))
    where = {"none": (), "gpu": (Step("gpus", figures.time("networks_gpu")),),
             "cores": (Step("cores", figures.time("networks_cores"), strands=strands, low=True),)}[networks]
    geometry = Step("cores", figures.time("parse"), strands=strands, low=True)
    return *where, geometry, Step("writers", rows=int(figures.number("parse_rows")))


def stations_of(figures: Figures, size: Size, clock: Clock) -> Dict[str, Station]:
    return {"cores": Cores(clock, size.cores, figures.number("slice_ms") / 1e3),
            "writers": Writers(clock, size.databases, figures.commit(), figures.together()),
            "model": Places(clock, size.model_places), "gpus": Places(clock, size.gpus),
            "workers": Places(clock, size.workers), "finders": Places(clock, size.finders)}


# What a size is called, and the station it is of.
STATIONS = {"cores": "cores", "workers": "workers", "gpus": "gpus", "databases": "writers", "model_places": "model", "finders": "finders"}


def at_work(figures: Figures, kinds: List[Tuple[Kind, float]]) -> Dict[str, float]:
    """How many servers of each station would be at work all the time."""
    found = dict.fromkeys(STATIONS.values(), 0.0)
    for kind, per_s in kinds:
        for step in kind.steps:
            # Writes share transactions: what counts is the least a row costs.
            seconds = step.rows * figures.commit().seconds_a_row(figures.together()) if step.rows else step.time.mean
            found[step.station] += per_s * step.share * seconds
            if kind.place:
                found[kind.place] += per_s * step.share * seconds / step.strands
    return found


def offered(figures: Figures, kinds: List[Tuple[Kind, float]], size: Size) -> Dict[str, float]:
    """Of each station's time, the share that is asked for: at 1 and more its queue grows without end, whatever the lot."""
    found = at_work(figures, kinds)
    return {station: found[station] / getattr(size, what) for what, station in STATIONS.items()}


@dataclass
class Outcome:
    """What came of a run: milliseconds of each kind, and each station's state."""
    took_ms: Dict[str, List[float]]
    # Share that was used, share that was asked for, mean number that waited, whether the queue grew.
    stations: Dict[str, Tuple[float, float, float, bool]]
    seconds: float

    def p99_ms(self, kind: str) -> float:
        return percentile(self.took_ms.get(kind, []), 0.99)

    def saturated(self) -> List[str]:
        return [name for name, (_, asked, _, grew) in self.stations.items() if grew or asked >= 1]

    def bottleneck(self) -> str:
        """What is asked for most. How much a writer is used says little: it takes what waits together."""
        return max(self.stations, key=lambda name: (self.stations[name][3], self.stations[name][1]))


def outcome(traffic: Traffic, clock: Clock, asked: Dict[str, float], warm_s: float, seconds: float) -> Outcome:
    """Lets it all run: a while to warm up, then what counts."""
    clock.run(warm_s)
    traffic.reset()
    clock.run(warm_s + seconds)
    told = {}
    for name, station in traffic.stations.items():
        meter = station.meter
        told[name] = (meter.used(), asked.get(name, 0.0), meter.mean_waiting(), meter.grew())
    return Outcome({kind: [took * 1e3 for took in all_of] for kind, all_of in traffic.took.items()}, told, seconds)


def simulate(figures: Figures, load: Load, size: Size, seconds: float, seed: int = SEED) -> Outcome:
    """Requests that come by chance, as many as the load says."""
    clock, kinds = Clock(), kinds_of(figures, load, size)
    traffic = Traffic(clock, stations_of(figures, size, clock), random.Random(seed))
    for kind, per_s in kinds:
        traffic.poisson(kind, per_s)
    return outcome(traffic, clock, offered(figures, kinds, size), seconds / 5, seconds)


def least(figures: Figures, load: Load, size: Size, what: str, kind: str, p99_ms: float, seconds: float) -> Optional[int]:
    """The fewest `what` with which that kind holds its promise and nothing is planned too full: doubled until they do, then halved
    between. `None` where no number does, because something else is in the way."""
    most_used = figures.number("most_used")

    def holds(number: int) -> bool:
        tried = replace(size, **{what: number})
        asked = offered(figures, kinds_of(figures, load, tried), tried)
        return max(asked.values()) <= most_used and simulate(figures, load, tried, seconds).p99_ms(kind) <= p99_ms

    needed = at_work(figures, kinds_of(figures, load, size))[STATIONS[what]]
    low, high = 0, max(1, math.ceil(needed / most_used))
    while not holds(high):
        low, high = high, high * 2
        if high > MOST_TIMES * max(1, needed):
            return None
    # Where the first number holds, fewer would be too full.
    while low and high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if holds(middle) else (middle, high)
    return high


def window_s(load: Load) -> float:
    """Long enough for ten thousand questions, for the slowest of them, and for a hundred parses where that is not too long."""
    of_questions = 10_000 / load.questions_per_s if load.questions_per_s else 60.0
    of_parses = 100 * 3600 / load.parses_per_hour if load.parses_per_hour else 0.0
    return max(of_questions, min(of_parses, 10 * of_questions), 120.0 if load.model_share else 0.5)


def soak(figures: Figures) -> Outcome:
    """The soak's traffic: clients who think, two of them with scans, on two cores that the generator uses too."""
    told, size, clock = figures.raw["soak"], Size(cores=2), Clock()
    after = Step("cores", sure(told["generator_ms"] / 1e3))
    stations = {**stations_of(figures, size, clock), "elsewhere": Elsewhere(clock)}
    ground, light = Step("cores", figures.time("question")), Step("cores", figures.time("light"))
    kinds = {"ground": Kind("ground", (ground, Step("writers", rows=1), after)), "light": Kind("light", (light, after)),
             "events": Kind("events", (light, Step("elsewhere", sure(told["events_ms"] / 1e3)), after)),
             "evidence": Kind("evidence", (Step("cores", figures.time("picture")), after))}
    traffic = Traffic(clock, stations, random.Random(SEED))
    for _ in range(told["clients"]):
        traffic.client([kinds[name] for name in told["shares"]], list(told["shares"].values()), told["think_ms"] / 1e3)
    for _ in range(2):
        traffic.client([Kind("parse", parse_steps(figures, "none", size.cores), place="workers")], [1], 0.0)
    return outcome(traffic, clock, {}, 10.0, 120.0)


def bare(figures: Figures) -> Outcome:
    """Connections that ask one question after the other."""
    told, clock = figures.raw["bare"], Clock()
    steps = (Step("cores", figures.time("question")), Step("writers", rows=1), Step("cores", sure(told["generator_ms"] / 1e3)))
    traffic = Traffic(clock, stations_of(figures, Size(cores=2), clock), random.Random(SEED))
    for _ in range(told["clients"]):
        traffic.client([Kind("ground", steps)], [1], 0.0)
    return outcome(traffic, clock, {}, 2.0, 40.0)


def check(figures: Figures) -> List[Tuple[str, float, float, float]]:
    """What was measured, what the simulation says, and the factor they may be apart."""
    told, mixed, alone = figures.raw, soak(figures), bare(figures)
    requests = sum(len(took) for kind, took in mixed.took_ms.items() if kind != "parse")
    ground, evidence = mixed.took_ms["ground"], mixed.took_ms["evidence"]
    measured, without = told["soak"]["measured"], told["bare"]["measured"]
    return [("bare: questions a second", without["per_s"], len(alone.took_ms["ground"]) / alone.seconds, 1.5),
            ("bare: p99, ms", without["ground_p99_ms"], alone.p99_ms("ground"), 2.0),
            ("mixed: requests a second", measured["per_s"], requests / mixed.seconds, 1.1),
            ("mixed: ground p50, ms", measured["ground_p50_ms"], percentile(ground, 0.5), 2.0),
            ("mixed: ground p99, ms", measured["ground_p99_ms"], percentile(ground, 0.99), 2.0),
            ("mixed: evidence p95, ms", measured["evidence_p95_ms"], percentile(evidence, 0.95), 2.0)]

