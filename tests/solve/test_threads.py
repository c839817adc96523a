"""Many scenes side by side in order; the parts of one at the same time, where nothing else runs."""

import os
import subprocess
import sys
import threading
import time

import pytest

from kronc_ns.solve import threads
from kronc_ns.solve.threads import in_parts, side_by_side

PATIENCE_S = 10.0


@pytest.fixture(autouse=True)
def four_cores(monkeypatch):
    """Whatever this machine has."""
    monkeypatch.setattr(os, "cpu_count", lambda: 4)
    threads._helpers.cache_clear()
    yield
    if threads._helpers.cache_info().currsize:
        threads._helpers().shutdown()
    threads._helpers.cache_clear()


def test_results_come_in_the_items_order_whichever_ends_first():
    def run(item: int) -> int:
        time.sleep(0.02 * (5 - item))
        return item * item

    assert list(side_by_side(run, range(6))) == [0, 1, 4, 9, 16, 25]


def test_nothing_side_by_side_is_nothing():
    assert list(side_by_side(str, [])) == []


def test_scenes_run_at_the_same_time():
    meeting = threading.Barrier(3, timeout=PATIENCE_S)
    assert sorted(side_by_side(lambda _: meeting.wait(), range(3))) == [0, 1, 2]


def test_an_error_of_one_scene_is_raised_in_its_turn():
    results = side_by_side(lambda item: 1 // item, [1, 0, 1])
    assert next(results) == 1
    with pytest.raises(ZeroDivisionError):
        next(results)


@pytest.mark.parametrize("parts", range(9))
def test_every_part_runs_once(parts):
    done = []
    in_parts(done.append, parts)
    assert sorted(done) == list(range(parts))


def test_parts_run_at_the_same_time():
    meeting = threading.Barrier(3, timeout=PATIENCE_S)
    in_parts(lambda part: meeting.wait(), 3)


def test_nothing_goes_on_before_all_parts_are_done():
    done = []

    def run(part: int) -> None:
        time.sleep(0.05 * part)
        done.append(part)

    in_parts(run, 3)
    assert done == [0, 1, 2]


@pytest.mark.parametrize("failing", range(3))
def test_an_error_of_any_part_is_raised(failing):
    def run(part: int) -> None:
        if part == failing:
            raise ValueError(part)

    with pytest.raises(ValueError, match=str(failing)):
        in_parts(run, 3)


def test_one_core_runs_parts_in_order(monkeypatch):
    monkeypatch.setattr(os, "cpu_count", lambda: 1)
    done = []
    in_parts(lambda part: done.append((part, threading.get_ident())), 3)
    assert done == [(part, threading.get_ident()) for part in range(3)]


def test_side_by_side_no_scene_is_split():
    def run(_: int) -> list[tuple[int, bool]]:
        here, done = threading.get_ident(), []
        in_parts(lambda part: done.append((part, threading.get_ident() == here)), 3)
        return done

    assert list(side_by_side(run, range(4))) == [[(part, True) for part in range(3)]] * 4
    meeting = threading.Barrier(3, timeout=PATIENCE_S)
    in_parts(lambda part: meeting.wait(), 3)  # and the caller's parts are, afterwards


def test_parts_of_parts_do_not_wait_for_each_other():
    """More of them than there are threads."""
    done = []
    worker = threading.Thread(
        target=in_parts, args=(lambda outer: in_parts(lambda inner: done.append((outer, inner)), 4), 4), daemon=True
    )
    worker.start()
    worker.join(PATIENCE_S)
    assert not worker.is_alive()
    assert sorted(done) == [(outer, inner) for outer in range(4) for inner in range(4)]


FORKED = """
import os
from kronc_ns.solve.threads import in_parts, side_by_side
os.cpu_count = lambda: 4

def parts():
    done = []
    in_parts(done.append, 4)
    return sorted(done)

def forked(_=None):
    child = os.fork()
    if child == 0:
        os._exit(0 if parts() == [0, 1, 2, 3] else 1)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])

assert parts() == [0, 1, 2, 3]
assert forked() == 0
assert list(side_by_side(forked, range(2))) == [0, 0]
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
def test_a_child_process_has_threads_of_its_own():
    subprocess.run([sys.executable, "-c", FORKED], check=True, timeout=60)
