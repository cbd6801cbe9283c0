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
from devrf.ops.adam_step import AdamRule, adam_step, add_total_variation_gradient
from devrf.ops.color_network import ColorNetwork, listed_colors
from devrf.ops.compositing import composite_colors, composite_segments
from devrf.ops.dispatch import Kind, triton_runs, using
from devrf.ops.motion import ListedSamples, SeenEarlier, motion_sum
from devrf.ops.photometric import photometric_sum
from devrf.ops.search import PackedSamples, Thresholds, find_samples, select_listed
from devrf.ops.trilinear import interpolate
from devrf.ops.warped_depth import warped_depth

BOX = Box((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
CHANNELS = 12
SAMPLES_PER_RAY = 32
# Of these, how many are coloured, and the colour network's hidden units and octaves.
COLORED_PER_RAY, WIDTH, OCTAVES = 16, 128, 4


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


def difference(work: Callable[[], object]) -> list[float]:
    """The largest difference of each gradient in both implementations, relative to its largest."""
    kinds: tuple[Kind, ...] = ("torch", "triton")
    results = []
    for kind in kinds:
        with using(kind):
            result = work()
        results.append(result if isinstance(result, tuple) else ())
    pairs = [(a, b) for a, b in zip(*results, strict=True) if isinstance(a, Tensor)]
    return [float((a - b).abs().max() / a.abs().max().clamp(min=1e-30)) for a, b in pairs]


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
    grid, gradient, mean = (draw(*shape, 3) for _ in range(3))
    square = draw(*shape, 3).square()
    rule = AdamRule(torch.tensor(1e-3, device=device), torch.tensor(9.0, device=device))
    common: dict[str, Any] = {"box": BOX, "shift": -2.0, "delta": 0.5}

    def search() -> PackedSamples:
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

    colored = rays * COLORED_PER_RAY
    own = torch.arange(rays, device=device).repeat_interleave(COLORED_PER_RAY)
    starts = torch.arange(rays + 1, device=device) * COLORED_PER_RAY
    encoded = 3 + 6 * OCTAVES
    sizes = (
        (WIDTH, CHANNELS),
        (WIDTH,),
        (WIDTH, encoded),
        (WIDTH, WIDTH),
        (WIDTH,),
        (3, WIDTH),
        (3,),
    )
    network = [draw(*size) / 8 for size in sizes]
    octaves = 2.0 ** torch.arange(OCTAVES, device=device)
    zeros = torch.zeros(rays, dtype=torch.long, device=device)
    pose = torch.eye(3, 4, device=device)[None] + torch.tensor([0.0, 0, 0, 4], device=device)
    seen = SeenEarlier(
        *(draw(rays, 2), zeros == 0, draw(rays, 2), zeros, zeros[:1]),
        *(pose, draw(1, 2) + 400, draw(1, 2) + 200),
    )

    def motion(forward: Tensor, canonical: Tensor, weight: Tensor) -> Tensor:
        present = torch.ones(colored, dtype=torch.bool, device=device)
        listed = ListedSamples(points[:colored], canonical, weight, own, present)
        options: dict[str, Any] = {"box": BOX, "over_samples": False}
        return motion_sum(listed, forward, slices, seen, (1.0, 1.0), **options).total

    def photometric(image: Tensor, end: Tensor, color: Tensor) -> Tensor:
        known = depth[:colored], color, starts, image.detach() / 2, None, (1.0, 0.1, 0.1, 0.0)
        return photometric_sum(image, end, *known).total

    def colors_in(precision: torch.dtype) -> Callable[[], object]:
        def rgb(grid: Tensor, at: Tensor, *weights: Tensor) -> Tensor:
            known = directions, own, starts, ColorNetwork(*[*weights, octaves]), precision
            return listed_colors(grid, at, BOX, *known)

        return with_gradients(rgb, features, points[:colored], *network)

    half = torch.bfloat16 if device.type == "cuda" else torch.float16
    precisions = {"float32": torch.float32, "half": half}
    listed = search()
    return {
        "interpolate": with_gradients(interpolate, features, coords),
        "warped_depth": with_gradients(
            lambda density, slices: warped_depth(points, density, [slices], **common)[1],
            density,
            slices,
        ),
        "find_samples": search,
        "select_listed": with_gradients(
            lambda canonical, weight: select_listed(listed, canonical, weight, colored).canonical,
            *(points, depth),
        ),
        **{f"listed_colors {name}": colors_in(kind) for name, kind in precisions.items()},
        "motion_sum": with_gradients(motion, slices, points[:colored], depth[:colored]),
        "photometric_sum": with_gradients(photometric, colors[:rays], left, colors[:colored]),
        # Weights that differ: their sum alone hardly depends on what opaque rays pass.
        "composite_segments": with_gradients(
            lambda tau: composite_segments(tau, first)[0] * points[:, 0], depth
        ),
        "composite_colors": with_gradients(
            lambda weights, colors: composite_colors(weights, colors, depth, first, left, left[:3])[
                0
            ],
            depth,
            colors,
        ),
        "add_total_variation_gradient": lambda: add_total_variation_gradient(grid, gradient, 1e-6),
        "adam_step": lambda: adam_step(grid, gradient, mean, square, rule, clear=False),
    }


def with_gradients(operation: Callable[..., Tensor], *given: Tensor) -> Callable[[], object]:
    """Forward and backward, with the gradients of all ``given`` tensors."""
    leaves = [tensor.clone().requires_grad_() for tensor in given]

    def work() -> object:
        return torch.autograd.grad(operation(*leaves).sum(), leaves, allow_unused=True)

    return work


if __name__ == "__main__":
    main()
