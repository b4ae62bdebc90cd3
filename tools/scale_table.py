"""The tables of docs/SCALE.md: rooms by questions a second, on paper, from the figures of scale.json."""
import math
from dataclasses import dataclass
from typing import Dict, List

from service_model import STATIONS, Figures, Load, Size, at_work, kinds_of, simulate

ROOMS = (10 ** 3, 10 ** 5, 10 ** 7)
QUESTIONS_PER_S = (10, 1_000, 100_000)
HOURS_A_MONTH = 730
# So many questions are simulated for a cell at least and at most, and so long if that is between.
LEAST_SIMULATED, MOST_SIMULATED, SIMULATED_S = 4_000, 100_000, 20
# Parts that are told to be full.
TOLD_FULL = 3


@dataclass(frozen=True)
class Cell:
    """What so many rooms and questions take; whole things are planned to be used as far as `most_used` says."""
    figures: Figures
    rooms: int
    per_s: int

    @property
    def parses_per_hour(self) -> float:
        return self.rooms * self.figures.number("scans_a_month") / HOURS_A_MONTH

    @property
    def cold_share(self) -> float:
        """Rooms are asked about evenly: what is not in memory is read."""
        return max(0.0, 1 - self.figures.number("rooms_in_memory") / self.rooms)

    def load(self, cold_share: float, model_share: float = 0.0) -> Load:
        return Load(self.per_s, model_share, cold_share=cold_share, parses_per_hour=self.parses_per_hour, networks="gpu")

    def asked(self, load: Load) -> Dict[str, float]:
        """How many servers of each station would be at work all the time."""
        return at_work(self.figures, kinds_of(self.figures, load, Size()))

    def planned(self, busy: float) -> int:
        return max(1, math.ceil(busy / self.figures.number("most_used")))

    def size(self, load: Load) -> Size:
        """As many of everything as the work itself wants."""
        asked = self.asked(load)
        return Size(**{what: self.planned(asked[STATIONS[what]]) for what in STATIONS})

    def p99_ms(self, load: Load) -> float:
        """Of a question, simulated at that size."""
        return simulate(self.figures, load, self.size(load), self.window_s()).p99_ms("question")

    def window_s(self) -> float:
        return max(LEAST_SIMULATED, min(MOST_SIMULATED, SIMULATED_S * self.per_s)) / self.per_s

    def network_cores(self) -> int:
        """Cores that do what the GPUs would."""
        return self.planned(self.parses_per_hour / 3600 * self.figures.time("networks_cores").mean)

    def files_tb(self) -> float:
        return self.rooms * self.figures.number("room_files_mb") / 1e6

    def room_rows_tb(self) -> float:
        return self.rooms * self.figures.number("room_rows_mb") / 1e6

    def answers_tb(self) -> float:
        return self.kept_tb("answers_days", "answer_kb")

    def evidence_tb(self) -> float:
        return self.kept_tb("evidence_days", "evidence_kb")

    def kept_tb(self, days: str, kilobytes: str) -> float:
        return self.per_s * 86_400 * self.figures.number(days) * self.figures.number(kilobytes) / 1e9

    def reads_mb_per_s(self) -> float:
        """Rows of rooms that have to come from the disk: neither the process has the room nor the system the pages."""
        of = self.figures.number
        beyond = max(0.0, 1 - of("machine_memory_gb") / (1e3 * self.room_rows_tb()))
        return self.per_s * self.cold_share * beyond * of("room_rows_mb")

    def memory_gb(self) -> float:
        """All rooms in memory."""
        return self.rooms * self.figures.number("room_memory_mb") / 1e3

    def usd_per_thousand(self, cores: int, more_tb: float = 0.0) -> float:
        """Machines and disks, without a model's tokens. Networks run where it is cheaper."""
        of = self.figures.number
        gpus = self.planned(self.asked(self.load(0.0))["gpus"])
        networks = min(self.network_cores() * of("usd_core_hour"), gpus * of("usd_gpu_hour"))
        an_hour = cores * of("usd_core_hour") + networks + (self.stored_tb(0.0) + more_tb) * of("usd_tb_month") / HOURS_A_MONTH
        return an_hour / (self.per_s * 3.6)

    def usd_of_tokens(self, price: str) -> float:
        """A thousand questions' tokens, at the `low` or the `high` price."""
        of = self.figures.number
        calls = 1 + of("calls_second") + of("calls_third")
        return calls * (of("prompt_tokens") * of(f"usd_prompt_{price}") + of("completion_tokens") * of(f"usd_completion_{price}")) / 1e3

    def stored_tb(self, model_share: float) -> float:
        return self.files_tb() + self.room_rows_tb() + self.answers_tb() + model_share * self.evidence_tb()

    def first_full(self, model_share: float) -> str:
        """What one process on one large machine with default settings lacks, how many times over, worst first."""
        of, asked = self.figures.number, self.asked(self.load(self.cold_share, model_share))
        parts = {"cores": asked["cores"] / of("machine_cores"), "writer": asked["writers"], "parses": asked["workers"],
                 "disk": self.stored_tb(model_share) / of("machine_disk_tb"), "model": asked["model"] / of("model_places"),
                 "reads": self.reads_mb_per_s() / of("machine_reads_mb")}
        full = sorted((name for name, times in parts.items() if times > of("most_used")), key=lambda name: -parts[name])
        return ", ".join(f"{name} {short(parts[name])}x" for name in full[:TOLD_FULL]) or "nothing"


