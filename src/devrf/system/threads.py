"""The number of torch's threads in a part of a program."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def one_thread() -> Iterator[None]:
    """PyTorch on one thread inside, on as many as before afterwards.

    It is for many small operations: a second thread gains little, and on cores that are shared with
    others it waits at each operation, which takes several times as long.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
