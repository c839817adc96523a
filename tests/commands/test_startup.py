"""What a fresh process imports: torch takes 2 s, a solve of 100 views 12 ms."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

KRONC = "from kronc_ns.commands.main import main; main()"
NAME_IMPORTED = """
import sys
try:
    exec(sys.argv.pop(1))
except SystemExit as end:
    assert not end.code, end.code
print(*sorted({name.partition(".")[0] for name in sys.modules}), file=sys.stderr)
"""
NEVER = {"torch", "torchvision", "nerfstudio", "pandas"}
DRAWN = {"trimesh", "plotly", "cv2", "PIL", "jinja2"}
COMPILED = {"numba", "scipy", "yaml"}
"""numba brings the other two."""


def imported(*arguments: object, code: str = KRONC) -> set[str]:
    """Packages in memory after ``code`` with these arguments has ended well in a process of its own."""
    command = [sys.executable, "-c", NAME_IMPORTED, code, *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    return set(done.stderr.splitlines()[-1].split())


@pytest.fixture
def lap_folder(solved_lap_folder: Path, tmp_path: Path) -> Path:
    """A scene (walk) and its solution (out), to write to."""
    return Path(shutil.copytree(solved_lap_folder.parent, tmp_path / "lap"))


def test_the_package_itself_is_nothing():
    assert not imported(code="import kronc_ns; kronc_ns.__version__") & {"numpy", "jaxtyping", *NEVER, *COMPILED}


def test_the_public_names_know_no_torch():
    everything = "from kronc_ns import KroncConfig, KroncError, Scene, Solution, load_scene, solve_scene, solve_scenes"
    assert not imported(code=everything) & {*NEVER, *DRAWN}


@pytest.mark.parametrize("command", [[], ["solve"], ["bench"], ["detect"], ["convert-detector"]], ids=" ".join)
def test_help_needs_no_numbers(command):
    assert not imported(*command, "--help") & {"numpy", "jaxtyping", "rich", *NEVER, *DRAWN, *COMPILED}


def test_solve(lap_folder):
    shutil.rmtree(lap_folder / "walk/images")  # keypoints are enough
    found = imported("solve", "--data", lap_folder / "walk", "--output-dir", lap_folder / "new")
    assert (lap_folder / "new/kronc.json").exists()
    assert not found & {*NEVER, *DRAWN}


@pytest.mark.parametrize("form", [[], ["--json"]], ids=["table", "json"])
def test_eval(lap_folder, form):
    poses = ("--poses", lap_folder / "out/transforms.json", "--reference", lap_folder / "walk/reference.json")
    assert not imported("eval", *poses, *form) & {*NEVER, *DRAWN, *COMPILED}


@pytest.mark.parametrize("form", ["ply", "colmap"])
def test_export(lap_folder, form):
    assert not imported("export", "--data", lap_folder / "out", "--format", form) & {*NEVER, *DRAWN, *COMPILED}


def test_report(lap_folder):
    assert not imported("report", "--data", lap_folder / "out") & NEVER
    assert (lap_folder / "out/report.html").exists()


@pytest.mark.slow
def test_the_first_solve_on_a_machine_says_that_it_compiles_and_the_next_does_not(lap_folder, tmp_path):
    shutil.rmtree(lap_folder / "walk/images")

    def said() -> str:
        arguments = ("solve", "--data", str(lap_folder / "walk"), "--output-dir", str(tmp_path / "new"))
        command = [sys.executable, "-m", "kronc_ns.commands.main", *arguments]
        fresh = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "numba")}
        done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False, env=fresh)
        assert done.returncode == 0, done.stderr
        return done.stderr

    assert said() == "compiling the solver for this machine, once (about 10 s)\n"
    assert said() == ""
