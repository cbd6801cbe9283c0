"""Kernels that are compiled ahead are those that are launched."""

from __future__ import annotations

import threading

import torch

from devrf.geometry.box import Box
from devrf.kernels.adam import adam_kernel, adam_step
from devrf.kernels.ahead import compile_ahead
from devrf.kernels.look_up import add_kernel, look_up, look_up_kernel, slope_kernel
from devrf.ops.adam import AdamRule

CHANNELS = 5  # no other test's


def test_what_was_compiled_ahead_is_not_compiled_again() -> None:
    before = set(threading.enumerate())
    compile_ahead({CHANNELS}, torch.device("cpu"))
    for thread in set(threading.enumerate()) - before:
        thread.join()
    made = (look_up_kernel, slope_kernel, add_kernel, adam_kernel)
    modules = [make(CHANNELS).module for make in made]
    built = [set(module.execs) for module in modules]
    assert all(built)
    grid = torch.ones(2, 2, 2, CHANNELS, requires_grad=True)
    points = torch.full((1, 3), 0.5, requires_grad=True)
    look_up(grid, points, Box((0.0,) * 3, (1.0,) * 3)).sum().backward()
    assert grid.grad.sum() == CHANNELS and not points.grad.any()
    with torch.no_grad():
        adam_step(grid, grid.grad, torch.zeros_like(grid), torch.zeros_like(grid), AdamRule(0.1, 1))
    assert [set(module.execs) for module in modules] == built
