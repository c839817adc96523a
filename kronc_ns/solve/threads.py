"""How solving uses the cores: many scenes side by side, or else the parts of one."""

import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")
_local = threading.local()
_FEWEST = 64
"""With less to do, a second thread costs more than it saves."""


def side_by_side(function: Callable[[_Item], _Result], items: Sequence[_Item]) -> Iterator[_Result]:
    """``map`` on all cores, in the items' order; within it nothing is split into parts."""

    def alone(item: _Item) -> _Result:
        _local.alone = True
        return function(item)

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        yield from pool.map(alone, items)


def in_parts(run: Callable[[slice], None], count: int) -> None:
    """``run`` over slices of ``range(count)``, one for each core: for compiled loops, which need no interpreter."""
    cores = os.cpu_count() or 1
    if count < _FEWEST or cores < 2 or getattr(_local, "alone", False):
        run(slice(0, count))
        return
    size = -(-count // cores)
    with ThreadPoolExecutor(cores) as pool:
        for _ in pool.map(run, [slice(first, min(first + size, count)) for first in range(0, count, size)]):
            pass
