"""Folders on a node for the time of a piece of work, removed also when its process was killed; and limits on it."""

import errno
import fcntl
import os
import resource
import shutil
import signal
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from kronc_ns.errors import KroncError

_PREFIX, _LOCK = "kronc-fleet-", ".lock"
_LOOK_S = 1.0
_GB = 1 << 30


def scratch_root(chosen: Path | None) -> Path:
    """Where scratch folders are made on this machine."""
    return Path(chosen or tempfile.gettempdir())


@contextmanager
def scratch_folder(root: Path) -> Iterator[Path]:
    """A new folder that nobody else sees, removed at the end; its lock says that its process lives."""
    folder = Path(tempfile.mkdtemp(prefix=_PREFIX, dir=root))
    lock = os.open(folder / ".new", os.O_CREAT | os.O_RDWR)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX)
        (folder / ".new").rename(folder / _LOCK)  # locked before anybody can find it unlocked
        (folder / "in").mkdir()
        yield folder / "in"
    finally:
        _remove(folder)
        os.close(lock)


def sweep(root: Path) -> int:
    """Remove the scratch folders of processes that were killed; how many."""
    swept = 0
    for folder in root.glob(f"{_PREFIX}*"):
        try:
            lock = os.open(folder / _LOCK, os.O_RDWR)
        except OSError:  # being made or removed, or another user's
            continue
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            _remove(folder)
            swept += 1
        except OSError:
            continue
        finally:
            os.close(lock)
    return swept


def _remove(folder: Path) -> None:
    """The lock goes last: whoever is killed at this is swept after."""
    shutil.rmtree(folder / "in", ignore_errors=True)
    shutil.rmtree(folder, ignore_errors=True)


def is_full(error: BaseException | None) -> bool:
    """Whether an error comes of a full disk, however often it was told anew."""
    while error is not None:
        if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
            return True
        error = error.__cause__ or error.__context__
    return False


def check_room(root: Path, wanted: int, limit_gb: float) -> None:
    """Raise `KroncError` for a capture that may not take so many bytes, `OSError` where the disk has not so many."""
    if wanted > limit_gb * _GB:
        raise KroncError(f"it has {wanted / _GB:.1f} GB, and --scratch-gb is {limit_gb:g}: raise it to do this capture")
    if shutil.disk_usage(root).free < wanted:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(root))


@contextmanager
def limits(folder: Path, memory_gb: float, scratch_gb: float) -> Iterator[None]:
    """Let what happens inside take so much more memory, and so much of the disk in ``folder``; else it fails.

    Memory that is beyond is refused to whoever asks (`MemoryError`). The disk is looked at every second, and an excess
    raised in the main thread, again and again until the work has ended; other threads have no such limit.
    """
    with _memory(memory_gb):
        if threading.current_thread() is not threading.main_thread():
            yield
            return

        def look(*_: object) -> None:
            if _size(folder) > scratch_gb * _GB:
                raise KroncError(f"it takes more disk than --scratch-gb {scratch_gb:g}: raise it to do this capture")

        before = signal.signal(signal.SIGALRM, look)
        signal.setitimer(signal.ITIMER_REAL, _LOOK_S, _LOOK_S)
        try:
            yield
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0)
            signal.signal(signal.SIGALRM, before)


@contextmanager
def _memory(limit_gb: float) -> Iterator[None]:
    """Limit the private memory of this process to so much more than it has now (on Linux, which tells)."""
    status = Path("/proc/self/status")
    if not status.exists():
        yield
        return
    has = next(int(line.split()[1]) << 10 for line in status.read_text().splitlines() if line.startswith("VmData"))
    soft, hard = resource.getrlimit(resource.RLIMIT_DATA)
    wanted = has + int(limit_gb * _GB)
    resource.setrlimit(resource.RLIMIT_DATA, (wanted if hard == resource.RLIM_INFINITY else min(wanted, hard), hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, (soft, hard))


def _size(folder: Path) -> int:
    total = 0
    for here, _, names in os.walk(folder):
        for name in names:
            try:
                total += os.lstat(os.path.join(here, name)).st_blocks * 512
            except OSError:  # renamed or removed meanwhile
                continue
    return total
