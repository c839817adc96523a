"""How solving uses the cores: many scenes side by side, or else the parts of one."""

import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import TypeVar

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")
_local = threading.local()


def side_by_side(function: Callable[[_Item], _Result], items: Sequence[_Item]) -> Iterator[_Result]:
    """``map`` on all cores, in the items' order; within it parts are run one after the other."""
    with ThreadPoolExecutor(os.cpu_count(), initializer=_stay_alone) as pool:
        yield from pool.map(function, items)


def in_parts(run: Callable[[int], None], parts: int) -> None:
    """``run(0)``, ``run(1)``, ... at the same time where there are cores: compiled loops, which need no interpreter."""
    if parts < 2 or getattr(_local, "alone", False) or (os.cpu_count() or 1) < 2:
        for part in range(parts):
            run(part)
        return
    others = [_helpers().submit(run, part) for part in range(1, parts)]
    run(0)
    for other in others:
        other.result()


@lru_cache(maxsize=1)
def _helpers() -> ThreadPoolExecutor:
    """Threads that wait for parts; made when first needed, since a start takes as long as a part."""
    return ThreadPoolExecutor((os.cpu_count() or 2) - 1, "kronc-part", _stay_alone)


def _stay_alone() -> None:
    """What runs in this thread is not split further: parts that wait for parts would leave nobody to run them."""
    _local.alone = True


if hasattr(os, "register_at_fork"):  # a child process has none of its parent's threads
    os.register_at_fork(after_in_child=_helpers.cache_clear)
