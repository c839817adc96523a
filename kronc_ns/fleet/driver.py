"""`run_fleet`: hands captures to an executor, and keeps the table of what becomes of them."""

import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from typing import Any

from kronc_ns.errors import KroncError
from kronc_ns.fleet.checks import check_apart, check_extra, check_output
from kronc_ns.fleet.executor import Event, Executor, InProcess
from kronc_ns.fleet.items import Item, Outcome
from kronc_ns.fleet.job import Job, described, make_job
from kronc_ns.fleet.listing import list_captures
from kronc_ns.fleet.options import FleetOptions
from kronc_ns.fleet.page import write_page
from kronc_ns.fleet.queue import Bundle, Queue
from kronc_ns.fleet.storage import place_of
from kronc_ns.fleet.table import Table
from kronc_ns.fleet.work import RECORD, error_row

_TURN_S = 0.25
_NAMED = 20


@dataclass(frozen=True)
class State:
    """How far a fleet is."""

    captures: int
    done: int
    """Of this run, those that needed nothing included."""
    counts: Mapping[str, int]
    """Captures in the table by status."""
    tasks: int
    nodes: int
    seconds: float


@dataclass(frozen=True)
class Summary:
    """How a fleet ended."""

    output: str
    captures: int
    """Of this run."""
    unchanged: int
    """Of those, the ones that an earlier run had done."""
    counts: Mapping[str, int]
    """Captures in the table by status: converged, weak, failed, error."""
    doubtful: tuple[tuple[str, str, str], ...] = ()
    """Status, name and reason of the first captures that are not converged."""
    seconds: float = 0.0

    @property
    def is_solved(self) -> bool:
        """Whether every capture is converged."""
        return not any(count for status, count in self.counts.items() if status != "converged")


Progress = Callable[[State], None]


def run_fleet(
    captures: str,
    output: str,
    options: FleetOptions | None = None,
    *,
    ray: str | None = None,
    resume: bool = False,
    limit: int | None = None,
    local_cpus: int | None = None,
    storage_options: Mapping[str, Any] | None = None,
    progress: Progress | None = None,
    command: tuple[str, ...] | None = None,
) -> Summary:
    """Do every capture (subfolder or video) of a folder or URL; results, table and page go to ``output``.

    ``ray`` is the address of a cluster (default: a Ray of this machine, with ``local_cpus``, for the time of the call;
    none: without Ray, one after the other); inside a program that has called ``ray.init`` any address takes that.
    Raises `KroncError` before the work for what can be known then; a capture that cannot be done never raises, it has
    its row. Interrupted, what is done stays.
    """
    check_extra(with_ray=ray != "none")
    if limit is not None and limit < 1:
        raise KroncError(f"--limit is {limit}: expected 1 or more")
    source, target = place_of(captures, storage_options), place_of(output, storage_options)
    check_apart(source, target)
    job = make_job(source, target, options or FleetOptions(), resume, command)
    check_output(job)
    entries = list_captures(source, limit)
    with _executor(job, ray, local_cpus) as executor:
        return drive(job, executor, entries, progress)


def drive(job: Job, executor: Executor, entries: Sequence[str], progress: Progress | None = None) -> Summary:
    """Have an executor do the captures of a listing (`list_captures`), with table and page."""
    (job.output / RECORD).write((json.dumps(described(job)) + "\n").encode())
    table = Table(job.output / "fleet.parquet")
    if job.resumes:
        table.open()
    fleet = _Fleet(job, executor, table, Queue((Item(entry) for entry in entries), len(entries)), len(entries))
    try:
        fleet.run(progress)
    except BaseException:
        with suppress(Exception):  # what is to be told is why it ended
            fleet.hear(executor.stop())
            fleet.close()
        raise
    executor.stop()
    return fleet.close()


@dataclass
class _Task:
    bundle: Bundle
    left: dict[str, Item]
    """Captures it has not told of, by entry."""
    node: str = ""
    began: float = 0.0
    """When it started; 0 before."""
    is_late: bool = False


