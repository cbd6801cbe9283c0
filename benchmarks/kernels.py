"""Milliseconds of each hot operation: in PyTorch, and in Triton on a CUDA device.

On random grids and rays of a given size; operations with gradients are timed forward and backward.
"""

from __future__ import annotations

from harness import parser, report

# isort: split
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.utils.benchmark import Timer

from devrf.cli.messages import report_user_errors
from devrf.geometry.box import Box
from devrf.ops.adam_step import (
    AdamRule,
    adam_step,
    add_total_variation_gradient,
    smooth_adam_step,
)
from devrf.ops.compositing import composite_colors, composite_segments
from devrf.ops.dispatch import Kind, triton_runs, using
from devrf.ops.search import Thresholds, find_samples
from devrf.ops.trilinear import interpolate
from devrf.ops.warped_depth import warped_depth

BOX = Box((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
CHANNELS = 12
SAMPLES_PER_RAY = 32


def main() -> None:
    """Time every operation in every implementation that runs on the device."""
    arguments = parser(__doc__, overrides=False)
    arguments.add_argument("--side", type=int, default=160, help="grid points along each axis")
    arguments.add_argument("--rays", type=int, default=8192, help=f"of {SAMPLES_PER_RAY} samples")
    arguments.add_argument("--seconds", type=float, default=1.0, help="of timing an operation")
    given = arguments.parse_args()
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    kinds: tuple[Kind, ...] = ("torch",)
    if triton_runs(torch.zeros(1, device=device)):
        kinds = ("torch", "triton")
    with report_user_errors():
        rows = []
        for name, work in operations(given.side, given.rays, device).items():
            row: dict[str, Any] = {"operation": name}
            for kind in kinds:
                row[f"{kind} ms"] = milliseconds(work, kind, given.seconds)
            if len(kinds) == 2:
                row["speed-up"] = row["torch ms"] / row["triton ms"]
            rows.append(row)
        into = given.json or Path("benchmark_kernels.json")
        report(rows, into, device, side=given.side, rays=given.rays)


def milliseconds(work: Callable[[], object], kind: Kind, seconds: float) -> float:
    """The median over calls of one implementation, without the first, which compiles."""
    with using(kind):
        work()
        timer = Timer("work()", globals={"work": work}, num_threads=torch.get_num_threads())
        return 1000 * float(timer.blocked_autorange(min_run_time=seconds).median)


def operations(side: int, rays: int, device: torch.device) -> Mapping[str, Callable[[], object]]:
    """The operations by name, each on tensors of its own.

    Args:
        side: grid points along each axis.
        rays: R; there are R · 32 samples.
        device: where the tensors are.
    """
    samples = rays * SAMPLES_PER_RAY
    generator = torch.Generator(device).manual_seed(0)

    def draw(*shape: int) -> Tensor:
        """Uniform in [−1, 1]."""
        return 2 * torch.rand(shape, generator=generator, device=device) - 1

    shape = side, side, side
    density, features, slices = draw(*shape, 1), draw(*shape, CHANNELS), draw(*shape, 3) / 10
    points, coords = draw(samples, 3), (side - 1) * (draw(samples, 3) + 1) / 2
    first = torch.arange(rays + 1, device=device) * SAMPLES_PER_RAY
    depth, colors, left = draw(samples).abs(), draw(samples, 3), draw(rays).abs()
    directions = torch.nn.functional.normalize(draw(rays, 3), dim=1)
    count = torch.full((rays,), 2 * side, device=device)
    grid, spare, gradient, mean = (draw(*shape, 3) for _ in range(4))
    square = draw(*shape, 3).square()
    rule = AdamRule(torch.tensor(1e-3, device=device), torch.tensor(9.0, device=device))
    common: dict[str, Any] = {"box": BOX, "shift": -2.0, "delta": 0.5}

    def search() -> object:
        return find_samples(
            -1.5 * directions,
            directions,
            torch.full((rays,), 0.5, device=device),
            count,
            density[..., 0] > 0,
            density,
            [slices],
            step=1 / side,
            longest=2 * side,
            capacity=samples,
            mask_box=BOX,
            thresholds=Thresholds(1e-3, 1e-4, 1e-3),
            **common,
        )

    return {
        "interpolate": with_gradients(interpolate, features, coords),
        "warped_depth": with_gradients(
            lambda density, slices: warped_depth(points, density, [slices], **common)[1],
            density,
            slices,
        ),
        "find_samples": search,
        "composite_segments": with_gradients(lambda tau: composite_segments(tau, first)[0], depth),
        "composite_colors": with_gradients(
            lambda weights, colors: composite_colors(weights, colors, depth, first, left, left[:3])[
                0
            ],
            depth,
            colors,
        ),
        "add_total_variation_gradient": lambda: add_total_variation_gradient(grid, gradient, 1e-6),
        "adam_step": lambda: adam_step(grid, gradient, mean, square, rule, clear=False),
        "smooth_adam_step": lambda: smooth_adam_step(
            grid, spare, gradient, mean, square, rule, smoothing=1e-6
        ),
    }


def with_gradients(operation: Callable[..., Tensor], *given: Tensor) -> Callable[[], object]:
    """Forward and backward, with the gradients of all ``given`` tensors."""
    leaves = [tensor.clone().requires_grad_() for tensor in given]

    def work() -> object:
        return torch.autograd.grad(operation(*leaves).sum(), leaves)

    return work


if __name__ == "__main__":
    main()
