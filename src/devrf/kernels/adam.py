"""One step of Adam on a tensor, and the gradient of a grid's total variation.

See docs/method.md#optimiser and #total-variation.
"""

from functools import cache
from typing import Any

import torch
import warp as wp
from torch import Tensor

from devrf.kernels.runtime import array, launch, made_once, take
from devrf.ops import adam as definition
from devrf.ops.adam import AdamRule

# As ``GRAIN``, of voxels.
GRAIN_OF_VOXELS = 2**15
# Voxels that a thread steps one after another on a CPU, where each thread takes 7 ns to begin.
RUN = 64


def adam_step(
    values: Tensor,
    gradient: Tensor,
    mean: Tensor,
    square: Tensor,
    rule: AdamRule,
    rows: Tensor | None = None,
) -> None:
    """As :func:`devrf.ops.adam.adam_step`; all tensors are contiguous.

    Outside the voxels ``rows`` (K,), int32, if they are given, the gradient is zero and so is not
    read; with ``skip_zero``.
    """
    if not take(values):
        definition.adam_step(values, gradient, mean, square, rule)
        return
    first, second = rule.corrections
    step = AdamStep()
    step.rate = rule.rate / first
    step.beta1, step.beta2 = rule.betas
    step.second = 1.0 / second
    step.eps = rule.eps
    step.skip_zero = int(rule.skip_zero)
    # A voxel of a grid, or one number of a network.
    channels = values.shape[-1] if values.ndim == 4 else 1
    tables = [
        array(each.view(-1, channels), _numbers(channels))
        for each in (values, gradient, mean, square)
    ]
    # Arrays that are not read stand in for those that are not there.
    indices = array(torch.empty(0, dtype=torch.int32, device=values.device))
    rates = array(values.view(-1))
    count = values.numel() // channels
    if rows is not None:
        step.has_rows = 1
        indices = array(rows)
        count = len(rows)
    if rule.per_voxel_lr is not None:
        step.has_rates = 1
        rates = array(rule.per_voxel_lr.reshape(-1))
    step.count = count
    step.run = RUN if values.is_cpu else 1
    threads = -(-count // step.run)
    inputs = [step, *tables, indices, rates]
    grain = GRAIN_OF_VOXELS // step.run
    launch(adam_kernel(channels), threads, inputs, values.device, grain=grain)


def add_total_variation_gradient(
    grid: Tensor,
    gradient: Tensor,
    weight: float,
    *,
    along_z: float = 1.0,
    touched_only: bool = False,
) -> None:
    """As :func:`devrf.ops.adam.add_total_variation_gradient`; both tensors are contiguous."""
    if not take(grid):
        definition.add_total_variation_gradient(
            grid, gradient, weight, along_z=along_z, touched_only=touched_only
        )
        return
    x, y, z, channels = grid.shape
    tables = [array(each.view(-1, channels), _numbers(channels)) for each in (grid, gradient)]
    inputs = [x, y, z, weight, along_z, int(touched_only), *tables]
    kernel = total_variation_kernel(channels)
    launch(kernel, x * y * z, inputs, grid.device, grain=GRAIN_OF_VOXELS)


@wp.struct
class AdamStep:
    """Settings of a step.

    Attributes:
        count: of voxels that are looked at.
        run: how many of these a thread steps.
        rate: the learning rate / (1 − β₁ᵗ).
        second: 1 / (1 − β₂ᵗ).
        has_rows: 1 where only some voxels are looked at, else 0.
        has_rates: 1 where each voxel has a factor of the rate, else 0.
        beta1, beta2, eps, skip_zero: as of an ``AdamRule``.
    """

    count: int
    run: int
    rate: float
    second: float
    beta1: float
    beta2: float
    eps: float
    skip_zero: int
    has_rows: int
    has_rates: int


@cache
def _numbers(channels: int) -> Any:
    return wp.types.vector(length=channels, dtype=wp.float32)


@made_once
def adam_kernel(channels: int) -> wp.Kernel:
    """A step on voxels of so many numbers."""
    numbers = _numbers(channels)

    @wp.kernel(module="unique", enable_backward=False)
    def adam_step(
        first: int,
        step: AdamStep,
        values: wp.array(dtype=numbers),
        gradient: wp.array(dtype=numbers),
        mean: wp.array(dtype=numbers),
        square: wp.array(dtype=numbers),
        rows: wp.array(dtype=int),
        rates: wp.array(dtype=float),
    ):
        """A step on the numbers of some voxels."""
        start = (first + wp.tid()) * step.run
        for place in range(start, wp.min(start + step.run, step.count)):
            row = place
            if step.has_rows == 1:
                row = rows[place]
            g = gradient[row]
            if step.skip_zero == 1 and g == numbers():
                continue
            rate = step.rate
            if step.has_rates == 1:
                rate *= rates[row]
            m = mean[row]
            s = square[row]
            v = values[row]
            new_m = step.beta1 * m + (1.0 - step.beta1) * g
            new_s = step.beta2 * s + (1.0 - step.beta2) * wp.cw_mul(g, g)
            for c in range(wp.static(channels)):
                keep = step.skip_zero == 1 and g[c] == 0.0
                m[c] = wp.where(keep, m[c], new_m[c])
                s[c] = wp.where(keep, s[c], new_s[c])
                move = rate * new_m[c] / (wp.sqrt(new_s[c] * step.second) + step.eps)
                v[c] = wp.where(keep, v[c], v[c] - move)
            mean[row] = m
            square[row] = s
            values[row] = v
            gradient[row] = numbers()

    return adam_step


@made_once
def total_variation_kernel(channels: int) -> wp.Kernel:
    """The gradient of the total variation, in voxels of so many numbers."""
    numbers = _numbers(channels)

    @wp.kernel(module="unique", enable_backward=False)
    def add_total_variation(
        first: int,
        x: int,
        y: int,
        z: int,
        weight: float,
        along_z: float,
        touched_only: int,
        grid: wp.array(dtype=numbers),
        gradient: wp.array(dtype=numbers),
    ):
        """∂/∂v of Σ h(v − v') over the neighbours v' of the numbers v of one voxel."""
        row = first + wp.tid()
        k = row % z
        j = (row / z) % y
        i = row / (y * z)
        next_x = y * z
        low = numbers(-1.0)
        high = numbers(1.0)
        value = grid[row]
        slope = numbers()
        if i > 0:
            slope += wp.min(wp.max(value - grid[row - next_x], low), high)
        if i < x - 1:
            slope += wp.min(wp.max(value - grid[row + next_x], low), high)
        if j > 0:
            slope += wp.min(wp.max(value - grid[row - z], low), high)
        if j < y - 1:
            slope += wp.min(wp.max(value - grid[row + z], low), high)
        if k > 0:
            slope += along_z * wp.min(wp.max(value - grid[row - 1], low), high)
        if k < z - 1:
            slope += along_z * wp.min(wp.max(value - grid[row + 1], low), high)
        g = gradient[row]
        if touched_only == 1:
            for c in range(wp.static(channels)):
                slope[c] = wp.where(g[c] == 0.0, 0.0, slope[c])
        gradient[row] = g + weight * slope

    return add_total_variation
