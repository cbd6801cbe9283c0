"""Compares the Triton kernels with PyTorch on a device, on small random inputs.

The tests compare the same pairs in Triton's interpreter; this check covers the device, the driver
and the compiler of the machine that runs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from devrf.errors import DevrfError
from devrf.ops.adam_step import AdamRule, adam_step, smooth_adam_step
from devrf.ops.compositing import composite_segments, sum_segments
from devrf.ops.corners import Triple
from devrf.ops.dispatch import Kind, using
from devrf.ops.search import Thresholds, find_samples
from devrf.ops.total_variation import add_total_variation_gradient
from devrf.ops.trilinear import interpolate
from devrf.ops.warped_depth import warped_depth

Results = tuple[Tensor, ...]
# Covers another order of summation, and the hardware's exponential.
TOLERANCE = 1e-4


class Draw:
    """Random numbers on a device, from a separate generator: the run's is not advanced."""

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self._generator = torch.Generator().manual_seed(0)

    def __call__(self, *shape: int) -> Tensor:
        """Uniform in [−1, 1]."""
        return (2 * torch.rand(shape, generator=self._generator) - 1).to(self.device)

    def leaf(self, *shape: int) -> Tensor:
        """The same, requiring gradients."""
        return self(*shape).requires_grad_()


@dataclass(frozen=True)
class _Box:
    low: Triple = (-1.0, -0.9, -0.8)
    high: Triple = (0.9, 1.0, 0.7)


def check_kernels(device: torch.device) -> None:
    """Compare both implementations of every function, gradients included.

    Raises:
        DevrfError: they differ; the message names the function.
        Exception: whatever Triton raises where it cannot work.
    """
    for case in CASES:
        pairs = zip(_run(case, "torch", device), _run(case, "triton", device), strict=True)
        for expected, found in pairs:
            if not torch.allclose(found, expected, rtol=TOLERANCE, atol=TOLERANCE):
                name = case.__name__.replace("_", " ")
                raise DevrfError(f"{name}: off by {(found - expected).abs().max().item():.2g}")


def _run(case: Callable[[Draw], Results], kind: Kind, device: torch.device) -> list[Tensor]:
    with using(kind), torch.inference_mode(False), torch.enable_grad():
        return [result.detach().float() for result in case(Draw(device))]


def interpolation(draw: Draw, channels: Sequence[int] = (3, 12)) -> Results:
    """Values and both gradients, for rows with and without vector loads."""
    results: list[Tensor] = []
    for width in channels:
        grid, coords = draw.leaf(4, 3, 5, width), (2 + 3 * draw(50, 3)).requires_grad_()
        values = interpolate(grid, coords)
        upstream = draw(50, width)
        results += [values, *torch.autograd.grad(values, (grid, coords), upstream)]
    return tuple(results)


def warped_depths(draw: Draw, frames: Sequence[int] = (1, 2)) -> Results:
    """At a frame, and between two."""
    results: list[Tensor] = []
    for count in frames:
        density, points = draw.leaf(4, 3, 5, 1), draw(50, 3)
        slices = [draw.leaf(3, 4, 3, 3) for _ in range(count)]
        q, tau = warped_depth(points, density, slices, 0.3, box=_Box(), shift=-1.0, delta=0.5)
        results += [q, tau]
        leaves = [density, *slices]
        up_q, up_tau = draw(50, 3), draw(50)
        loss = (q * up_q).sum() + (tau * up_tau).sum()
        results += torch.autograd.grad(loss, leaves)
    return tuple(results)


def sample_search(draw: Draw, frames: Sequence[int] = (1, 2)) -> Results:
    """Rays through a box that is partly occupied, at a frame, and between two."""
    results: list[Tensor] = []
    for moments in frames:
        origins, directions = 0.5 * draw(9, 3), torch.nn.functional.normalize(draw(9, 3), dim=1)
        count = (20 * draw(9)).clamp(min=0).long() * 2
        slices = [0.2 * draw(3, 4, 3, 3) for _ in range(moments)]
        found = find_samples(
            origins,
            directions,
            -1 + 0.1 * draw(9),
            count,
            draw(5, 4, 6) > -0.3,
            3 * draw(4, 3, 5, 1),
            slices,
            0.3,
            step=0.05,
            longest=40,
            capacity=40,
            mask_box=_Box(),
            box=_Box(),
            shift=-1.0,
            delta=0.5,
            thresholds=Thresholds(alpha=0.05, stop=0.05, weight=0.1),
        )
        results += [
            found.ray,
            found.distance,
            found.points,
            found.significant,
            found.first,
            found.total,
            found.overflow,
        ]
    return tuple(results)


def compositing(draw: Draw) -> Results:
    """Rays of several lengths, one without samples, padding behind the last."""
    lengths = torch.tensor([0, 3, 0, 40, 1, 33]).to(draw.device)
    first = lengths.cumsum(0)
    depth, values = draw.leaf(85), draw.leaf(85, 3)
    weights, end = composite_segments(depth.abs(), first)
    sums = sum_segments(weights, values, first)
    loss = (weights * draw(85)).sum() + (end * draw(5)).sum() + (sums * draw(5, 3)).sum()
    return weights, end, sums, *torch.autograd.grad(loss, (depth, values))


def total_variation(draw: Draw) -> Results:
    """The gradient added to entries that have one, and to all."""
    grid, gradient = 2 * draw(4, 3, 5, 3), draw(4, 3, 5, 3).clamp(min=0)
    add_total_variation_gradient(grid, gradient, 0.3, touched_only=True)
    before = gradient.clone()
    add_total_variation_gradient(grid, gradient, 0.3)
    return before, gradient


def adam(draw: Draw) -> Results:
    """Steps with and without the optional settings."""
    results: list[Tensor] = []
    for skip_zero in (False, True):
        factors = draw(4, 3, 5, 1).abs()
        rule = AdamRule(
            draw(1)[0].abs(),
            torch.full_like(factors[0, 0, 0, 0], 3.0),
            skip_zero=skip_zero,
            per_voxel_lr=factors if skip_zero else None,
        )
        values, gradient, mean = draw(4, 3, 5, 3), draw(4, 3, 5, 3).clamp(min=0), draw(4, 3, 5, 3)
        square, smooth = draw(4, 3, 5, 3).square() + 0.1, torch.zeros_like(values)
        again = gradient.clone()
        adam_step(values, gradient, mean, square, rule)
        smooth_adam_step(values, smooth, again, mean, square, rule, smoothing=0.3)
        results += [values, smooth, gradient, again, mean, square]
    return tuple(results)


CASES: tuple[Callable[[Draw], Results], ...] = (
    interpolation,
    warped_depths,
    sample_search,
    compositing,
    total_variation,
    adam,
)
