"""One step of Adam on a tensor, and the gradient of a grid's total variation.

See docs/method.md#optimiser and #total-variation.
"""

import torch
import warp as wp
from torch import Tensor

from devrf.kernels.runtime import cached_kernel, is_supported, launch, row_type
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

    ``rows`` (K,), int32, are the only voxels with a gradient, and the only ones that are read; they
    need ``skip_zero``. None: all voxels.
    """
    if not is_supported(values):
        definition.adam_step(values, gradient, mean, square, rule)
        return
    # A voxel of a grid, or one number.
    channels = values.shape[-1] if values.ndim == 4 else 1
    tables = [each.view(-1, channels) for each in (values, gradient, mean, square)]
    indices = torch.empty(0, dtype=torch.int32, device=values.device) if rows is None else rows
    rates = rule.per_voxel_lr
    factors = values.new_empty(0) if rates is None else rates.reshape(-1)
    count = values.numel() // channels if rows is None else len(rows)
    run = RUN if values.is_cpu else 1
    beta1, beta2 = rule.betas
    first, second = rule.corrections
    inputs = [count, run, rule.rate / first, 1 / second, beta1, beta2, rule.eps]
    inputs += [int(rule.skip_zero), *tables, indices, factors]
    grain = GRAIN_OF_VOXELS // run
    launch(adam_kernel(channels), -(-count // run), inputs, values.device, grain=grain)


def add_total_variation_gradient(
    grid: Tensor,
    gradient: Tensor,
    weight: float,
    *,
    along_z: float = 1.0,
    bound: float = 1.0,
    touched_only: bool = False,
) -> None:
    """As :func:`devrf.ops.adam.add_total_variation_gradient`; both tensors are contiguous."""
    if not is_supported(grid):
        definition.add_total_variation_gradient(
            grid, gradient, weight, along_z=along_z, bound=bound, touched_only=touched_only
        )
        return
    x, y, z, channels = grid.shape
    tables = [each.view(-1, channels) for each in (grid, gradient)]
    inputs = [x, y, z, weight, along_z, bound, int(touched_only), *tables]
    kernel = total_variation_kernel(channels)
    launch(kernel, x * y * z, inputs, grid.device, grain=GRAIN_OF_VOXELS)


@cached_kernel
def adam_kernel(channels: int) -> wp.Kernel:
    """A step on voxels of so many numbers."""
    numbers = row_type(channels)

    @wp.kernel(module="unique", enable_backward=False)
    def adam_step(
        first: int,
        count: int,
        run: int,
        rate: float,
        second: float,
        beta1: float,
        beta2: float,
        eps: float,
        skip_zero: int,
        values: wp.array(dtype=numbers),
        gradient: wp.array(dtype=numbers),
        mean: wp.array(dtype=numbers),
        square: wp.array(dtype=numbers),
        rows: wp.array(dtype=int),
        factors: wp.array(dtype=float),
    ):
        """A step on ``run`` of ``count`` voxels: those of ``rows``, if there are any, or all.

        ``rate`` is the learning rate / (1 − β₁ᵗ), ``second`` is 1 / (1 − β₂ᵗ); ``factors`` of the
        rate are the voxels', if there are any.
        """
        start = (first + wp.tid()) * run
        for index in range(start, wp.min(start + run, count)):
            row = index
            if rows.shape[0] > 0:
                row = rows[index]
            g = gradient[row]
            if skip_zero == 1 and g == numbers():
                continue
            factor = rate
            if factors.shape[0] > 0:
                factor *= factors[row]
            m = mean[row]
            s = square[row]
            v = values[row]
            new_m = beta1 * m + (1.0 - beta1) * g
            new_s = beta2 * s + (1.0 - beta2) * wp.cw_mul(g, g)
            for c in range(wp.static(channels)):
                keep = skip_zero == 1 and g[c] == 0.0
                m[c] = wp.where(keep, m[c], new_m[c])
                s[c] = wp.where(keep, s[c], new_s[c])
                move = factor * new_m[c] / (wp.sqrt(new_s[c] * second) + eps)
                v[c] = wp.where(keep, v[c], v[c] - move)
            mean[row] = m
            square[row] = s
            values[row] = v
            gradient[row] = numbers()

    return adam_step


@cached_kernel
def total_variation_kernel(channels: int) -> wp.Kernel:
    """The gradient of the total variation, in voxels of so many numbers."""
    numbers = row_type(channels)

    @wp.kernel(module="unique", enable_backward=False)
    def add_total_variation(
        first: int,
        x: int,
        y: int,
        z: int,
        weight: float,
        along_z: float,
        bound: float,
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
        low = numbers(-bound)
        high = numbers(bound)
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
