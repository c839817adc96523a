"""What a worker does with some captures: look, fetch, make, send, and tell of each as soon as it is done.

A result is whole where its folder holds fleet.json, which is written last and removed first.
"""

import json
import os
import platform
import re
import time
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from kronc_ns.errors import KroncError
from kronc_ns.files.output import REPORT_FILE
from kronc_ns.fleet import making
from kronc_ns.fleet.items import Item, Kind, Outcome, Row
from kronc_ns.fleet.job import Job
from kronc_ns.fleet.options import FleetOptions
from kronc_ns.fleet.scratch import check_room, is_full, limits, scratch_folder, scratch_root, sweep
from kronc_ns.fleet.storage import Place, StorageError, Stored, content_digest, digest
from kronc_ns.fleet.thumbnail import write_thumbnail

RECORD = "fleet.json"
_AHEAD = 4  # captures that are fetched while one is solved
_LAST = ("kronc.json", RECORD)


@dataclass
class _Work:
    """A capture in a worker's hands."""

    item: Item
    begin: float
    files: list[Stored] = field(default_factory=list)
    kind: Kind = "unknown"
    listed: str = ""
    inputs: str = ""
    seconds: dict[str, float] = field(default_factory=dict)


def do_captures(items: Sequence[Item], job: Job, large: bool = False, node: str = "") -> Iterator[Outcome]:
    """Do these captures in this process, each with an outcome, whatever is wrong with it.

    Without ``large`` captures with images are only looked at: their outcome is that they want a task of their own.
    While one is made the next are fetched and the last are sent.
    """
    root, told = scratch_root(job.options.scratch), set[str]()
    try:
        root.mkdir(parents=True, exist_ok=True)
        sweep(root)
        with scratch_folder(root) as scratch, _cache_in(scratch):
            worker = _Worker(job, large, node or platform.node(), root, scratch)
            with ThreadPoolExecutor(_AHEAD) as pool:
                for outcome in worker.run(items, pool):
                    told.add(outcome.item.entry)
                    yield outcome
    except OSError as error:  # of the scratch folder itself
        reason = f"{root} cannot be written: {error.strerror or error}: choose another --scratch"
        yield from (Outcome(item, "again", reason=reason) for item in items if item.entry not in told)


