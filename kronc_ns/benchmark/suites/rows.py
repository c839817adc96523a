"""A row of a suite: how one seed is measured, what is asked of all of them, and what they reach."""

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from functools import partial
from typing import Any, Literal

import numpy as np
from typing_extensions import assert_never

from kronc_ns.benchmark.figures import Figures, plain
from kronc_ns.errors import KroncError

Statistic = Literal["mean", "median", "worst", "total"]
"""What becomes of a figure of all seeds."""


def named(figure: str, statistic: Statistic) -> str:
    """What a statistic of a figure is called."""
    return figure if statistic in ("mean", "total") else f"{figure}_{statistic}"


def summary(values: Sequence[float], statistic: Statistic, large_is_bad: bool = True) -> float:
    """A statistic of the seeds' figures; NaN of none."""
    if not values:
        return math.nan
    match statistic:
        case "mean":
            return float(np.mean(values))
        case "median":
            return float(np.median(values))
        case "worst":
            return float(max(values) if large_is_bad else min(values))
        case "total":
            return float(sum(values))
        case _:
            assert_never(statistic)


@dataclass(frozen=True)
class Limit:
    """What is asked of a figure."""

    figure: str
    statistic: Statistic = "mean"
    at_most: float = math.inf
    at_least: float = -math.inf
    percent_of: str = ""
    """With this, the figure's total is asked as a percentage of this figure's total."""

    def __str__(self) -> str:
        least = f"{self.at_least:g} <= " if self.at_least > -math.inf else ""
        if self.at_most == math.inf:
            return f"{self.name} >= {self.at_least:g}"
        return f"{least}{self.name} <= {self.at_most:g}"

    @property
    def name(self) -> str:
        """Of what is reached."""
        return f"{self.figure}_percent" if self.percent_of else named(self.figure, self.statistic)

    def reached(self, seeds: Sequence[Figures]) -> float:
        """The statistic over the seeds that have the figure; one that could not be solved is infinitely bad."""
        large_is_bad = self.at_most < math.inf
        if self.percent_of:
            whole = sum(one.get(self.percent_of, 0.0) for one in seeds)
            return 100 * sum(one.get(self.figure, 0.0) for one in seeds) / whole if whole else math.nan
        bad = math.inf if large_is_bad else -math.inf
        values = [one.get(self.figure, bad) for one in seeds if self.figure in one or "failed" in one]
        return summary(values, self.statistic, large_is_bad)

    def holds(self, reached: float) -> bool:
        """Whether this is what was asked; NaN never is."""
        return self.at_least <= reached <= self.at_most


NONE_LOST = Limit("seeds_lost", "total", at_most=0.0)
"""Every seed is solved, and every view of it has a pose."""


@dataclass(frozen=True)
class Row:
    """A row before it is measured."""

    name: str
    note: str
    """The capture, its noise and the start: what the figures cannot be read without."""
    seeds: int
    """How many seeds the row asks for."""
    measure: Callable[[int], Figures]
    """Figures of one seed; `KroncError` where it cannot be solved."""
    limits: tuple[Limit, ...] = ()
    """What is asked; of a row without limits nothing is."""
    beside: Mapping[Statistic, tuple[str, ...]] = field(default_factory=dict)
    """Other figures to show, of the seeds that have them."""
    printed: Mapping[str, float] = field(default_factory=dict)
    """What somebody else has printed, to stand beside."""


@dataclass(frozen=True)
class Measured:
    """A row as measured."""

    name: str
    asked: str
    reached: Figures
    passed: bool | None
    """Whether `reached` is what was asked; None where nothing was."""
    seeds: tuple[int, ...]
    seconds: float
    note: str
    failures: Mapping[int, str]
    """Seeds that could not be solved, and why."""
    per_seed: tuple[Figures, ...]
    """Figures of every seed, in the order of `seeds`."""

    def as_dict(self) -> dict[str, Any]:
        """For JSON, which has no infinities: they become null."""
        return plain(asdict(self))


def measure_row(row: Row, seeds: Sequence[int], progress: Callable[[int, int], None] | None = None) -> Measured:
    """Measure all seeds of a row; a seed that raises `KroncError` is recorded as failed and counts against the row."""
    start = time.perf_counter()
    figures: list[Figures] = []
    failures: dict[int, str] = {}
    for i, seed in enumerate(seeds):
        try:
            found = row.measure(seed)
            figures.append({**found, "seeds_lost": float(found.get("registered", 1.0) < 1)})
        except KroncError as error:
            figures.append({"failed": 1.0, "seeds_lost": 1.0})
            failures[seed] = str(error)
        if progress is not None:
            progress(i + 1, len(seeds))
    reached = {limit.name: limit.reached(figures) for limit in row.limits}
    passed = all(limit.holds(reached[limit.name]) for limit in row.limits) if row.limits else None
    for statistic, names in row.beside.items():
        for name in names:
            if values := [one[name] for one in figures if name in one]:
                reached.setdefault(named(name, statistic), summary(values, statistic))
    reached |= {**row.printed, NONE_LOST.name: NONE_LOST.reached(figures)}
    return Measured(
        name=row.name,
        asked=", ".join(map(str, row.limits)),
        reached=reached,
        passed=passed,
        seeds=tuple(seeds),
        seconds=time.perf_counter() - start,
        note=row.note,
        failures=failures,
        per_seed=tuple(figures),
    )


def measure_rows(
    rows: Sequence[Row],
    first_seed: int = 0,
    seeds: int | None = None,
    progress: Callable[[str, int, int], None] | None = None,
    workers: int = 1,
) -> Iterator[Measured]:
    """Measure rows on report seeds ``first_seed``, ...; ``seeds`` overrides their number.

    They come in their order, one after the other; with several ``workers`` as many are measured at the same time.
    """

    def measure(row: Row) -> Measured:
        count = row.seeds if seeds is None else seeds
        report = None if progress is None else partial(progress, row.name)
        return measure_row(row, range(first_seed, first_seed + count), report)

    if workers == 1:  # in the thread that is the program's: others have other numbers of threads to compute with
        yield from map(measure, rows)
        return
    pool = ThreadPoolExecutor(workers)
    try:
        yield from pool.map(measure, rows)
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
