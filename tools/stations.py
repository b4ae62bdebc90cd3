"""A discrete simulation of queues: requests go from station to station, wait there for a server, and are served for a time drawn by lot.

Times are seconds. What happens depends on the figures and the seed alone. tools/scale.py says which stations uniground has.
"""
import heapq
import math
import random
from collections import deque
from dataclasses import dataclass
from functools import partial
from typing import Callable, Deque, Dict, List, Optional, Sequence, Tuple, Union

# The standard normal distribution's 99th percentile.
Z99 = 2.3263478740408408
# A queue that ends a window longer by no more than this has not grown.
SMALL_BACKLOG = 20


@dataclass(frozen=True)
class Lognormal:
    """A service time by what was measured of it: its median and its 99th percentile, seconds."""
    p50: float
    p99: float

    @property
    def sigma(self) -> float:
        return math.log(self.p99 / self.p50) / Z99

    @property
    def mean(self) -> float:
        return self.p50 * math.exp(self.sigma ** 2 / 2)

    def draw(self, dice: random.Random) -> float:
        return self.p50 * math.exp(self.sigma * dice.gauss(0.0, 1.0))


@dataclass(frozen=True)
class Exponential:
    """A time without memory: what the closed formulas of queues are about."""
    mean: float

    def draw(self, dice: random.Random) -> float:
        return dice.expovariate(1 / self.mean)


Time = Union[Lognormal, Exponential]
# Of a write: the writer knows how long that takes.
NO_TIME = Exponential(0.0)


@dataclass(frozen=True)
class Commit:
    """How long a transaction takes by the rows it writes: measured points, straight lines between them and beyond the last."""
    points: Tuple[Tuple[int, Lognormal], ...]

    def of(self, rows: int) -> Lognormal:
        after = next((i for i, (at, _) in enumerate(self.points) if at >= rows), len(self.points) - 1)
        (low, a), (high, b) = self.points[max(after, 1) - 1], self.points[max(after, 1)]
        share = (rows - low) / (high - low)
        return Lognormal(a.p50 + share * (b.p50 - a.p50), a.p99 + share * (b.p99 - a.p99))

    def seconds_a_row(self, together: int) -> float:
        """The least a row costs: in a full transaction."""
        return self.of(together).mean / together


@dataclass(frozen=True)
class Step:
    """One station on a request's way. `share` of the requests go there; where `rows` is set it is a write and `time` is not looked at."""
    station: str
    time: Time = NO_TIME
    share: float = 1.0
    # The work is cut in so many parts that are served side by side.
    strands: int = 1
    # Gives way to everything that is not low.
    low: bool = False
    rows: int = 0


@dataclass(frozen=True)
class Kind:
    """A kind of request: its way, and the place it holds from the first step to the last."""
    name: str
    steps: Tuple[Step, ...]
    place: Optional[str] = None


class Clock:
    """What is to happen, in order of time; what is at the same time in the order it was said."""

    def __init__(self) -> None:
        self.now = 0.0
        self.said = 0
        self.coming: List[Tuple[float, int, Callable[[], None]]] = []

    def after(self, seconds: float, what: Callable[[], None]) -> None:
        self.said += 1
        heapq.heappush(self.coming, (self.now + seconds, self.said, what))

    def run(self, until: float) -> None:
        while self.coming and self.coming[0][0] <= until:
            self.now, _, what = heapq.heappop(self.coming)
            what()
        self.now = until


class Meter:
    """How many were served and how many waited at a station, over the time since it was reset."""

    def __init__(self, clock: Clock, servers: int) -> None:
        self.clock, self.servers = clock, servers
        self.busy = self.waiting = 0
        self.reset()

    def reset(self) -> None:
        self.since = self.last = self.clock.now
        self.busy_s = self.waiting_s = 0.0
        self.began_waiting, self.arrived = self.waiting, 0

    def change(self, busy: int = 0, waiting: int = 0) -> None:
        self.tick()
        self.busy += busy
        self.waiting += waiting

    def tick(self) -> None:
        passed = self.clock.now - self.last
        self.busy_s += self.busy * passed
        self.waiting_s += self.waiting * passed
        self.last = self.clock.now

    def used(self) -> float:
        """Share of the servers' time that was used."""
        self.tick()
        return self.busy_s / (self.servers * max(self.last - self.since, 1e-12))

    def mean_waiting(self) -> float:
        self.tick()
        return self.waiting_s / max(self.last - self.since, 1e-12)

    def grew(self) -> bool:
        """Whether the queue is longer by more than a twentieth of those who came."""
        return self.waiting - self.began_waiting > max(SMALL_BACKLOG, 0.05 * self.arrived)


class Station:
    """Where requests are served, and wait for it."""
    meter: Meter

    def serve(self, step: Step, dice: random.Random, then: Callable[[], None]) -> None:
        raise NotImplementedError


class Places(Station):
    """So many places, taken in order of arrival and held until they are given back."""

    def __init__(self, clock: Clock, servers: int) -> None:
        self.clock, self.meter = clock, Meter(clock, servers)
        self.queue: Deque[Callable[[], None]] = deque()

    def take(self, then: Callable[[], None]) -> None:
        self.meter.arrived += 1
        if self.meter.busy < self.meter.servers:
            self.meter.change(busy=1)
            then()
        else:
            self.meter.change(waiting=1)
            self.queue.append(then)

    def give_back(self) -> None:
        if self.queue:
            self.meter.change(waiting=-1)
            self.queue.popleft()()
        else:
            self.meter.change(busy=-1)

    def serve(self, step: Step, dice: random.Random, then: Callable[[], None]) -> None:
        def done() -> None:
            self.give_back()
            then()
        seconds = step.time.draw(dice)
        self.take(lambda: self.clock.after(seconds, done))