def short(value: float) -> str:
    """Two digits that count, without an exponent."""
    if value == 0:
        return "0"
    digits = 1 - math.floor(math.log10(abs(value)))
    return f"{round(value, digits):,.{max(0, digits)}f}"


def row(cells: List[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def heading(cells: List[str]) -> List[str]:
    return [row(cells), row(["---"] * len(cells))]


def by_rooms(figures: Figures) -> List[str]:
    """What is the same however much is asked."""
    lines = heading(["rooms", "parses/h", "GPUs, or cores in their place", "files, TB", "rows, TB", "all in memory, GB"])
    for rooms in ROOMS:
        cell = Cell(figures, rooms, QUESTIONS_PER_S[0])
        gpus = cell.planned(cell.asked(cell.load(0.0))["gpus"])
        lines.append(row([f"{rooms:,}", short(cell.parses_per_hour), f"{gpus}, or {cell.network_cores():,}", short(cell.files_tb()),
                          short(cell.room_rows_tb()), short(cell.memory_gb())]))
    return lines


def cells(figures: Figures) -> List[Cell]:
    return [Cell(figures, rooms, per_s) for rooms in ROOMS for per_s in QUESTIONS_PER_S]


def without_model(figures: Figures) -> List[str]:
    lines = heading(["rooms", "questions/s", "cores", "cores, all in memory", "p99, ms", "databases", "answers, TB", "USD", "full first"])
    for cell in cells(figures):
        now, kept = cell.size(cell.load(cell.cold_share)), cell.size(cell.load(0.0))
        p99_ms = cell.p99_ms(cell.load(cell.cold_share))
        lines.append(row([f"{cell.rooms:,}", f"{cell.per_s:,}", f"{now.cores:,}", f"{kept.cores:,}", f"{p99_ms:.0f}", f"{now.databases}",
                          short(cell.answers_tb()), short(cell.usd_per_thousand(now.cores)), cell.first_full(0.0)]))
    return lines


def with_model(figures: Figures) -> List[str]:
    lines = heading(["rooms", "questions/s", "cores", "calls at once", "evidence, TB", "USD, cheap", "USD, dear", "full first"])
    for cell in cells(figures):
        size = cell.size(cell.load(cell.cold_share, 1.0))
        machines = cell.usd_per_thousand(size.cores, cell.evidence_tb())
        lines.append(row([f"{cell.rooms:,}", f"{cell.per_s:,}", f"{size.cores:,}", f"{size.model_places:,}", short(cell.evidence_tb()),
                          *(short(machines + cell.usd_of_tokens(price)) for price in ("low", "high")), cell.first_full(1.0)]))
    return lines


def tables(figures: Figures) -> List[str]:
    return [*by_rooms(figures), "", *without_model(figures), "", *with_model(figures)]


def inputs(figures: Figures) -> List[str]:
    """The service times, with their sources."""
    lines = heading(["service time, ms", "p50", "p99", "of a", "source"])
    for told in figures.raw["times_ms"].values():
        lines.append(row([told["what"], f"{told['p50']:,}", f"{told['p99']:,}", told["kind"], told["source"]]))
    told = figures.raw["commit_ms"]
    p50, p99 = (", ".join(f"{at[of]:g}" for at in told["points"]) for of in ("p50", "p99"))
    return [*lines, row([told["what"], p50, p99, told["kind"], told["source"]])]