class _Worker:
    def __init__(self, job: Job, large: bool, node: str, root: Path, scratch: Path) -> None:
        self._job, self._large, self._node, self._root, self._scratch = job, large, node, root, scratch
        self._options: FleetOptions = job.local_options(scratch / "options")

    def run(self, items: Sequence[Item], pool: ThreadPoolExecutor) -> Iterator[Outcome]:
        """The outcome of each, in their order."""
        coming: deque[tuple[Item, Future[_Work | Outcome]]] = deque()
        leaving: deque[tuple[Item, Future[Outcome]]] = deque()
        waiting = deque(items)
        while waiting or coming:
            while waiting and len(coming) < _AHEAD:
                item = waiting.popleft()
                coming.append((item, pool.submit(self._guarded, item, self._fetch, item)))
            item, future = coming.popleft()
            work = future.result()
            outcome = work if isinstance(work, Outcome) else self._guarded(item, self._make, work)
            if isinstance(outcome, Outcome):
                yield outcome
            else:
                leaving.append((item, pool.submit(self._guarded, item, self._send, outcome)))
            while leaving and (leaving[0][1].done() or len(leaving) > _AHEAD):
                yield leaving.popleft()[1].result()
        for _, sending in leaving:
            yield sending.result()

    def _guarded(self, item: Item, step: Any, argument: Any) -> Any:
        """A step; what is wrong with the capture becomes its outcome."""
        try:
            return step(argument)
        except Exception as error:  # whatever a rotten file does to a library, the other captures go on
            _forget(self._data(item), self._out(item))
            return self._wrong(item, error)

    def _wrong(self, item: Item, error: Exception) -> Outcome:
        if is_full(error):
            return Outcome(item, "again", reason=f"{self._root} is full: choose another --scratch")
        if isinstance(error, StorageError):
            return Outcome(item, "again", reason=str(error))
        if isinstance(error, MemoryError):
            told = f"it takes more memory than --memory-gb {self._options.memory_gb:g}: raise it to do this capture"
        else:
            told = str(error) if isinstance(error, KroncError) else f"{type(error).__name__}: {error}"
        for place in (self._job.captures, self._job.output):  # as the user knows them
            told = told.replace(f"{self._mirrored(place)}/", "")
        return self._failed(item, " ".join(told.split())[:1000])

    def _failed(self, item: Item, reason: str) -> Outcome:
        return Outcome(item, "done", _row(item, self._job, self._node, "unknown", status="error", reason=reason))

    def _fetch(self, item: Item) -> _Work | Outcome:
        """Look at a capture, and if there is anything to be done bring its files."""
        job, begin = self._job, time.perf_counter()
        place = job.captures / item.entry
        files = place.files()
        work = _Work(item, begin, files, making.kind_of(files, item.is_video), digest(files, job.salt))
        held = self._held(item) if job.resumes or item.attempts > 1 else None
        if held and work.listed and held.listed == work.listed:
            return Outcome(item, "done", held)
        if not files:
            return self._failed(item, "it is empty, or has vanished: expected photos, a video or keypoints")
        if work.kind == "unknown":
            return self._failed(item, "it is no capture: expected photos, a video, or transforms.json and keypoints")
        only = self._keypoints_only(work)
        if not only and not self._large:
            return Outcome(item, "large")
        wanted = making.without_images(files) if only and work.kind != "keypoints" else files
        check_room(self._root, sum(file.size for file in wanted), self._options.scratch_gb)
        data = self._data(item)
        folder = data.parent if item.is_video else data
        place.fetch(wanted, folder)
        work.inputs = content_digest(folder, wanted, job.salt)
        work.seconds["fetch_s"] = time.perf_counter() - begin
        work.files = wanted
        if held and held.inputs == work.inputs:  # touched, but the same
            row = replace(held, listed=work.listed)
            (self._result(item) / RECORD).write(_json(row))
            return Outcome(item, "done", row)
        return work

    def _make(self, work: _Work) -> _Work:
        """The folder of results."""
        data, out = self._data(work.item), self._out(work.item)
        out.parent.mkdir(parents=True, exist_ok=True)
        make = making.make_poses if self._keypoints_only(work) else making.make_data_set
        with limits(self._scratch, self._options.memory_gb, self._options.scratch_gb):
            work.seconds |= make(data, out, self._job, self._options)
            write_thumbnail(out)
            if self._options.poses_only:
                making.keep_poses_only(out)
        return work

    def _send(self, work: _Work) -> Outcome:
        """Bring the results to their place, whole and marked last, and forget the capture here."""
        item, job, out = work.item, self._job, self._out(work.item)
        begin, target = time.perf_counter(), self._result(item)
        if job.resumes or item.attempts > 1:
            (target / RECORD).remove()
            target.remove()
        written = target.send(out, _LAST)
        thumbnail = next((file.name for file in sorted(out.glob("thumbnail.*"))), "")
        has_report = (out / REPORT_FILE).exists()
        now = time.perf_counter()
        row = _row(
            item, job, self._node, work.kind, **making.facts(out), **work.seconds, upload_s=now - begin,
            seconds=now - work.begin, bytes_in=sum(file.size for file in work.files), bytes_out=written,
            inputs=work.inputs, listed=work.listed, thumbnail=thumbnail, has_report=has_report,
        )  # fmt: skip
        (target / RECORD).write(_json(row))
        _forget(self._data(item), out)
        return Outcome(item, "done", row)

    def _held(self, item: Item) -> Row | None:
        """What a whole result that is there says of itself; None where none is, or another version's."""
        content = (self._result(item) / RECORD).read()
        try:
            return None if content is None else Row(**json.loads(content))
        except (TypeError, ValueError):
            return None

    def _keypoints_only(self, work: _Work) -> bool:
        if work.kind == "keypoints":
            return True
        finds = self._options.detection.detector not in (None, "none")
        return self._options.poses_only and not finds and making.has_keypoints(work.files)

    def _result(self, item: Item) -> Place:
        return self._job.output / item.name

    def _data(self, item: Item) -> Path:
        return self._mirrored(self._job.captures) / item.entry.rstrip("/")

    def _out(self, item: Item) -> Path:
        return self._mirrored(self._job.output) / item.name

    def _mirrored(self, place: Place) -> Path:
        """Where a place stands in the scratch folder: relative paths between two are as between the places."""
        return self._scratch / re.sub(r"[:/]+", "/", place.url).lstrip("/")


def _row(item: Item, job: Job, node: str, kind: Kind, **values: Any) -> Row:
    rounded: dict[str, Any] = {
        key: round(value, 6) if isinstance(value, float) else value for key, value in values.items()
    }
    return Row(
        capture=item.name, path=(job.captures / item.entry).url, kind=kind, node=node, attempts=max(item.attempts, 1),
        version=job.version, finished=round(time.time(), 3), **rounded,
    )  # fmt: skip


def error_row(item: Item, job: Job, reason: str) -> Row:
    """The row of a capture without a result."""
    return _row(item, job, item.avoid, "unknown", status="error", reason=reason)


def _json(row: Row) -> bytes:
    return (json.dumps(asdict(row)) + "\n").encode()


def _forget(*paths: Path) -> None:
    import shutil

    for path in paths:
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


class _cache_in:
    """Detections and masks that are kept for another run go to the scratch folder: a node's disk stays as it is."""

    def __init__(self, scratch: Path) -> None:
        self._folder = str(scratch / "cache")

    def __enter__(self) -> None:
        self._before = os.environ.get("KRONC_NS_CACHE")
        os.environ["KRONC_NS_CACHE"] = self._folder

    def __exit__(self, *_: object) -> None:
        if self._before is None:
            del os.environ["KRONC_NS_CACHE"]
        else:
            os.environ["KRONC_NS_CACHE"] = self._before
