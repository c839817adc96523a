"""Functions compiled for the CPU. Importing this module imports numba (0.4 s)."""

import contextlib
from collections.abc import Callable
from typing import Any

import numba

# Without nnan and ninf: comparisons with NaN must stay false.
_FASTMATH = {"contract", "reassoc", "nsz", "arcp"}


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """``numba.njit``, kept on disk where numba finds a folder it may write to, else compiled in every process.

    Numba's cache notices changes of the function's own file only, so what a compiled function calls stands beside it.
    Not numba's own parallel loops: their threads fight with torch's for the cores when something else runs, and with
    GNU's OpenMP a fork after their first use ends the process. The functions release the interpreter lock instead.
    """
    # error_model: a division that may raise ends the vector instructions
    result = numba.njit(nogil=True, fastmath=_FASTMATH, error_model="numpy")(function)
    with contextlib.suppress(RuntimeError):  # neither __pycache__ nor the user's cache nor NUMBA_CACHE_DIR
        result.enable_caching()
    return result
