"""Functions compiled for the CPU, and formulas that compiled loops share with tensors.

Importing this module imports numba (0.15 s).
"""

import contextlib
import hashlib
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

import numba
from numba.core.caching import FunctionCache
from numba.extending import register_jitable

# Without nnan and ninf: comparisons with NaN must stay false.
_FASTMATH = {"contract", "reassoc", "nsz", "arcp"}
_PACKAGE = Path(__file__).resolve().parents[1]
_COMPILED_FOLDERS = ("solve", "refine", "plugin/splat_cpu")

formula: Callable[[Callable[..., Any]], Callable[..., Any]] = register_jitable
"""Marks plain arithmetic on components: compiled loops inline it, tensors broadcast over it."""


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """``numba.njit``, kept on disk where numba finds a folder it may write to, else compiled in every process.

    Not numba's own parallel loops: their threads fight with torch's for the cores when something else runs, and with
    GNU's OpenMP a fork after their first use ends the process. The functions release the interpreter lock instead.
    """
    return _kept(function, nogil=True)


def compiled_briefly(function: Callable[..., Any]) -> Callable[..., Any]:
    """`compiled` of what takes microseconds: to wait for the interpreter lock afterwards would take longer."""
    return _kept(function, nogil=False)


def _kept(function: Callable[..., Any], nogil: bool) -> Callable[..., Any]:
    # error_model: a division that may raise ends the vector instructions
    result: Any = numba.njit(nogil=nogil, fastmath=_FASTMATH, error_model="numpy")(function)
    with contextlib.suppress(RuntimeError):  # neither __pycache__ nor the user's cache nor NUMBA_CACHE_DIR
        result._cache = _StampedCache(function)
    return result


def is_compiled(function: Any) -> bool:
    """Whether a compiled function is ready, in this process or on disk, for the arguments it had before."""
    return bool(function.signatures) or (
        isinstance(function._cache, _StampedCache) and function._cache.holds_something()
    )


class _StampedCache(FunctionCache):
    """Numba's cache on disk, fresh as long as no compiled function of ours changes, wherever it stands.

    Numba's own notices changes of the function's file only, not of what it calls, and raises where files are garbage or
    cannot be written.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        self._cache_file._source_stamp = (self._cache_file._source_stamp, _sources())

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        try:
            return super().load_overload(sig, target_context)
        except Exception:  # garbage raises anything as it is unpickled
            self._clear()
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        if not self.holds_something():
            self._clear()  # the index is written first: were that all, it would pass old code off as new
        try:
            super().save_overload(sig, data)
        except Exception:  # a full disk, for one
            self._clear()

    def holds_something(self) -> bool:
        try:
            return bool(self._cache_file._load_index())
        except Exception:
            return False

    def _clear(self) -> None:
        for file in Path(self.cache_path).glob(f"{self._impl.filename_base}.*"):
            if file.suffix in (".nbi", ".nbc"):
                with contextlib.suppress(OSError):
                    file.unlink()


@lru_cache(maxsize=1)
def _sources() -> str:
    """Hash of all files that may hold compiled functions."""
    digest = hashlib.sha256()
    for folder in _COMPILED_FOLDERS:
        for file in sorted((_PACKAGE / folder).glob("*.py")):
            digest.update(file.name.encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()
