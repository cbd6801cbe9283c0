"""Each kernel at the paper's size beside its definition in PyTorch, on this device.

For each: how far what it gives is from the definition, as a share of the largest number there;
microseconds of both; and the bytes that it reads and writes at least, by its microseconds.
"""

from __future__ import annotations

import harness  # isort: skip: how threads wait is set before torch is loaded

import argparse
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import interpolate, normalize
from torch.utils.benchmark import Timer

from devrf.geometry.box import Box
from devrf.geometry.rays import Rays
from devrf.kernels import adam, march, trilinear
from devrf.ops import adam as adam_definition
from devrf.ops import march as march_definition
from devrf.ops import trilinear as trilinear_definition
from devrf.ops.adam import AdamRule
from devrf.ops.march import MarchInputs, MarchRange
from devrf.rendering.occupancy import Occupancy, dilate

BOX = Box((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
SIDE = 160
RAYS = 8192
POINTS = 200_000
FLOAT = 4


def rows(
    device: torch.device, side: int = SIDE, rays: int = RAYS, points: int = POINTS
) -> Iterator[dict[str, Any]]:
    """A row for each kernel, on grids of ``side`` points an edge."""
    generator = torch.Generator(device).manual_seed(0)

    def draw(*shape: int) -> Tensor:
        return torch.randn(*shape, device=device, generator=generator)

    for channels in (1, 3, 12):
        yield from rows_of_a_grid(draw(side, side, side, channels), points, draw)
    for moves in (False, True):
        yield from rows_of_a_march(side, rays, draw, moves=moves)


def rows_of_a_grid(
    grid: Tensor, points: int, draw: Callable[..., Tensor]
) -> Iterator[dict[str, Any]]:
    """Interpolation of a grid at as many points, a step of Adam on it, its total variation."""
    channels = grid.shape[-1]
    places = draw(points, 3) / 3
    factor = draw(points, channels)
    touched = points * FLOAT * (3 + 9 * channels)
    yield compared(
        f"interpolation, {channels} channels",
        lambda ours: ours.interpolate(grid, places, BOX),
        (trilinear, trilinear_definition),
        touched,
    )
    yield compared(
        f"interpolation, {channels} channels, forward and backward",
        lambda ours: gradients(ours.interpolate, grid, places, factor),
        (trilinear, trilinear_definition),
        3 * touched,
    )
    moments = [draw(*grid.shape), draw(*grid.shape), draw(*grid.shape).square()]
    rule = AdamRule(0.1, 3, skip_zero=True)
    yield compared(
        f"Adam, {channels} channels",
        lambda ours: stepped(ours, grid, moments, rule),
        (adam, adam_definition),
        7 * FLOAT * grid.numel(),
    )
    yield compared(
        f"total variation, {channels} channels",
        lambda ours: smoothed(ours, grid, moments[0]),
        (adam, adam_definition),
        3 * FLOAT * grid.numel(),
    )


def rows_of_a_march(
    side: int, rays: int, draw: Callable[..., Tensor], *, moves: bool
) -> Iterator[dict[str, Any]]:
    """A march through a foggy ball, and with its adjoint."""
    seen, inputs = ball(side, rays, draw, moves=moves)
    name = "march, warped" if moves else "march"
    yield compared(
        name,
        lambda ours: follow(ours, seen, inputs, backward=False),
        (march, march_definition),
        None,
    )
    yield compared(
        f"{name}, forward and backward",
        lambda ours: follow(ours, seen, inputs, backward=True),
        (march, march_definition),
        None,
    )


def compared(
    name: str,
    work: Callable[[Any], list[Tensor] | Tensor],
    of: tuple[Any, Any],
    touched: int | None,
) -> dict[str, Any]:
    """The row of one kernel: ``work`` by the module of kernels and by that of definitions."""
    results = [work(module) for module in of]
    ours, theirs = ([each] if isinstance(each, Tensor) else each for each in results)
    off = [
        float((one - other).abs().max() / other.abs().max().clamp(min=1e-12))
        for one, other in zip(ours, theirs, strict=True)
    ]
    taken = [microseconds(work, module) for module in of]
    row = {"kernel": name, "off": max(off), "us": taken[0], "us in PyTorch": taken[1]}
    return row if touched is None else row | {"GB/s": touched / taken[0] / 1e3}


def microseconds(work: Callable[[Any], Any], module: Any) -> float:
    """Of one run, many having been launched one after another."""
    timer = Timer(
        "work(module)",
        globals={"work": work, "module": module},
        num_threads=torch.get_num_threads(),
    )
    return 1e6 * float(timer.blocked_autorange(min_run_time=0.2).median)


def gradients(
    look: Callable[..., Tensor], grid: Tensor, places: Tensor, factor: Tensor
) -> list[Tensor]:
    """Of interpolation: the gradients in the grid and in the points."""
    given = [grid.detach().requires_grad_(), places.detach().requires_grad_()]
    return list(torch.autograd.grad(look(*given, BOX), given, factor))


def stepped(module: Any, values: Tensor, moments: list[Tensor], rule: AdamRule) -> list[Tensor]:
    """What a step of Adam leaves; copies are made, which takes time, too."""
    gradient, mean, square = (each.clone() for each in moments)
    stepping = values.clone()
    module.adam_step(stepping, gradient, mean, square, rule)
    return [stepping, mean, square]


def smoothed(module: Any, grid: Tensor, gradient: Tensor) -> Tensor:
    """A gradient with that of the total variation added; a copy is made, which takes time, too."""
    added = gradient.clone()
    module.add_total_variation_gradient(grid, added, 0.1)
    return added


def ball(
    side: int, rays: int, draw: Callable[..., Tensor], *, moves: bool
) -> tuple[Rays, MarchInputs]:
    """Rays at a foggy ball of radius 1/2, and that ball, bent if it ``moves``."""
    axis = torch.linspace(-1, 1, side, device=draw(0).device)
    radius = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij")).norm(dim=0)
    density = (60 * (0.5 - radius) + 0.3 * draw(side, side, side))[..., None]
    occupancy = Occupancy(dilate(radius < 0.55, 3), BOX)
    step = 1 / side
    limits = MarchRange(BOX, occupancy.distances, step=step, near=0.1, far=10.0)
    bends = interpolate(0.05 * draw(1, 3, 6, 6, 6), (side,) * 3, mode="trilinear")
    origins = 3 * normalize(draw(rays, 3), dim=1)
    directions = normalize(0.35 * draw(rays, 3) - origins, dim=1)
    return Rays(origins, directions, directions), MarchInputs(
        limits,
        density=density,
        shift=-4.0,
        delta=0.5,
        threshold=1e-4,
        displacement=bends[0].permute(1, 2, 3, 0).contiguous() if moves else None,
        displacement_box=BOX if moves else None,
    )


def follow(module: Any, rays: Rays, inputs: MarchInputs, *, backward: bool) -> list[Tensor]:
    """What rays meet in all; with ``backward`` the gradients in densities and displacements."""
    density = inputs.density.detach().requires_grad_(backward)
    moves = inputs.displacement
    if moves is not None:
        moves = moves.detach().requires_grad_(backward)
    given = MarchInputs(
        inputs.range,
        density=density,
        shift=inputs.shift,
        delta=inputs.delta,
        threshold=inputs.threshold,
        displacement=moves,
        displacement_box=inputs.displacement_box,
    )
    samples = module.march(rays, given)
    depth = torch.zeros_like(samples.transmittance)
    depth = depth.index_add(0, samples.ray, samples.weight * samples.canonical[:, 0])
    if not backward:
        return [samples.transmittance, depth]
    loss = samples.transmittance.square().sum() + depth.square().sum()
    learned = [density] if moves is None else [density, moves]
    return list(torch.autograd.grad(loss, learned))


def main() -> None:
    """Compare all kernels, on a GPU if there is one."""
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--json", type=Path, default=Path("benchmark_kernels.json"))
    options = arguments.parse_args()
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    harness.report(list(rows(device)), options.json, device)


if __name__ == "__main__":
    main()