@dataclass
class _Fleet:
    job: Job
    executor: Executor
    table: Table
    queue: Queue
    captures: int
    done: int = 0
    unchanged: int = 0
    tasks: dict[int, _Task] = field(default_factory=dict)
    begin: float = field(default_factory=time.monotonic)

    def run(self, progress: Progress | None) -> None:
        """Until every capture has its row."""
        while self.tasks or not self.queue.is_empty:
            while not self.queue.is_empty and self.executor.has_room(self.queue.next_is_large()):
                bundle = self.queue.take(self.executor.slots)
                bundle = Bundle(tuple(item.tried() for item in bundle.items), bundle.large)
                self.tasks[self.executor.submit(bundle)] = _Task(bundle, {item.entry: item for item in bundle.items})
            self.hear(self.executor.wait(_TURN_S))
            self._end_late()
            if progress is not None:
                progress(self._state())

    def hear(self, events: list[Event]) -> None:
        """Take what tasks let know."""
        for event in events:
            task = self.tasks[event.task]
            task.node = event.node or task.node
            if event.happened == "started":
                task.began = time.monotonic()
            for outcome in event.outcomes:
                if task.left.pop(outcome.item.entry, None) is not None:
                    self._take(outcome, task)
            if event.happened in ("ended", "died"):
                del self.tasks[event.task]
                if not task.bundle.large and event.happened == "ended" and task.began:
                    self.queue.learn(time.monotonic() - task.began, len(task.bundle.items))
                if task.left:
                    self._lost(task, event.reason or "its task ended without a word of it")

    def close(self) -> Summary:
        """Write what is to be written at the end."""
        self.table.flush()
        doubtful = write_page(self.job, self.table, _NAMED)
        return Summary(
            output=str(self.job.output),
            captures=self.captures,
            unchanged=self.unchanged,
            counts={status: count for status, count in self.table.counts.items() if count},
            doubtful=doubtful,
            seconds=time.monotonic() - self.begin,
        )

    def _take(self, outcome: Outcome, task: _Task) -> None:
        if outcome.action == "large":
            self.queue.put_large(outcome.item.seen())
        elif outcome.action == "again":
            self._strike(outcome.item, task, outcome.reason)
        elif outcome.row is not None:
            self.done += 1
            if self.table.holds(outcome.row) and outcome.row.status != "error":
                self.unchanged += 1
            else:
                self.table.add(outcome.row)

    def _lost(self, task: _Task, reason: str) -> None:
        """A task died: whoever it died of is found by halving."""
        items = tuple(task.left.values())
        if len(items) == 1:
            limit = self.job.options.time_limit_min
            late = f"it took longer than --time-limit-min {limit:g}"
            self._strike(items[0], task, late if task.is_late else reason)
        else:
            self.queue.put_again(Bundle(items, task.bundle.large).halves())

    def _strike(self, item: Item, task: _Task, reason: str) -> None:
        item = item.struck(task.node)
        if item.strikes <= self.job.options.retries:
            self.queue.put_again([Bundle((item,), task.bundle.large)])
        else:
            self.done += 1
            self.table.add(error_row(item, self.job, f"{reason} (tried {item.strikes} times)"))

    def _end_late(self) -> None:
        now, limit = time.monotonic(), 60 * self.job.options.time_limit_min
        for number, task in self.tasks.items():
            if task.began and not task.is_late and now - task.began > limit:
                task.is_late = True
                self.executor.end(number)

    def _state(self) -> State:
        seconds = time.monotonic() - self.begin
        return State(
            self.captures, self.done, self.table.counts, len(self.tasks), self.executor.nodes, seconds
        )  # fmt: skip


@contextmanager
def _executor(job: Job, address: str | None, local_cpus: int | None) -> Iterator[Executor]:
    if address == "none" or job.captures.is_in_memory or job.output.is_in_memory:  # which no other process sees
        yield InProcess(job)
        return
    from kronc_ns.fleet.cluster import joined_ray, local_ray
    from kronc_ns.fleet.on_ray import OnRay

    with local_ray(local_cpus) if address is None else joined_ray(address):
        yield OnRay(job)
