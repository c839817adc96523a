"""What is told before a fleet begins."""

import json
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

from kronc_ns.errors import KroncError
from kronc_ns.fleet.job import Job
from kronc_ns.fleet.storage import EXTRA, Place, StorageError
from kronc_ns.fleet.work import RECORD


def check_extra(with_ray: bool) -> None:
    """Raise `KroncError` where a package of the extra is missing."""
    for name in ("fsspec", "pyarrow", *(["ray"] if with_ray else [])):
        if find_spec(name) is None:
            raise KroncError(f"kronc fleet needs {name}, which is not installed: {EXTRA}")


def check_apart(source: Place, target: Place) -> None:
    """Raise `KroncError` where results would be among the captures."""
    one, other = f"{source.url}/", f"{target.url}/"
    if one.startswith(other) or other.startswith(one):
        raise KroncError(f"--output {target} and --captures {source} lie in each other: choose another output")


def check_output(job: Job) -> None:
    """Raise `KroncError` where the output holds something else."""
    place, content = job.output, (job.output / RECORD).read()
    try:
        held = None if content is None else json.loads(content)
    except ValueError:
        held = {}
    if held is None:
        if next(iter(_entries(place)), None) is not None:
            raise KroncError(f"{place} holds something that kronc fleet did not write: choose a new or empty folder")
        return
    if not isinstance(held, dict) or held.get("kind") != "fleet":
        raise KroncError(f"{place / RECORD} is of no fleet: choose a new or empty folder")
    if held.get("captures") != job.captures.url:
        raise KroncError(f"{place} holds results of {held.get('captures')}: choose another folder for {job.captures}")
    if not job.resumes:
        raise KroncError(f"{place} holds results of these captures: go on with --resume, or choose a new folder")


def _entries(place: Place) -> Iterator[tuple[str, bool]]:
    if place.is_local:
        folder = Path(str(place))
        if folder.exists() and not folder.is_dir():
            raise KroncError(f"{place} is a file: expected a folder for the output")
    try:
        yield from place.entries()
    except StorageError as error:
        if not isinstance(error.__cause__, FileNotFoundError):
            raise
