"""The cache on disk: fresh when any compiled source changes, and never in the way."""

import importlib.util
import json
import os
import pickle
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numba
import pytest
from numba.core.caching import IndexDataCacheFile

import kronc_ns
from kronc_ns.solve import compiled as module
from kronc_ns.solve.compiled import compiled, is_compiled

PACKAGE = Path(kronc_ns.__file__).parent
PROBE = """
import json
import numpy as np
from kronc_ns.solve import records, schur
from kronc_ns.solve.compiled import is_compiled
from kronc_ns.solve.problem import Problem, ShapePrior, State

problem = Problem(np.zeros((1, 2, 2)), np.ones((1, 2)), (400.0, 390.0), ShapePrior.of(np.zeros((2, 3)), np.eye(6)))
state = State(np.eye(3)[None], np.array([[0.0, 0.0, 3.0]]), np.array([[1.0, 2.0, 0.0], [0.0, 0.0, -5.0]]))
data = records.measured(problem)
now, ready = records.estimate(data, state), is_compiled(schur.evaluate)
{before}
schur.evaluate(data, now)
hits = sum(schur.evaluate.stats.cache_hits.values())
print(json.dumps([now.length.tolist(), now.surprise.tolist(), ready, hits]))
"""
SEEN_PX = 292.1947600146


class Copy:
    """What of the package computes residuals, in a folder of its own, in processes of their own."""

    def __init__(self, folder: Path, **environment: str) -> None:
        self.folder = folder / "kronc_ns"
        for part in ("geometry", "solve"):
            shutil.copytree(PACKAGE / part, self.folder / part, ignore=shutil.ignore_patterns("__pycache__"))
        for part in ("__init__.py", "errors.py"):
            shutil.copy(PACKAGE / part, self.folder)
        # a changed source as old and as large as before would be taken for its bytecode
        self.environment = {**os.environ, "PYTHONDONTWRITEBYTECODE": "1", **environment}

    def residuals(self, before: str = "", processes: int = 1) -> tuple[list[float], float, bool, int]:
        """Lengths of a point before and one behind the camera, the surprise, whether it was ready, hits."""
        running = [
            subprocess.Popen(
                [sys.executable, "-c", PROBE.format(before=before)],
                cwd=self.folder.parent,
                env=self.environment,
                stdout=subprocess.PIPE,
                text=True,
            )
            for _ in range(processes)
        ]
        outputs = [process.communicate(timeout=120)[0] for process in running]
        assert [process.returncode for process in running] == [0] * processes
        assert len(set(outputs)) == 1
        length, (surprise,), ready, hits = json.loads(outputs[0])
        return length, surprise, ready, hits

    def edit(self, file: str, old: str, new: str) -> None:
        path = self.folder / file
        text = path.read_text()
        assert text.count(old) == 1
        path.write_text(text.replace(old, new))


def test_changes_of_what_is_called_are_noticed_whatever_file_it_is_in(tmp_path):
    """A constant and a formula that are inlined, and a compiled function."""
    copy = Copy(tmp_path, NUMBA_CACHE_DIR=str(tmp_path / "cache"))
    first = copy.residuals()
    assert first == ([pytest.approx(SEEN_PX), 1e4], 30.0, False, 0)
    assert copy.residuals() == (*first[:2], True, 1)
    copy.edit("solve/projection.py", "BEHIND_PX = 1e4", "BEHIND_PX = 2e4")
    copy.edit("solve/projection.py", "return fx * (u * growth), fy *", "return 2.0 * fx * (u * growth), 2.0 * fy *")
    assert copy.residuals() == ([pytest.approx(2 * SEEN_PX), 2e4], 30.0, False, 0)
    copy.edit("solve/linear.py", "total += x[k] * y[k]", "total += 3.0 * x[k] * y[k]")
    assert copy.residuals()[1:] == (90.0, False, 0)


def test_processes_that_compile_at_the_same_time_do_not_disturb_each_other(tmp_path):
    copy = Copy(tmp_path, NUMBA_CACHE_DIR=str(tmp_path / "cache"))
    first = copy.residuals(processes=2)
    assert first[:2] == ([pytest.approx(SEEN_PX), 1e4], 30.0)
    assert copy.residuals() == (*first[:2], True, 1)


def test_it_works_where_nothing_can_be_kept(tmp_path):
    nowhere = "/dev/null/cache"
    copy = Copy(tmp_path, NUMBA_CACHE_DIR=nowhere, XDG_CACHE_HOME=nowhere, HOME=nowhere)
    (copy.folder / "solve/__pycache__").write_text("no folder")
    assert copy.residuals() == ([pytest.approx(SEEN_PX), 1e4], 30.0, False, 0)


