"""Adam in one pass over a tensor, or over several; the gradient of a grid's total variation.

Each number is read and written once: value, gradient and two moments in, value and two moments
out. Gradients are zeroed only where they were not zero; with ``SKIP_ZERO`` the moments, too, are
read and written only there, and with ``ROWS`` only these rows are looked at.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from devrf.accel.blocks import blocks, launch, opacity

THREADS = 128
# Numbers of a program at most: 8 for each of its 128 threads.
LARGEST = 1024


def adam_step(
    values: Tensor, gradient: Tensor, mean: Tensor, square: Tensor, rule: Any, *, clear: bool
) -> None:
    """As devrf.ops.adam_step.adam_step."""
    factors, rows = rule.per_voxel_lr, rule.rows
    channels = 1 if factors is None and rows is None else values.shape[-1]
    length = values.numel() if rows is None else len(rows) * channels
    launch(
        adam_kernel,
        blocks(length, LARGEST),
        *(values, gradient, mean, square),
        values if factors is None else factors.contiguous(),
        *(values if rows is None else rows, rule.rate, rule.step),
        *(length, *_numbers(rule)),
        PER_VOXEL_LR=factors is not None,
        ROWS=rows is not None,
        SKIP_ZERO=rule.skip_zero,
        CLEAR=clear,
        CHANNELS=channels,
        WIDE=_is_wide(values),
        BLOCK=LARGEST,
    )


def adam_steps(tensors: Sequence[Sequence[Tensor]], rules: Sequence[Any]) -> None:
    """As devrf.ops.adam_step.adam_steps, of rules without options; gradients are set to zero."""
    rows = tuple(
        tuple(tensor.data_ptr() for tensor in (*four, rule.step))
        for four, rule in zip(tensors, rules, strict=True)
    )
    lengths = tuple(values.numel() for values, *_ in tensors)
    addresses, pieces = _table(rows, lengths, tensors[0][0].device)
    known = addresses, pieces, rules[0].rate
    launch(adam_several_kernel, len(pieces), *known, *_numbers(rules[0]), BLOCK=LARGEST)


def _numbers(rule: Any) -> tuple[float, ...]:
    """Shares, decays and epsilon, as :func:`moved` takes them."""
    beta1, beta2 = rule.betas
    return 1 - beta1, 1 - beta2, -math.log(beta1), -math.log(beta2), rule.eps


@lru_cache(maxsize=64)
def _table(
    rows: tuple[tuple[int, ...], ...], lengths: tuple[int, ...], device: torch.device
) -> tuple[Tensor, Tensor]:
    """Addresses (N, 5) of tensors, and the tensor, first number and length (P, 3) of each program.

    Kept on the device: to copy them there at every step, the host would wait for the device.
    """
    pieces = [
        (number, start, length)
        for number, length in enumerate(lengths)
        for start in range(0, length, LARGEST)
    ]
    with torch.inference_mode(False):
        return (
            torch.tensor(rows, dtype=torch.int64).to(device),
            torch.tensor(pieces, dtype=torch.int64).view(-1, 3).to(device),
        )


def add_total_variation_gradient(
    grid: Tensor, gradient: Tensor, weight: float, along_z: float, touched_only: bool
) -> None:
    """As devrf.ops.adam_step.add_total_variation_gradient."""
    length = grid.shape[2] * grid.shape[3]
    block = min(LARGEST, max(THREADS, int(triton.next_power_of_2(length))))
    launch(
        total_variation_kernel,
        grid.numel() // max(length, 1) * blocks(length, block),
        *(grid, gradient, length, *grid.shape[:2], weight, along_z),
        TOUCHED_ONLY=touched_only,
        CHANNELS=grid.shape[3],
        WIDE=_is_wide(grid),
        BLOCK=block,
    )


def _is_wide(values: Tensor) -> bool:
    """Whether indices into the tensor need 64 bits."""
    return values.numel() >= 2**31 - LARGEST


@triton.jit
def pull(values, at, value, stride, mask):
    """clamp(v − v', −1, 1) for the neighbour ``stride`` further on, 0 where there is none."""
    other = tl.load(values + at + stride, mask=mask, other=0.0)
    return tl.where(mask, tl.minimum(tl.maximum(value - other, -1.0), 1.0), 0.0)


@triton.jit(do_not_specialize=["x", "y"])
def total_variation_kernel(
    values,
    gradient,
    length,
    x,
    y,
    weight,
    along_z,
    TOUCHED_ONLY: tl.constexpr,
    CHANNELS: tl.constexpr,
    WIDE: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """gradient += weight · Σ clamp(v − v', −1, 1) over the six neighbours, of z times ``along_z``.

    A program stays in one row along z: no division for each number, except by constants.
    """
    program = tl.program_id(0).to(tl.int64) if WIDE else tl.program_id(0)
    pieces = tl.cdiv(length, BLOCK)
    row, number = program // pieces, (program % pieces) * BLOCK + tl.arange(0, BLOCK)
    mask = number < length
    at = row * length + number
    before = tl.load(gradient + at, mask=mask, other=0.0)
    if TOUCHED_ONLY:
        mask = mask & (before != 0.0)
    value = tl.load(values + at, mask=mask, other=0.0)
    # Broadcast to the block here: Triton's interpreter cannot broadcast a boolean scalar.
    i = row // y + number * 0
    j = row % y + number * 0
    slope = pull(values, at, value, CHANNELS, mask & (number + CHANNELS < length))
    slope += pull(values, at, value, -CHANNELS, mask & (number >= CHANNELS))
    slope *= along_z
    slope += pull(values, at, value, length, mask & (j < y - 1))
    slope += pull(values, at, value, -length, mask & (j > 0))
    slope += pull(values, at, value, y * length, mask & (i < x - 1))
    slope += pull(values, at, value, -y * length, mask & (i > 0))
    tl.store(gradient + at, before + weight * slope, mask=mask)


@triton.jit
def moved(g, mean, square, rate, step, at, mask, share1, share2, decay1, decay2, eps):
    """How far Adam moves the numbers at ``at`` against their gradients; updates their moments.

    share = 1 − β, decay = −log β, so that 1 − βᵗ = opacity(t·decay).
    """
    m = tl.load(mean + at, mask=mask, other=0.0)
    s = tl.load(square + at, mask=mask, other=0.0)
    m += share1 * (g - m)
    s += share2 * (g * g - s)
    tl.store(mean + at, m, mask=mask)
    tl.store(square + at, s, mask=mask)
    time = tl.load(step).to(tl.float32)
    size = tl.load(rate).to(tl.float32) / opacity(time * decay1)
    return size * m / (tl.sqrt(s / opacity(time * decay2)) + eps)


@triton.jit
def adam_kernel(
    values,
    gradient,
    mean,
    square,
    per_voxel_lr,
    rows,
    rate,
    step,
    length,
    share1,
    share2,
    decay1,
    decay2,
    eps,
    PER_VOXEL_LR: tl.constexpr,
    ROWS: tl.constexpr,
    SKIP_ZERO: tl.constexpr,
    CLEAR: tl.constexpr,
    CHANNELS: tl.constexpr,
    WIDE: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """One step; the numbers of its rule as for :func:`moved`."""
    program = tl.program_id(0).to(tl.int64) if WIDE else tl.program_id(0)
    at = program * BLOCK + tl.arange(0, BLOCK)
    mask = at < length
    if ROWS:
        row = tl.load(rows + at // CHANNELS, mask=mask, other=0)
        at = (row.to(tl.int64) if WIDE else row) * CHANNELS + at % CHANNELS
    g = tl.load(gradient + at, mask=mask, other=0.0)
    touched = mask & (g != 0.0)
    active = touched if SKIP_ZERO else mask
    value = tl.load(values + at, mask=active, other=0.0)
    if CLEAR:
        tl.store(gradient + at, tl.zeros((BLOCK,), dtype=tl.float32), mask=touched)
    move = moved(g, mean, square, rate, step, at, active, share1, share2, decay1, decay2, eps)
    if PER_VOXEL_LR:
        move *= tl.load(per_voxel_lr + at // CHANNELS, mask=active, other=0.0)
    tl.store(values + at, value - move, mask=active)


@triton.jit
def adam_several_kernel(
    addresses, pieces, rate, share1, share2, decay1, decay2, eps, BLOCK: tl.constexpr
):
    """A piece of one of several tensors; as :func:`adam_kernel` without its options."""
    program = tl.program_id(0)
    tensor = tl.load(pieces + program * 3)
    at = tl.load(pieces + program * 3 + 1) + tl.arange(0, BLOCK)
    mask = at < tl.load(pieces + program * 3 + 2)
    record = addresses + tensor * 5
    values = tl.load(record).to(tl.pointer_type(tl.float32))
    gradient = tl.load(record + 1).to(tl.pointer_type(tl.float32))
    mean = tl.load(record + 2).to(tl.pointer_type(tl.float32))
    square = tl.load(record + 3).to(tl.pointer_type(tl.float32))
    step = tl.load(record + 4).to(tl.pointer_type(tl.float64))
    g = tl.load(gradient + at, mask=mask, other=0.0)
    tl.store(gradient + at, tl.zeros((BLOCK,), dtype=tl.float32), mask=mask & (g != 0.0))
    move = moved(g, mean, square, rate, step, at, mask, share1, share2, decay1, decay2, eps)
    before = tl.load(values + at, mask=mask, other=0.0)
    tl.store(values + at, before - move, mask=mask)
