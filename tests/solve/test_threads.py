"""Threads take turns, but for what needs no interpreter."""

import threading
from concurrent.futures import ThreadPoolExecutor

import torch

from kronc_ns.solve.threads import aside, one_thread, turn


def test_one_thread_gives_back_what_there_was():
    threads = torch.get_num_threads()
    with one_thread():
        assert torch.get_num_threads() == in_another_thread() == 1
    assert torch.get_num_threads() == in_another_thread() == threads


def in_another_thread() -> int:
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(torch.get_num_threads).result()


def test_another_thread_has_its_turn_only_while_the_first_is_aside():
    lock, first_is_in, second_was_in = threading.Lock(), threading.Event(), threading.Event()

    def second() -> None:
        first_is_in.wait(5)
        with turn(lock):
            second_was_in.set()

    other = threading.Thread(target=second)
    other.start()
    with turn(lock):
        first_is_in.set()
        assert not second_was_in.wait(0.1)
        with aside():
            assert second_was_in.wait(5)
        assert lock.locked()
    other.join()
    assert not lock.locked()


def test_an_error_aside_ends_the_turn():
    lock = threading.Lock()
    try:
        with turn(lock), aside():
            raise ValueError
    except ValueError:
        pass
    assert not lock.locked()
