"""Writing files so that nobody finds a half-written one: into a temporary neighbour, then renamed into place."""

import json
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from kronc_ns.errors import KroncError


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """A temporary path beside ``path`` that replaces it on success and vanishes on any failure.

    Raises `KroncError` when the disk is full or the folder cannot be written.
    """
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.{threading.get_ident()}{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        raise KroncError(f"{path} cannot be written: {error.strerror or error}") from None
    finally:
        with suppress(OSError):  # where its folder could not be made
            temporary.unlink(missing_ok=True)


def cache_folder() -> Path:
    """``$KRONC_NS_CACHE``, else the user's cache folder."""
    chosen = os.environ.get("KRONC_NS_CACHE")
    return Path(chosen) if chosen else Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "kronc_ns"


def write_json(path: Path, content: Any) -> None:
    """Write JSON atomically, with NaN refused rather than written as something JSON does not know."""
    text = json.dumps(content, indent=1, allow_nan=False)
    with atomic_path(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        file.write(text + "\n")
        file.flush()
        os.fsync(file.fileno())
