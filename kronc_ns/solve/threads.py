"""How a solver uses the threads of the CPU."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager

import torch

_local = threading.local()


@contextmanager
def one_thread() -> Iterator[None]:
    """Compute on one CPU thread: the tensors are too small to share, and idle threads would only spin for the cores.

    So do threads that begin meanwhile.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


@contextmanager
def turn(lock: threading.Lock) -> Iterator[None]:
    """Compute in this thread only while holding ``lock``, but for what is done `aside`.

    Threads that run small tensor operations at the same time hand the interpreter back and forth at every one of them
    and are slower together than one after the other.
    """
    _local.lock = lock
    try:
        with lock:
            yield
    finally:
        del _local.lock


@contextmanager
def aside() -> Iterator[None]:
    """A compiled loop, which needs no interpreter: meanwhile another thread may have its `turn`."""
    lock = getattr(_local, "lock", None)
    if lock is None:
        yield
        return
    lock.release()
    try:
        yield
    finally:
        lock.acquire()