GONE = """
import shutil
shutil.rmtree({folder!r})
open({folder!r}, "w").close()
"""
FULL = """
import resource
resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
import sys
sys.stdout = open("/dev/fd/1", "w")
"""


@pytest.mark.parametrize("trouble", [GONE, FULL], ids=["gone", "full"])
def test_a_cache_that_cannot_be_written_any_more_is_done_without(tmp_path, trouble):
    folder = str(tmp_path / "cache")
    copy = Copy(tmp_path, NUMBA_CACHE_DIR=folder)
    assert copy.residuals(trouble.format(folder=folder)) == ([pytest.approx(SEEN_PX), 1e4], 30.0, False, 0)


@pytest.fixture
def toy(tmp_path, monkeypatch) -> Callable[..., Callable[[float], float]]:
    """Writes a module with one function."""
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "cache"))

    def write(summand: float = 1.0) -> Callable[[float], float]:
        path = tmp_path / "toy.py"
        path.write_text(f"def square_and(x):\n    return x * x + {summand}\n")
        spec = importlib.util.spec_from_file_location("toy", path)
        assert spec is not None
        assert spec.loader is not None
        loaded = importlib.util.module_from_spec(spec)
        monkeypatch.setitem(sys.modules, "toy", loaded)
        spec.loader.exec_module(loaded)
        return loaded.square_and

    return write


def hits(function) -> int:
    return sum(function.stats.cache_hits.values())


def test_what_was_compiled_is_kept(toy):
    first = compiled(toy())
    assert not is_compiled(first)
    assert first(3.0) == 10.0
    assert is_compiled(first)
    again = compiled(toy())
    assert is_compiled(again)
    assert again(3.0) == 10.0
    assert (hits(first), hits(again)) == (0, 1)


def test_what_was_compiled_of_other_sources_is_not(toy, monkeypatch):
    compiled(toy())(3.0)
    monkeypatch.setattr(module, "_sources", lambda: "others")
    again = compiled(toy())
    assert not is_compiled(again)
    assert again(3.0) == 10.0
    assert hits(again) == 0


def test_an_interrupted_save_does_not_pass_old_code_off_as_new(toy, monkeypatch):
    compiled(toy())(3.0)
    changed = toy(summand=20.0)

    def interrupted(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(IndexDataCacheFile, "_save_data", interrupted)
        with pytest.raises(KeyboardInterrupt):
            compiled(changed)(3.0)
    for _ in range(2):
        assert compiled(changed)(3.0) == 29.0


def test_functions_of_numbers_and_of_tensors_are_plain_python_too():
    @module.formula
    def twice(x):
        return 2 * x

    assert twice("ab") == "abab"


GARBAGE: dict[str, Callable[[bytes], bytes]] = {
    "nothing": lambda content: b"",
    "half": lambda content: content[: len(content) // 2],
    "noise": lambda content: bytes(range(256)) * 4,
    "another object": lambda content: pickle.dumps(numba.__version__),
    "objects": lambda content: pickle.dumps(numba.__version__) + pickle.dumps([1, 2, 3]),
    "a class that is gone": lambda content: pickle.dumps(numba.__version__) + b"cnowhere\nGone\n.",
}


@pytest.mark.parametrize("kind", ["index", "data"])
@pytest.mark.parametrize("garbage", GARBAGE)
def test_garbage_is_compiled_anew_and_replaced(toy, tmp_path, kind, garbage):
    compiled(toy())(3.0)
    (path,) = (tmp_path / "cache").rglob("*.nbi" if kind == "index" else "*.nbc")
    path.write_bytes(GARBAGE[garbage](path.read_bytes()))
    anew = compiled(toy())
    assert not (kind == "index" and is_compiled(anew))
    assert anew(3.0) == 10.0
    assert hits(anew) == 0
    again = compiled(toy())
    assert is_compiled(again)
    assert again(3.0) == 10.0
    assert hits(again) == 1


@pytest.mark.parametrize("suffix", ["nbi", "nbc"])
def test_a_folder_in_the_place_of_a_file_is_done_without(toy, tmp_path, suffix):
    compiled(toy())(3.0)
    (path,) = (tmp_path / "cache").rglob(f"*.{suffix}")
    path.unlink()
    path.mkdir()
    for _ in range(2):
        anew = compiled(toy())
        assert anew(3.0) == 10.0
        assert hits(anew) == 0
