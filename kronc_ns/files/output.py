"""Output folders and the files in them, written so that nobody finds a half-written one.

A file is written into a temporary neighbour and renamed into place. A folder is claimed with a marker file before
anything is written and released with kronc.json as the last file, so that an interrupted run is never taken for a
result and somebody else's folder is never touched.
"""

import json
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Literal

from kronc_ns.errors import KroncError

MARKER = ".kronc-incomplete"
"""Present in an output folder from the first byte until kronc.json is written."""
REPORT_FILE = "report.html"
_REPORT_MARK = '<meta name="generator" content="kronc_ns'


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


def write_json(path: Path, content: Any) -> None:
    """Write JSON atomically, with NaN refused rather than written as something JSON does not know.

    A line for each entry of the whole, and of each list in it: as legible, and ten times as fast as an indent.
    """
    if isinstance(content, dict):
        text = "{\n" + ",\n".join(f"{json.dumps(str(key))}: {_rows(value)}" for key, value in content.items()) + "\n}"
    else:
        text = _rows(content)
    with atomic_path(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        file.write(text + "\n")
        file.flush()
        os.fsync(file.fileno())


def _rows(content: Any) -> str:
    """JSON, a list of lists or objects with a line for each."""
    if isinstance(content, (list, tuple)) and any(isinstance(value, (dict, list)) for value in content):
        return "[\n" + ",\n".join(json.dumps(value, allow_nan=False) for value in content) + "\n]"
    return json.dumps(content, allow_nan=False)


def read_json(path: Path) -> Any:
    """Parsed JSON, or an error that names the file and the place in it."""
    try:
        return json.loads(path.read_text(encoding="utf-8-sig"))
    except FileNotFoundError:
        raise KroncError(f"{path} does not exist") from None
    except (ValueError, RecursionError) as error:  # ValueError also of characters, and of numbers of 4300 digits
        raise KroncError(f"{path} is not valid JSON ({error}): restore the file or write it anew") from None
    except OSError as error:
        raise KroncError(f"{path} cannot be read: {error.strerror}") from None


def relative_path(data: Path, name: str, folder: Path) -> str:
    """The path ``name`` of a scene in ``data``, as seen from ``folder``."""
    return Path(os.path.relpath((data / name).resolve(), folder.resolve())).as_posix()


def is_report(file: Path) -> bool:
    """Whether ``file`` is an HTML report of ours."""
    with file.open(encoding="utf-8", errors="replace") as start:
        return _REPORT_MARK in start.read(1000)


Kind = Literal["solution", "data set", "capture"]
"""What an output folder holds: poses alone; poses with the frames and detections they came from; a scene to solve."""


def check_output(folder: Path, kind: Kind = "solution") -> None:
    """Raise `KroncError` where `claim_output` would, before work whose result could not be written; writes nothing."""
    if folder.exists() and not folder.is_dir():
        raise KroncError(f"{folder} is a file: expected a folder for the output")
    if folder.is_dir() and any(folder.iterdir()) and (held := _held(folder)) not in (kind, ""):
        what = "data that kronc did not write" if held is None else f"a {held}, which is not for a {kind} to replace"
        raise KroncError(f"{folder} already holds {what}: choose a new or empty folder")
    there = next(path for path in (folder, *folder.resolve().parents) if path.exists())
    if not there.is_dir() or not os.access(there, os.W_OK | os.X_OK):
        what = "is not writable" if there.is_dir() else "is a file"
        raise KroncError(f"{folder} cannot be written: {there} {what}; choose another output folder")


def claim_output(folder: Path, kind: Kind = "solution") -> None:
    """Make ``folder`` ours to write: new, empty, or holding an earlier (also an interrupted) result of this ``kind``.

    Raises `KroncError` where it holds anything else.
    """
    check_output(folder, kind)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / MARKER).write_text(kind)
        (folder / "kronc.json").unlink(missing_ok=True)
        report = folder / REPORT_FILE
        if report.is_file() and is_report(report):  # of the earlier result
            report.unlink()
    except OSError as error:
        raise KroncError(f"{folder} cannot be written: {error.strerror}") from None


def _held(folder: Path) -> str | None:
    """The kind of the result, whole or interrupted, that kronc left in a folder; None where it left none.

    Empty where a version interrupted there did not say.
    """
    if (folder / MARKER).exists():
        return (folder / MARKER).read_text(errors="replace")
    if not (folder / "kronc.json").exists():
        return None
    try:
        record = read_json(folder / "kronc.json")
    except KroncError:  # broken
        return "solution"
    return "data set" if isinstance(record, dict) and record.get("data") == "." else "solution"


def release_output(folder: Path) -> None:
    """The output is whole: take the marker away."""
    (folder / MARKER).unlink(missing_ok=True)
