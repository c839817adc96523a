"""What the rows of the fleet measure."""

import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from io import StringIO
from itertools import count
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from kronc_ns.benchmark.commands import Commands
from kronc_ns.benchmark.figures import Figures
from kronc_ns.benchmark.memory import with_peak
from kronc_ns.errors import KroncError
from kronc_ns.files.transforms import read_poses
from kronc_ns.fleet.items import Item, Outcome, Row
from kronc_ns.fleet.job import make_job
from kronc_ns.fleet.options import FleetOptions
from kronc_ns.fleet.queue import Queue
from kronc_ns.fleet.storage import Place, place_of
from kronc_ns.synthetic.folder import write_capture
from kronc_ns.synthetic.scenes import make_capture

_VIEWS, _MODELS = 60, 20
_QUICK = FleetOptions(reports="none")
_KILL_EVERY_S = 10.0
_MILLION = 1_000_000
_SAME = 1e-6
_COPIES = 6


def throughput(seed: int, captures: int) -> Figures:
    """A fleet on two nodes of one CPU over `solve_scenes` with two threads."""
    from kronc_ns.fleet import run_fleet

    with TemporaryDirectory(prefix="kronc-bench-fleet-") as place:
        data = _captures(Path(place) / "captures", captures, seed)
        begin = time.perf_counter()
        _together(data, Path(place) / "together")
        together = time.perf_counter() - begin
        begin = time.perf_counter()
        with _cluster() as address:
            start_s = time.perf_counter() - begin
            begin = time.perf_counter()
            summary = run_fleet(str(data), str(Path(place) / "out"), _QUICK, ray=address)
            fleet = time.perf_counter() - begin
    if summary.counts.get("error"):
        raise KroncError(f"{summary.counts['error']} captures were not done: {summary.doubtful[:1]}")
    return {
        "over_solve_scenes": together / fleet,
        "captures_per_s": captures / fleet,
        "solve_scenes_captures_per_s": captures / together,
        "cluster_start_s": start_s,
    }


def overhead(seed: int) -> Figures:
    """Seconds of a capture with images in a fleet, beyond those of the command for one, and of its work alone."""
    from kronc_ns.fleet import run_fleet
    from kronc_ns.plugin.process_data import KroncToNerfstudio

    with TemporaryDirectory(prefix="kronc-bench-fleet-") as place, Commands() as commands:
        data, alone = Path(place) / "captures", Path(place) / "alone"
        write_capture(data / "c0", make_capture("walk", 6, seed, noise_px=1.0), render=True)
        for i in range(1, _COPIES):
            shutil.copytree(data / "c0", data / f"c{i}")
        warm = command = 0.0
        with redirect_stdout(StringIO()), redirect_stderr(StringIO()):
            KroncToNerfstudio(data / "c0", alone / "first").run()
            for i in range(_COPIES):
                begin = time.perf_counter()
                KroncToNerfstudio(data / f"c{i}", alone / f"warm{i}").run()
                warm += (time.perf_counter() - begin) / _COPIES
        for i in range(_COPIES):
            begin = time.perf_counter()
            commands.run("kronc-process-data", "--data", str(data / f"c{i}"), "--output-dir", str(alone / f"c{i}"))
            command += (time.perf_counter() - begin) / _COPIES
        with _cluster(nodes=1) as address:
            fleet = run_fleet(str(data), str(Path(place) / "out"), ray=address).seconds / _COPIES
    return {"overhead_s": fleet - command, "over_warm_s": fleet - warm, "fleet_s": fleet, "alone_s": command}


def disturbed(seed: int, captures: int) -> Figures:
    """A fleet whose workers are killed now and then, and whose driver is once, beside an undisturbed solve."""
    import pyarrow.parquet as pq

    with TemporaryDirectory(prefix="kronc-bench-fleet-") as place, _cluster() as address:
        data, whole, out = (
            _captures(Path(place) / "captures", captures, seed),
            Path(place) / "whole",
            Path(place) / "out",
        )
        _together(data, whole)
        command = [
            sys.executable,
            "-m",
            "kronc_ns.commands.main",
            "fleet",
            "--captures",
            str(data),
            "--output",
            str(out),
        ]
        command += ["--ray", address, "--reports", "none", "--retries", "9"]
        begin = time.perf_counter()
        with _killing() as killed:
            driver = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
            while len([*out.glob("*/fleet.json")]) < captures // 2 and driver.poll() is None:
                time.sleep(0.2)
            driver.kill()
            driver.wait()
            again = subprocess.run([*command, "--resume"], capture_output=True, text=True, check=False)
        seconds = time.perf_counter() - begin
        if again.returncode not in (0, 3):
            raise KroncError(f"--resume ended with {again.returncode}: {again.stderr[-300:]}")
        names = pq.read_table(out / "fleet.parquet", columns=["capture"])["capture"].to_pylist()
        other = sum(not _are_same(out / name, whole / name) for name in set(names))
    return {
        "lost": float(captures - len(set(names))),
        "twice": float(len(names) - len(set(names))),
        "other_results": float(other),
        "workers_killed": float(len(killed)),
        "seconds": seconds,
    }


