"""Time as it passes, and as processors spend it."""

import time
from collections.abc import Callable
from statistics import median
from typing import Any

Timed = Callable[[], float]
"""Runs something, and tells the seconds that it took."""
_TURNS = 5


def timed(run: Callable[[], Any]) -> Timed:
    """``run`` by the clock on the wall."""

    def seconds() -> float:
        start = time.perf_counter()
        run()
        return time.perf_counter() - start

    return seconds


def in_turns(*runs: Timed) -> list[float]:
    """Median seconds of each, warm.

    They take turns, so that a machine whose speed changes treats them alike; of two calls in a turn the second counts,
    so that none pays for what another leaves in the caches.
    """

    def second(run: Timed) -> float:
        run()
        return run()

    turns = [[second(run) for run in runs] for _ in range(_TURNS)]
    return [median(seconds) for seconds in zip(*turns, strict=True)]


def processor_seconds(run: Callable[[], Any]) -> float:
    """What all processors spend on the child processes that ``run`` starts and waits for (not on Windows)."""
    import resource

    def spent() -> float:
        usage = resource.getrusage(resource.RUSAGE_CHILDREN)
        return usage.ru_utime + usage.ru_stime

    before = spent()
    run()
    return spent() - before
