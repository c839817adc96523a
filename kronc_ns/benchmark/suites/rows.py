"""A row of a table: what is asked, how one seed is measured, what the seeds amount to."""

import math
import os
import platform
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import numpy as np
import torch

from kronc_ns.errors import KroncError

Figures = Mapping[str, float]
"""What one seed gave, by name; units are suffixes of the names."""


OTHERS = ("best_", "adam_")
"""Beginnings of the names of figures that are not the solver's own."""


class Runs:
    """The figures of all seeds of a row; a seed that could not be solved counts as infinitely bad."""

    def __init__(self, figures: Sequence[Figures]) -> None:
        self.figures = figures

    def __getitem__(self, name: str) -> np.ndarray:
        """[seeds] one figure of every seed that has it; the solver's own are infinite where it failed."""
        own = not name.startswith(OTHERS)
        values = [one.get(name, math.inf) for one in self.figures if name in one or (own and "failed" in one)]
        return np.array(values, dtype=float)

    def median(self, name: str) -> float:
        """Median over the seeds."""
        return float(np.median(self[name])) if len(self[name]) else math.nan

    def mean(self, name: str) -> float:
        """Mean over the seeds."""
        return float(np.mean(self[name])) if len(self[name]) else math.nan

    def worst(self, name: str) -> float:
        """Largest value over the seeds."""
        return float(np.max(self[name])) if len(self[name]) else math.nan

    def total(self, name: str) -> float:
        """Sum over the seeds that were solved."""
        return float(sum(one.get(name, 0.0) for one in self.figures))

    @property
    def lost(self) -> int:
        """Seeds that could not be solved, or in which views are left without a pose."""
        return sum("failed" in one or one.get("registered", 1.0) < 1 for one in self.figures)


Judge = Callable[[Runs], tuple[Figures, bool | None]]
"""Figures to print, and whether they are what was asked (None: nothing was asked)."""


@dataclass(frozen=True)
class Task:
    """A row before it is measured."""

    name: str
    asked: str
    """The number to reach, in words."""
    note: str
    """The capture, its noise and the start: what the figures cannot be read without."""
    seeds: int
    """How many seeds the row asks for."""
    measure: Callable[[int], Figures]
    """Figures of one seed."""
    judge: Judge


@dataclass(frozen=True)
class Row:
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


def measure_row(task: Task, seeds: Sequence[int], progress: Callable[[int, int], None] | None = None) -> Row:
    """Measure all seeds of a row; a seed that raises `KroncError` is recorded as failed and counts against the row."""
    start = time.perf_counter()
    figures: list[Figures] = []
    failures: dict[int, str] = {}
    for i, seed in enumerate(seeds):
        try:
            figures.append(dict(task.measure(seed)))
        except KroncError as error:
            figures.append({"failed": 1.0})
            failures[seed] = str(error)
        if progress is not None:
            progress(i + 1, len(seeds))
    reached, passed = task.judge(Runs(figures))
    seconds = time.perf_counter() - start
    return Row(task.name, task.asked, reached, passed, tuple(seeds), seconds, task.note, failures, tuple(figures))


def measure_rows(
    tasks: Sequence[Task],
    first_seed: int = 0,
    seeds: int | None = None,
    progress: Callable[[str, int, int], None] | None = None,
    workers: int = 1,
) -> Iterator[Row]:
    """Measure rows on report seeds ``first_seed``, ...; ``seeds`` overrides their number.

    They come in their order, one after the other; with several ``workers`` as many are measured at the same time.
    """

    def measure(task: Task) -> Row:
        count = task.seeds if seeds is None else seeds
        report = None if progress is None else partial(progress, task.name)
        return measure_row(task, range(first_seed, first_seed + count), report)

    if workers == 1:  # in the thread that is the program's: others have other numbers of threads to compute with
        yield from map(measure, tasks)
        return
    pool = ThreadPoolExecutor(workers)
    try:
        yield from pool.map(measure, tasks)
    finally:
        pool.shutdown(wait=False, cancel_futures=True)


def hardware() -> dict[str, Any]:
    """The machine the figures were taken on, and how busy it was."""
    cpu = platform.processor() or platform.machine()
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as lines:
            cpu = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), cpu)
    except OSError:
        pass
    return {
        "cpu": cpu,
        "cores": os.cpu_count(),
        "torch_threads": torch.get_num_threads(),
        "load_1min": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        "torch": torch.__version__,
        "python": platform.python_version(),
    }


def plain(value: Any) -> Any:
    """Lists, dicts and numbers for JSON; what is not finite becomes None."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