def planning(seed: int) -> Figures:
    """List a million captures and bundle them."""
    from kronc_ns.fleet.listing import list_captures

    def plan() -> int:
        entries = list_captures(_Synthetic("memory://captures"))
        queue = Queue((Item(entry) for entry in entries), len(entries))
        queue.learn(0.1, 1)
        bundles = 0
        while not queue.is_empty:
            queue.take(100)
            bundles += 1
        return bundles

    begin = time.perf_counter()
    bundles, megabytes = with_peak(plan)
    return {"seconds": time.perf_counter() - begin, "megabytes": megabytes, "bundles": float(bundles)}


def driver_memory(seed: int) -> Figures:
    """Peak memory of the driver, for few and many captures."""
    few, many = (_in_a_process(_drive, captures) for captures in (100, 10_000))
    return {"megabytes_more": many - few, "megabytes_100": few, "megabytes_10000": many}


def page(seed: int) -> Figures:
    """How long a browser takes for the page of 10,000 captures."""
    chromium = shutil.which("chromium")
    if chromium is None:
        raise KroncError("chromium is not installed: apt-get install chromium")
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        raise KroncError("playwright is not installed: pip install playwright") from None
    with TemporaryDirectory(prefix="kronc-bench-fleet-") as place:
        _drive(10_000, Path(place))
        file = Path(place) / "out/fleet.html"
        with sync_playwright() as playwright:
            browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox", "--disable-gpu"])
            browser.new_page().goto("about:blank")
            shown = browser.new_page()
            begin = time.perf_counter()
            shown.goto(file.as_uri())
            shown.wait_for_selector("#captures tbody tr:nth-child(20)")
            seconds = time.perf_counter() - begin
            browser.close()
        return {"opens_s": seconds, "megabytes": file.stat().st_size / 1e6}


def growth(seed: int) -> Figures:
    """Table and page of a million captures."""
    from kronc_ns.fleet.page import write_page
    from kronc_ns.fleet.table import Table

    with TemporaryDirectory(prefix="kronc-bench-fleet-") as place:
        job = make_job(place_of(f"{place}/captures"), place_of(f"{place}/out"), _QUICK)
        table = Table(job.output / "fleet.parquet")
        begin = time.perf_counter()
        for i in range(_MILLION):
            table.add(_row(i))
        table.flush()
        written = time.perf_counter()
        Table(job.output / "fleet.parquet").open()
        opened = time.perf_counter()
        write_page(job, table, 20)
        shown = time.perf_counter()
        parts = [*(Path(place) / "out/fleet.parquet").iterdir()]
        return {
            "parts": float(len(parts)),
            "megabytes": sum(part.stat().st_size for part in parts) / 1e6,
            "write_s": written - begin,
            "open_s": opened - written,
            "page_s": shown - opened,
            "page_megabytes": (Path(place) / "out/fleet.html").stat().st_size / 1e6,
        }


class _Synthetic(Place):
    """A folder of an object store with a million captures."""

    def opened(self) -> tuple[Any, str]:
        """A file system that lists them as s3fs does."""

        class Store:
            @staticmethod
            def ls(root: str, detail: bool) -> list[dict[str, Any]]:
                return [
                    {"Key": name, "Size": 0, "StorageClass": "DIRECTORY", "type": "directory", "size": 0, "name": name}
                    for name in (f"{root}/2026-01-31/vehicle_{i:09d}_walk_around" for i in range(_MILLION))
                ]

        return Store, "captures"


class _MadeUp:
    """An executor that says at once what became of captures."""

    slots = nodes = 4

    def __init__(self) -> None:
        self._numbers, self._waiting = count(), []

    def has_room(self, large: bool) -> bool:
        return len(self._waiting) < 4

    def submit(self, bundle: Any) -> int:
        task = next(self._numbers)
        self._waiting.append((task, bundle))
        return task

    def wait(self, seconds: float) -> list[Any]:
        from kronc_ns.fleet.executor import Event

        waiting, self._waiting = self._waiting, []
        told = ((task, [Outcome(item, "done", _row(int(item.name))) for item in one.items]) for task, one in waiting)
        return [event for task, done in told for event in (Event(task, "told", done), Event(task, "ended"))]

    def end(self, task: int) -> None:
        self._waiting = [(number, one) for number, one in self._waiting if number != task]

    def stop(self) -> list[Any]:
        return []


