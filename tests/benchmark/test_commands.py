"""Commands that benchmarks run: none goes on when what ran it is over."""

import os
import signal
import time
from pathlib import Path

import pytest

from kronc_ns.benchmark.commands import Commands
from kronc_ns.errors import KroncError

WAIT = "import os, pathlib, sys, time; pathlib.Path(sys.argv[1]).write_text(str(os.getpid())); time.sleep(60)"


class Told(Exception):
    """What a signal raises."""


def is_running(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


def test_a_command_ends_with_what_waits_for_it(tmp_path: Path):
    note = tmp_path / "pid"

    def tell(*_):
        if note.exists() and note.read_text():  # it has begun, however long that took
            raise Told

    before = signal.signal(signal.SIGALRM, tell)
    signal.setitimer(signal.ITIMER_REAL, 0.1, 0.1)
    try:
        with pytest.raises(Told), Commands() as commands:
            commands.run("python", "-c", WAIT, str(note))
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
    until = time.monotonic() + 10
    while is_running(int(note.read_text())) and time.monotonic() < until:
        time.sleep(0.05)
    assert not is_running(int(note.read_text()))


def test_a_command_that_fails_says_its_last_lines():
    with Commands() as commands, pytest.raises(KroncError, match="status 3: the last word"):
        commands.run("python", "-c", "import sys; print('the last word'); sys.exit(3)")


def test_a_command_sees_its_environment():
    with Commands({"KRONC_TEST": "seen"}) as commands:
        assert commands.run("python", "-c", "import os; print(os.environ['KRONC_TEST'])").strip() == "seen"
    assert "KRONC_TEST" not in os.environ
