"""How fast a device is, found by trying: the yardstick for what runs on it."""

from __future__ import annotations

import time
from collections.abc import Callable

import torch

# 128 MB: more than any cache holds.
COPIED = 2**25
# A batch of samples through a layer of the colour network.
ROWS, WIDTH = 2**16, 128


def copy_speed(device: torch.device, numbers: int = COPIED) -> float:
    """Bytes a second that a large copy reads and writes together."""
    values = torch.zeros(numbers, device=device)
    into = torch.empty_like(values)
    return 2 * values.element_size() * numbers / _best(lambda: into.copy_(values), device)


def product_speed(device: torch.device, rows: int = ROWS) -> float:
    """Operations a second of products (rows, 128) · (128, 128) in float32, as torch is set."""
    left, right = (torch.ones(n, WIDTH, device=device) for n in (rows, WIDTH))
    into = torch.empty_like(left)
    return 2 * rows * WIDTH**2 / _best(lambda: torch.mm(left, right, out=into), device)


def _best(work: Callable[[], object], device: torch.device, tries: int = 5) -> float:
    """Seconds of the quickest of some tries; on a GPU each is long enough to hide its launch."""
    times, often = [], 20 if device.type == "cuda" else 1
    for _ in range(tries + 1):  # the first one warms up
        wait(device)
        start = time.perf_counter()
        for _ in range(often):
            work()
        wait(device)
        times.append((time.perf_counter() - start) / often)
    return min(times[1:])


def wait(device: torch.device) -> None:
    """Until the device has done all that it was told."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