def _drive(captures: int, place: Path | None = None) -> float:
    """Drive so many captures to their table and page; the peak of this process' memory in megabytes."""
    import resource

    from kronc_ns.fleet.driver import drive

    with TemporaryDirectory(prefix="kronc-bench-fleet-") as own:
        folder = place or Path(own)
        job = make_job(place_of(f"{folder}/captures"), place_of(f"{folder}/out"), _QUICK)
        drive(job, _MadeUp(), [f"{i}/" for i in range(captures)])
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def _row(i: int) -> Row:
    """Of a made-up capture."""
    status = "converged" if i % 50 else ("error", "weak", "failed")[i // 50 % 3]
    spread = 1 + (i * 7919 % 1000) / 1000
    return Row(
        capture=f"{i}", path=f"s3://inspections/captures/2026-01-31/vehicle_{i:09d}_walk_around", kind="keypoints",
        status=status, views=60, solved=60 - i % 3, rmse_px=spread, median_px=0.8 * spread,
        reason=f"{60 - i % 3} of 60 views solved; median reprojection error {0.8 * spread:.2f} px (0.20 % of the image "
        "diagonal); start: template", sigma_rot_deg=0.2 * spread, sigma_trans_m=0.02 * spread, focal_px=400.0,
        seconds=0.1 * spread, fetch_s=0.01, work_s=0.08 * spread, upload_s=0.01, bytes_in=90_000, bytes_out=200_000,
        node=f"node{i % 40}/{i % 40:08x}", version="0.1.0", inputs=f"{i * 2654435761 % 2**64:064x}",
        listed=f"{i * 40503 % 2**64:064x}", thumbnail="thumbnail.svg", has_report=True, finished=1.7e9 + i,
    )  # fmt: skip


def _in_a_process(function: Callable[[int], float], argument: int) -> float:
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(function, (argument,))


def _captures(folder: Path, captures: int, seed: int) -> Path:
    """Walks with keypoints; beyond the first twenty they are copies."""
    for i in range(captures):
        target = folder / f"c{i:05d}"
        if i < _MODELS:
            write_capture(target, make_capture("walk", _VIEWS, 1000 * seed + i, noise_px=1.0))
        else:
            shutil.copytree(folder / f"c{i % _MODELS:05d}", target)
    return folder


def _together(data: Path, out: Path) -> None:
    """What a fleet does with them, by `solve_scenes` on two threads of a process of its own."""
    code = (
        "import os, sys; os.cpu_count = lambda: 2\n"
        "from pathlib import Path; from kronc_ns.commands.batch import solve_folders\n"
        "from kronc_ns.fit.options import KroncConfig\n"
        "sys.exit(solve_folders(sorted(Path(sys.argv[1]).iterdir()), Path(sys.argv[2]), KroncConfig()))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(data), str(out)], capture_output=True, text=True, check=False
    )
    if done.returncode not in (0, 3):
        raise KroncError(f"solve_scenes fails ({done.returncode}): {done.stderr[-300:]}")


def _are_same(one: Path, other: Path) -> bool:
    """Whether two results have the same poses, to what threads of other numbers may differ in."""
    poses, others = read_poses(one / "transforms.json"), read_poses(other / "transforms.json")
    return len(poses) == len(others) and bool(np.allclose([*poses.values()], [*others.values()], atol=_SAME))


@contextmanager
def _cluster(nodes: int = 2) -> Iterator[str]:
    """A Ray cluster of nodes of one CPU, in processes of this machine; its address."""
    from kronc_ns.fleet.cluster import import_ray, light_imports

    import_ray()
    from ray.cluster_utils import Cluster

    node = {"num_cpus": 1, "object_store_memory": 80 << 20, "include_dashboard": False}
    with light_imports():
        cluster = Cluster(initialize_head=True, head_node_args={**node, "no_monitor": True})
        for _ in range(nodes - 1):
            cluster.add_node(**node)
    try:
        yield str(cluster.address)
    finally:
        cluster.shutdown()


@contextmanager
def _killing() -> Iterator[list[int]]:
    """Kill a worker of the fleet every ten seconds; which."""
    killed: list[int] = []
    over = threading.Event()

    def kill() -> None:
        while not over.wait(_KILL_EVERY_S):
            for process in Path("/proc").glob("[0-9]*"):
                try:
                    if b"ray::kronc_fleet" in (process / "cmdline").read_bytes():
                        os.kill(int(process.name), signal.SIGKILL)
                        killed.append(int(process.name))
                        break
                except OSError:  # it has ended
                    continue

    killer = threading.Thread(target=kill)
    killer.start()
    try:
        yield killed
    finally:
        over.set()
        killer.join()
