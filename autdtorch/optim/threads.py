"""How many threads of PyTorch a method uses."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import torch


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Have PyTorch work on one thread for a while; also a decorator.

    Where a method takes thousands of steps on small matrices, threads wait for each other at every step. If
    another program keeps one of the cores busy, that is many times slower (docs/decisions/identify.md).
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
