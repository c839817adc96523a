"""`kronc fleet` as a command: what it imports, prints and exits with."""

import subprocess
import sys

import pytest

from kronc_ns.fleet.queue import Bundle, Item, Queue
from kronc_ns.fleet.scratch import scratch_folder, sweep
from tests.fleet.conftest import fleet_command

IMPORTED = """
import sys
try:
    exec(sys.argv.pop(1))
except SystemExit:
    pass
print(*sorted({name.partition(".")[0] for name in sys.modules}), file=sys.stderr)
"""
KRONC = "from kronc_ns.commands.main import main; main()"


@pytest.mark.parametrize("command", [["--help"], ["fleet", "--help"]], ids=" ".join)
def test_help_imports_neither_ray_nor_numbers(command):
    done = subprocess.run(
        [sys.executable, "-c", IMPORTED, KRONC, *command], capture_output=True, text=True, check=True, timeout=120
    )
    found = set(done.stderr.splitlines()[-1].split())
    assert not found & {"ray", "fsspec", "pyarrow", "torch", "nerfstudio", "numpy", "cv2"}
    assert "fleet" in done.stdout


def test_the_package_alone_imports_nothing():
    code = "import kronc_ns.fleet"
    done = subprocess.run(
        [sys.executable, "-c", IMPORTED, code], capture_output=True, text=True, check=True, timeout=60
    )
    assert not set(done.stderr.split()) & {"ray", "fsspec", "pyarrow", "numpy"}


def _kronc_fleet_without(package, captures, tmp_path):
    code = f"import sys; sys.modules[{package!r}] = None; " + KRONC
    command = [sys.executable, "-c", code, *fleet_command("--captures", captures, "--output", tmp_path / "out")[3:]]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)


@pytest.mark.parametrize("package", ["fsspec", "pyarrow", "ray"])
def test_a_missing_extra_is_one_line(package, made_captures, tmp_path):
    done = _kronc_fleet_without(package, made_captures, tmp_path)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert done.stderr.startswith("error: ")
    assert package in done.stderr
    assert "kronc-ns[fleet]" in done.stderr
    assert not (tmp_path / "out").exists()


def test_without_ray_it_does_one_after_the_other_and_says_what_is_doubtful(captures, tmp_path, kronc_fleet):
    (captures / "b/keypoints.json").write_text("{")
    arguments = ("--captures", captures, "--output", tmp_path / "out", "--ray", "none", "--reports", "none")
    done = kronc_fleet(*arguments)
    assert (done.returncode, done.stderr.count("\n")) == (3, 1)
    assert done.stderr.startswith("error: b: b/keypoints.json is not valid JSON")
    assert done.stdout.splitlines()[-1] == f"{tmp_path / 'out'}/fleet.parquet"
    again = kronc_fleet(*arguments)
    assert (again.returncode, again.stdout) == (2, "")
    assert "--resume" in again.stderr


# ---- what is next


def test_small_captures_are_bundled_by_the_time_they_take():
    queue = Queue((Item(f"{i}/") for i in range(10_000)), 10_000)
    assert len(queue.take(2).items) == 4
    queue.learn(0.4, 4)
    assert len(queue.take(2).items) == 20, "two seconds"
    queue.learn(1e-3, 1000)
    sizes = []
    while not queue.is_empty:
        sizes.append(len(queue.take(2).items))
    assert max(sizes) <= 512
    assert sum(sizes) == 10_000 - 24
    assert sizes[-1] == sizes[-2] == 1, "the last ones are for all workers"


def test_those_with_images_go_one_by_one_and_first():
    queue = Queue(iter([Item("a/"), Item("b/")]), 2)
    queue.put_large(Item("c.mp4"))
    assert queue.next_is_large()
    assert queue.take(1) == Bundle((Item("c.mp4"),), large=True)
    assert not queue.next_is_large()
    queue.put_again(Bundle(tuple(Item(f"{i}/") for i in range(5))).halves())
    taken = [queue.take(1) for _ in range(4)]
    assert [len(bundle.items) for bundle in taken] == [1, 1, 3, 2]
    assert queue.is_empty


# ---- scratch


def test_scratch_of_the_living_stays_and_that_of_the_dead_goes(tmp_path):
    code = (
        "import sys, time; from pathlib import Path; from kronc_ns.fleet.scratch import scratch_folder\n"
        "with scratch_folder(Path(sys.argv[1])) as folder:\n"
        "    (folder / 'data').write_bytes(bytes(10)); print('made', flush=True); time.sleep(60)"
    )
    other = subprocess.Popen([sys.executable, "-c", code, str(tmp_path)], stdout=subprocess.PIPE)
    assert other.stdout is not None
    other.stdout.readline()
    with scratch_folder(tmp_path) as folder:
        assert sweep(tmp_path) == 0
        assert folder.exists()
        assert len(list(tmp_path.iterdir())) == 2
        other.kill()
        other.wait()
        assert sweep(tmp_path) == 1
    assert list(tmp_path.iterdir()) == []
