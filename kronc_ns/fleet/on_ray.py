"""Ray does the tasks of a fleet."""

import platform
import random
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import kronc_ns
from kronc_ns.errors import KroncError
from kronc_ns.fleet.cluster import import_ray
from kronc_ns.fleet.executor import Event
from kronc_ns.fleet.items import Outcome
from kronc_ns.fleet.job import Job, missing_on_this_node
from kronc_ns.fleet.queue import Bundle
from kronc_ns.fleet.scratch import scratch_root, sweep
from kronc_ns.fleet.work import do_captures

_NAME = "kronc_fleet"  # of its tasks, and in the list of processes
_PATIENCE_S = 60.0
_STOP_S = 10.0
_TOLD_EVERY_S = 0.5
_LOOK_S = 2.0
_GB = 1 << 30


@dataclass
class _Running:
    """A task of Ray."""

    task: int
    answers: Any
    """Generator of references to what it tells."""
    needs: dict[str, float]


@dataclass
class OnRay:
    """Tasks of Ray, never more than its nodes have room for."""

    job: Job
    _running: dict[int, _Running] = field(default_factory=dict, init=False)
    _task: int = field(default=0, init=False)
    _looked: float = field(default=-_LOOK_S, init=False)
    _alive: list[dict[str, Any]] = field(default_factory=list, init=False)
    _left_behind: bool = field(default=False, init=False)
    """Whether a worker was killed, which removed no scratch folder."""

    def __post_init__(self) -> None:
        self._ray = import_ray()
        self._job_reference = self._ray.put(self.job)
        # Ray wants a generator function itself, none that a type checker has wrapped
        self._work = self._ray.remote(num_returns="streaming", max_retries=0)(
            lambda *task: (yield from _work(*task))  # pyright: ignore[reportReturnType]
        )
        self._check_nodes()

    @property
    def slots(self) -> int:
        """Small bundles that all nodes have room for."""
        return max(int(self._total("CPU")), 1)

    @property
    def nodes(self) -> int:
        """Machines that are alive."""
        return len(self._look())

    def has_room(self, large: bool) -> bool:
        """Whether all nodes together have as much free as it needs."""
        needs = self._needs(large)
        taken = {name: sum(one.needs.get(name, 0.0) for one in self._running.values()) for name in needs}
        return all(taken[name] + need <= self._total(name) for name, need in needs.items())

    def submit(self, bundle: Bundle) -> int:
        """Start a task, after a failure on another node than before if there is one."""
        self._task += 1
        needs = self._needs(bundle.large)
        options: dict[str, Any] = {"name": _NAME, "num_cpus": needs["CPU"], "num_gpus": needs.get("GPU", 0)}
        if "memory" in needs:
            options["memory"] = needs["memory"]
        if avoid := {item.avoid for item in bundle.items} - {""}:
            others = [node["NodeID"] for node in self._look() if _label(node["NodeID"]) not in avoid]
            if others:
                options["scheduling_strategy"] = _on(random.choice(others), soft=True)
        answers = self._work.options(**options).remote(bundle, self._job_reference)
        self._running[self._task] = _Running(self._task, answers, needs)
        return self._task

    def wait(self, seconds: float) -> list[Event]:
        """What tasks have told, ended, or died of."""
        waiting = {id(one.answers): one for one in self._running.values()}
        if not waiting:
            return []
        answers = [one.answers for one in waiting.values()]
        ready, _ = self._ray.wait(answers, num_returns=1, timeout=seconds, fetch_local=False)
        if ready:
            ready, _ = self._ray.wait(answers, num_returns=len(answers), timeout=0, fetch_local=False)
        return [event for one in ready for event in self._heard(waiting[id(one)])]

    def end(self, task: int) -> None:
        """Kill the worker of a task."""
        self._ray.cancel(self._running[task].answers, force=True)

    def stop(self) -> list[Event]:
        """Interrupt all tasks, wait for what they clean up, and clear up after those that were killed."""
        self._left_behind |= bool(self._running)
        for one in self._running.values():
            self._ray.cancel(one.answers, force=False)
        events, until = [], time.monotonic() + _STOP_S
        while self._running and time.monotonic() < until:
            events += self.wait(0.2)
        for one in self._running.values():
            self._ray.cancel(one.answers, force=True)
        if self._left_behind:
            self._on_every_node(_sweep)
        return events

    def _heard(self, one: _Running) -> list[Event]:
        ray = self._ray
        try:
            told = ray.get(next(one.answers))
        except StopIteration:
            del self._running[one.task]
            return [Event(one.task, "ended")]
        except ray.exceptions.RayTaskError as error:  # of ours, not of a capture
            del self._running[one.task]
            if isinstance(error.cause, KroncError):
                raise error.cause from None
            return [Event(one.task, "died", reason=_line(error.cause or error))]
        except ray.exceptions.RayError as error:
            del self._running[one.task]
            self._left_behind = True
            return [Event(one.task, "died", reason=f"its worker died ({type(error).__name__})")]
        if isinstance(told, str):
            return [Event(one.task, "started", node=told)]
        return [Event(one.task, "told", told)]

    def _needs(self, large: bool) -> dict[str, float]:
        """What a task declares to Ray; never more than the largest node has."""
        options = self.job.options
        if not large:
            return {"CPU": 1.0}
        needs = {"CPU": float(min(options.cpus, self._largest("CPU")))}
        if gpus := self._gpus():
            needs["GPU"] = gpus
        needs["memory"] = float(int(min(options.memory_gb * _GB, self._largest("memory"))))
        return needs

    def _gpus(self) -> float:
        options = self.job.options
        if options.gpus is not None:
            return options.gpus
        wanted = options.device == "cuda" or options.segmenter in ("maskrcnn", "mask2former")
        return 1.0 if wanted and self._largest("GPU") >= 1 else 0.0

    def _look(self) -> list[dict[str, Any]]:
        """The nodes that are alive, as they were a moment ago."""
        if time.monotonic() - self._looked >= _LOOK_S:
            self._alive = [node for node in self._ray.nodes() if node["Alive"]]
            self._looked = time.monotonic()
        return self._alive

    def _total(self, name: str) -> float:
        return sum(node["Resources"].get(name, 0.0) for node in self._look())

    def _largest(self, name: str) -> float:
        return max((node["Resources"].get(name, 0.0) for node in self._look()), default=0.0)

    def _check_nodes(self) -> None:
        """Raise `KroncError` where a node cannot do what this process asks of it."""
        if self._largest("CPU") < 1:
            raise KroncError("the cluster has no CPUs: start a node with --num-cpus 1 or more")
        if self._gpus() > self._largest("GPU"):
            raise KroncError(
                f"--gpus is {self._gpus():g}, and no node of the cluster has more than {self._largest('GPU'):g}"
            )
        for node, facts in self._on_every_node(_facts).items():
            if isinstance(facts, Exception):
                raise KroncError(
                    f"node {node} cannot work for this fleet ({_line(facts)}): install kronc-ns[fleet] "
                    f"{kronc_ns.__version__} on it"
                )
            version, missing = facts
            if version != kronc_ns.__version__:
                raise KroncError(
                    f"node {node} has kronc_ns {version}, this process {kronc_ns.__version__}: install one on all"
                )
            if missing:
                raise KroncError(f"node {node} has no {missing[0]}: expected it in the same place on every node")

    def _on_every_node(self, function: Any) -> dict[str, Any]:
        """What a function of the job says on each node, or its error."""
        affinity = self._ray.util.scheduling_strategies.NodeAffinitySchedulingStrategy
        remote = self._ray.remote(num_cpus=0, max_retries=0)(function)
        asked = {
            node["NodeManagerHostname"]: remote.options(
                scheduling_strategy=affinity(node["NodeID"], soft=False)
            ).remote(self._job_reference)
            for node in self._ray.nodes()
            if node["Alive"]
        }
        said: dict[str, Any] = {}
        for node, reference in asked.items():
            try:
                said[node] = self._ray.get(reference, timeout=_PATIENCE_S)
            except Exception as error:
                said[node] = error
        return said


