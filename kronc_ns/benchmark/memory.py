"""Peak memory of a piece of work, as the operating system counts it."""

import ctypes
import gc
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

Result = TypeVar("Result")

_PROCESS = Path("/proc/self")


def with_peak(run: Callable[[], Result]) -> tuple[Result, float]:
    """What ``run`` returns, and the megabytes by which it raised this process' resident memory at its peak.

    NaN where the system does not tell (only Linux does).
    """
    if sys.platform != "linux":
        return run(), math.nan
    gc.collect()
    library = ctypes.CDLL(None)
    if hasattr(library, "malloc_trim"):
        library.malloc_trim(0)  # the allocator would otherwise hand out memory that was freed before, unseen
    try:
        (_PROCESS / "clear_refs").write_text("5")  # the peak starts from now
    except OSError:
        return run(), math.nan
    before = _resident("VmRSS")
    result = run()
    return result, _resident("VmHWM") - before


def _resident(field: str) -> float:
    """A field of this process' status in megabytes."""
    lines = (_PROCESS / "status").read_text().splitlines()
    return next(int(line.split()[1]) / 1024 for line in lines if line.startswith(field))
