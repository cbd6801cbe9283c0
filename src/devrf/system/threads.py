"""The number of torch's threads in a part of a program."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def one_thread() -> Iterator[None]:
    """PyTorch on one thread inside, on as many as before afterwards.

    For many operations too small for two: a second thread gains little, and where the cores are
    shared with others it waits at each of them, which takes several times as long.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