class Cores(Station):
    """Processor cores that serve all in turns of a slice; low work runs where nothing else waits, and holds a core until its slice ends."""

    def __init__(self, clock: Clock, servers: int, slice_s: float) -> None:
        self.clock, self.slice_s, self.meter = clock, slice_s, Meter(clock, servers)
        self.ordinary: Deque[Tuple[float, Callable[[], None]]] = deque()
        self.low: Deque[Tuple[float, Callable[[], None]]] = deque()

    def serve(self, step: Step, dice: random.Random, then: Callable[[], None]) -> None:
        self.meter.arrived += 1
        left = step.strands

        def strand_done() -> None:
            nonlocal left
            left -= 1
            if left == 0:
                then()
        seconds = step.time.draw(dice) / step.strands
        for _ in range(step.strands):
            self.meter.change(waiting=1)
            (self.low if step.low else self.ordinary).append((seconds, strand_done))
        self.begin()

    def begin(self) -> None:
        while self.meter.busy < self.meter.servers and (self.ordinary or self.low):
            queue = self.ordinary or self.low
            seconds, then = queue.popleft()
            self.meter.change(busy=1, waiting=-1)
            self.clock.after(min(seconds, self.slice_s), partial(self.slice_over, queue, seconds, then))

    def slice_over(self, queue: Deque, seconds: float, then: Callable[[], None]) -> None:
        if seconds > self.slice_s:
            self.meter.change(busy=-1, waiting=1)
            queue.append((seconds - self.slice_s, then))
        else:
            self.meter.change(busy=-1)
            then()
        self.begin()


class Writers(Station):
    """Databases, each with one writer. Answers (writes of one row) that wait are written in one transaction, so many at most."""

    def __init__(self, clock: Clock, servers: int, commit: Commit, together: int) -> None:
        self.clock, self.commit, self.together, self.meter = clock, commit, together, Meter(clock, servers)
        self.queues: List[Deque[Tuple[int, Callable[[], None]]]] = [deque() for _ in range(servers)]
        self.writing = [False] * servers

    def serve(self, step: Step, dice: random.Random, then: Callable[[], None]) -> None:
        self.meter.arrived += 1
        self.meter.change(waiting=1)
        # A row belongs to a room, and a room to a database.
        writer = dice.randrange(len(self.queues)) if len(self.queues) > 1 else 0
        self.queues[writer].append((step.rows, then))
        if not self.writing[writer]:
            self.write(writer, dice)

    def write(self, writer: int, dice: random.Random) -> None:
        queue = self.queues[writer]
        batch = [queue.popleft()]
        while queue and batch[0][0] == queue[0][0] == 1 and len(batch) < self.together:
            batch.append(queue.popleft())
        self.writing[writer] = True
        self.meter.change(busy=1, waiting=-len(batch))

        def committed() -> None:
            self.writing[writer] = False
            self.meter.change(busy=-1)
            for _, then in batch:
                then()
            if queue and not self.writing[writer]:
                self.write(writer, dice)
        self.clock.after(self.commit.of(sum(rows for rows, _ in batch)).draw(dice), committed)


class Elsewhere(Station):
    """Time that passes somewhere without a limit: a caller who thinks."""

    def __init__(self, clock: Clock) -> None:
        self.clock, self.meter = clock, Meter(clock, 1)

    def serve(self, step: Step, dice: random.Random, then: Callable[[], None]) -> None:
        self.clock.after(step.time.draw(dice), then)


class Traffic:
    """Requests on their way, and how long those took that came and ended since the last reset."""

    def __init__(self, clock: Clock, stations: Dict[str, Station], dice: random.Random) -> None:
        self.clock, self.stations, self.dice = clock, stations, dice
        self.since = 0.0
        self.took: Dict[str, List[float]] = {}

    def reset(self) -> None:
        self.since, self.took = self.clock.now, {}
        for station in self.stations.values():
            station.meter.reset()

    def poisson(self, kind: Kind, per_s: float) -> None:
        """Requests that come one by one, whatever becomes of those before."""
        if per_s <= 0:
            return

        def come() -> None:
            self.send(kind, lambda: None)
            self.clock.after(self.dice.expovariate(per_s), come)
        self.clock.after(self.dice.expovariate(per_s), come)

    def client(self, kinds: Sequence[Kind], weights: Sequence[float], think_s: float) -> None:
        """Somebody who asks, waits for the end, thinks a while and asks again."""
        def ask() -> None:
            self.send(self.dice.choices(kinds, weights)[0], rest)

        def rest() -> None:
            self.clock.after(self.dice.expovariate(1 / think_s) if think_s else 0.0, ask)
        self.clock.after(self.dice.random() * think_s, ask)

    def send(self, kind: Kind, then: Callable[[], None]) -> None:
        came, place = self.clock.now, self.place_of(kind)
        steps = iter(kind.steps)

        def go_on() -> None:
            for step in steps:
                if step.share >= 1 or self.dice.random() < step.share:
                    self.stations[step.station].serve(step, self.dice, go_on)
                    return
            end()

        def end() -> None:
            if place:
                place.give_back()
            if came >= self.since:
                self.took.setdefault(kind.name, []).append(self.clock.now - came)
            then()
        if place:
            place.take(go_on)
        else:
            go_on()

    def place_of(self, kind: Kind) -> Optional[Places]:
        place = self.stations[kind.place] if kind.place else None
        assert place is None or isinstance(place, Places), f"a {kind.name} can not hold {kind.place}"
        return place


def percentile(values: Sequence[float], share: float) -> float:
    """NaN of nothing."""
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, int(len(ordered) * share))] if ordered else math.nan
