"""Who does the tasks of a fleet: this process, or (`cluster`) Ray."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol, TypeAlias, runtime_checkable

from kronc_ns.fleet.items import Outcome
from kronc_ns.fleet.job import Job
from kronc_ns.fleet.queue import Bundle
from kronc_ns.fleet.work import do_captures

Happened: TypeAlias = Literal["started", "told", "ended", "died"]


@dataclass(frozen=True)
class Event:
    """What a task lets know."""

    task: int
    happened: Happened
    outcomes: Sequence[Outcome] = ()
    """Of captures that are done, where it told."""
    node: str = ""
    """Where it started."""
    reason: str = ""
    """Why it died."""


@runtime_checkable
class Executor(Protocol):
    """Runs bundles, at most as many at a time as there is room for."""

    @property
    def slots(self) -> int:
        """How many bundles of small captures there is room for, when nothing else is done."""
        ...

    @property
    def nodes(self) -> int:
        """How many machines there are."""
        ...

    def has_room(self, large: bool) -> bool:
        """Whether another bundle would start at once."""
        ...

    def submit(self, bundle: Bundle) -> int:
        """Start a bundle; the number of its task."""
        ...

    def wait(self, seconds: float) -> list[Event]:
        """What has happened, at the latest after so long."""
        ...

    def end(self, task: int) -> None:
        """Kill a task, which dies of it."""
        ...

    def stop(self) -> list[Event]:
        """Let no task go on; what they still tell."""
        ...


class InProcess:
    """One task at a time, in this process; for data that no other process can see."""

    slots = nodes = 1

    def __init__(self, job: Job) -> None:
        self._job = job
        self._task = 0
        self._running: Iterator[Outcome] | None = None

    def has_room(self, large: bool) -> bool:
        """Whether the last one has ended."""
        return self._running is None

    def submit(self, bundle: Bundle) -> int:
        """Start a bundle."""
        self._task += 1
        self._running = do_captures(bundle.items, self._job, bundle.large)
        return self._task

    def wait(self, seconds: float) -> list[Event]:
        """The next capture."""
        if self._running is None:
            return []
        for outcome in self._running:
            return [Event(self._task, "told", [outcome])]
        self._running = None
        return [Event(self._task, "ended")]

    def end(self, task: int) -> None:
        """Nothing: while a capture is made nobody could ask for it."""

    def stop(self) -> list[Event]:
        """Drop what has not been done."""
        self._running = None
        return []
