"""What the row of interruptions measures: commands killed at random moments, and what is found afterwards."""

import os
import shutil
import subprocess
import sys
import time
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
from PIL import Image

from kronc_ns.benchmark.figures import Figures
from kronc_ns.errors import KroncError
from kronc_ns.files.record import read_solution
from kronc_ns.solution import Solution
from kronc_ns.synthetic.folder import write_capture
from kronc_ns.synthetic.scenes import make_capture

_VIEWS, _SEED = 30, 1
_CACHE = (
    "import sys; from pathlib import Path; from kronc_ns.files.cache import solve_cached;"
    "from kronc_ns.files.scene_folder import load_scene; from kronc_ns.fit.options import KroncConfig;"
    "data = Path(sys.argv[1]); print(solve_cached(data, load_scene(data), KroncConfig(), None))"
)
"""What `kronc-dataparser` does before training."""
_KINDS = ("solve", "process-data", "cache")


def killed(seed: int) -> Figures:
    """One command, killed without a warning at a random moment of its run, and run again.

    Counts whether it was killed at all, whether a result stood there that was not whole, and whether the next run
    failed or gave another result than an undisturbed one.
    """
    rng, kind = np.random.default_rng([seed, 9]), _KINDS[seed % len(_KINDS)]
    with TemporaryDirectory(prefix="kronc-killed-") as place:
        data, out = Path(place) / "data", Path(place) / "out"
        shutil.copytree(_capture(), data)
        whole, seconds = _undisturbed(kind)
        process = _start(kind, data, out)
        time.sleep(rng.uniform(0, seconds))
        process.kill()
        was_killed = process.wait() != 0
        half = _is_half(kind, out, whole)
        again = _start(kind, data, out)
        failed = again.wait() != 0 or not _is_same(_result(kind, out), whole)
    return {"killed": float(was_killed), "half_taken_for_whole": float(half), "next_run_failed": float(failed)}


@lru_cache(maxsize=1)
def _capture() -> Path:
    """A capture with images of noise; it stays until the process ends."""
    folder = TemporaryDirectory(prefix="kronc-capture-")
    _kept.append(folder)
    data = Path(folder.name) / "data"
    capture = make_capture("walk", _VIEWS, _SEED, noise_px=1.0)
    write_capture(data, capture)
    (data / "images").mkdir()
    rng, camera = np.random.default_rng(_SEED), capture.camera
    for i in range(_VIEWS):
        picture = rng.integers(0, 255, (camera.height, camera.width, 3), dtype=np.uint8)
        cv2.imwrite(str(data / f"images/frame_{i + 1:05d}.png"), picture)
    return data


_kept: list[TemporaryDirectory[str]] = []


@lru_cache(maxsize=len(_KINDS))
def _undisturbed(kind: str) -> tuple[Solution, float]:
    """The result of a command that nobody kills, and how long it takes once everything is compiled."""
    with TemporaryDirectory(prefix="kronc-whole-") as place:
        for name in ("first", "second"):
            begin = time.perf_counter()
            if _start(kind, _capture(), Path(place) / name).wait():
                raise KroncError(f"{kind} fails also where nobody kills it")
        seconds = time.perf_counter() - begin
        found = _result(kind, Path(place) / "second")
    assert found is not None
    return found, seconds


def _start(kind: str, data: Path, out: Path) -> subprocess.Popen[bytes]:
    here, folders = Path(sys.executable).parent, ["--data", str(data), "--output-dir", str(out)]
    command = {
        "solve": [here / "kronc", "solve", *folders],
        "process-data": [here / "kronc-process-data", *folders],
        "cache": [sys.executable, "-c", _CACHE, str(data)],
    }[kind]
    environment = {**os.environ, "KRONC_NS_CACHE": str(out)}
    return subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def _result(kind: str, out: Path) -> Solution | None:
    """What stands in the output for a whole result; None where nothing does."""
    folders = [out] if kind != "cache" else [*out.iterdir()] if out.is_dir() else []
    for folder in folders:
        if (folder / "kronc.json").exists():
            return read_solution(folder)[1]
    return None


def _is_half(kind: str, out: Path, whole: Solution) -> bool:
    """Whether something stands there for a result and is not the whole of it."""
    try:
        found = _result(kind, out)
    except KroncError:
        return True
    if found is None:
        return False
    if kind == "process-data":
        for name in found.names:
            try:
                with Image.open(out / name) as image:
                    image.load()
            except OSError:
                return True
    return not _is_same(found, whole)


def _is_same(found: Solution | None, whole: Solution) -> bool:
    return found is not None and np.array_equal(found.c2w, whole.c2w, equal_nan=True)
