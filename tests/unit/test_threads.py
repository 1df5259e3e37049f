"""Threads of PyTorch and NumPy, kept to one each by several threads at once and across a fork."""

import os
import threading

import pytest
import torch
from threadpoolctl import threadpool_info

from autdtorch.utils import process


@pytest.fixture(autouse=True)
def four_threads(monkeypatch, set_threads):
    monkeypatch.setattr(process, "_processors", lambda: 8)
    set_threads(4)


def in_new_thread() -> int:
    found = []
    new = threading.Thread(target=lambda: found.append(torch.get_num_threads()))
    new.start()
    new.join()
    return found[0]


def test_torch_and_numpy_have_one_thread_inside_and_what_they_had_outside() -> None:
    with process.one_library_thread():
        assert torch.get_num_threads() == 1
        assert process.thread_count() == 4
        with process.one_library_thread():
            assert process.thread_count() == 4
        assert torch.get_num_threads() == 1
    assert torch.get_num_threads() == in_new_thread() == 4

    def counts() -> list[int]:
        return [library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"]

    before = counts()
    with process.one_library_thread():
        with process.one_library_thread():
            pass
        assert all(count == 1 for count in counts())
    assert counts() == before


def test_threads_that_leave_in_the_order_they_entered_leave_nothing_behind() -> None:
    entered, left = threading.Event(), threading.Event()
    seen = []

    def second() -> None:
        with process.one_library_thread():
            seen.append(process.thread_count())
            entered.set()
            left.wait(10)

    other = threading.Thread(target=second)
    with process.one_library_thread():
        other.start()
        assert entered.wait(10)
    left.set()
    other.join()
    assert seen == [4]
    assert torch.get_num_threads() == in_new_thread() == 4


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no forks here")
@pytest.mark.filterwarnings("ignore:.*multi-threaded:DeprecationWarning")
def test_a_child_has_one_thread_also_after_leaving_what_its_parent_had_entered() -> None:
    with process.one_library_thread():
        child = os.fork()
    if child == 0:
        libraries = [each["num_threads"] for each in threadpool_info() if each["user_api"] == "blas"]
        os._exit(max(torch.get_num_threads(), *libraries))
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 1
    assert torch.get_num_threads() == 4