def _work(bundle: Bundle, job: Job) -> Iterator[str | list[Outcome]]:
    """A task of Ray: first the node's name, then what becomes of the captures, as it is known."""
    import ray

    if job.version != kronc_ns.__version__:  # a node that joined later
        raise KroncError(f"{platform.node()} has kronc_ns {kronc_ns.__version__}, the fleet {job.version}")
    node = _label(ray.get_runtime_context().get_node_id())
    yield node
    told: list[Outcome] = []
    last = time.monotonic()
    for outcome in do_captures(bundle.items, job, bundle.large, f"{platform.node()}/{node}"):
        told.append(outcome)
        if time.monotonic() - last >= _TOLD_EVERY_S:
            yield told
            told, last = [], time.monotonic()
    if told:
        yield told


def _facts(job: Job) -> tuple[str, list[str]]:
    """Of a node: the version it has, and files of the options that it lacks."""
    import fsspec  # noqa: F401

    return kronc_ns.__version__, missing_on_this_node(job)


def _sweep(job: Job) -> None:
    sweep(scratch_root(job.options.scratch))


def _on(node_id: str, soft: bool) -> Any:
    """Ray's way to ask for a node."""
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    return NodeAffinitySchedulingStrategy(node_id, soft=soft)


def _label(node_id: str) -> str:
    return node_id[:8]


def _line(error: BaseException) -> str:
    lines = str(error).strip().splitlines()
    return f"{type(error).__name__}: {lines[-1].strip() if lines else ''}"[:300]
