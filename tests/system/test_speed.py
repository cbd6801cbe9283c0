"""A device's speeds, with a clock that is set by hand."""

from __future__ import annotations

import itertools
import time

import pytest
import torch

from devrf.system.speed import copy_speed, product_speed

CPU = torch.device("cpu")


def test_bytes_and_operations_by_the_quickest_try(monkeypatch: pytest.MonkeyPatch) -> None:
    # Tries last 1, 4, 2, 4, 4 and 4 seconds; the first one only warms up.
    lengths = itertools.cycle([1.0, 4.0, 2.0, 4.0, 4.0, 4.0])
    clock = itertools.accumulate(x for length in lengths for x in (0.0, length))
    monkeypatch.setattr(time, "perf_counter", lambda: next(clock))
    # 1000 float32 are read and written: 8000 bytes in 2 seconds.
    assert copy_speed(CPU, 1000) == 4000
    # A product and a sum for each of 10 x 128 x 128.
    assert product_speed(CPU, 10) == 2 * 10 * 128 * 128 / 2


def test_a_real_device_is_faster_than_nothing() -> None:
    assert copy_speed(CPU, 2**16) > 1e6 and product_speed(CPU, 64) > 1e5
