"""Which tensors kernels take, and that the number of threads changes no bit."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch
from torch import Tensor

from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras
from devrf.geometry.rays import Rays
from devrf.kernels.adam import GRAIN_OF_VOXELS, adam_step, add_total_variation_gradient
from devrf.kernels.march import march
from devrf.kernels.runtime import GRAIN_OF_RAYS, choose, is_supported
from devrf.kernels.splatting import BAND, splat
from devrf.kernels.trilinear import interpolate
from devrf.ops import adam, splatting, trilinear
from devrf.ops import march as definition
from devrf.ops.adam import AdamRule
from devrf.ops.march import MarchInputs, MarchRange
from devrf.ops.splatting import Gaussians
from devrf.rendering.occupancy import Occupancy

BOX = Box((-1.0, -0.5, 0.0), (1.0, 1.5, 1.0))


@pytest.fixture
def in_torch() -> Iterator[None]:
    """Kernels are not used."""
    choose("torch")
    yield
    choose("auto")


@pytest.fixture
def threads() -> Iterator[Callable[[int], None]]:
    """Sets the number of threads of the rest of the test."""
    usual = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(usual)


# Each in a process of its own: first with less memory than Warp's library takes; then, for each
# folder, where kernels are kept, and whether others may write there.
STARTS = """
import os, resource, sys, tempfile, torch, warp
from pathlib import Path
from devrf.errors import DevrfError
from devrf.kernels.runtime import is_supported, others_may_write
for name in sys.argv:
    if os.fork():
        os.wait()
        continue
    if name == sys.argv[0]:
        pages = int(open("/proc/self/statm").read().split()[0])
        most = pages * resource.getpagesize() + 20 * 2**20
        resource.setrlimit(resource.RLIMIT_AS, (most, most))
        try:
            is_supported(torch.empty(0))
        except DevrfError as error:
            print(error)
        sys.exit()
    os.environ["WARP_CACHE_PATH"] = str(Path(name, "cache"))
    os.environ["TMPDIR"] = str(Path(name, "own"))
    assert is_supported(torch.empty(0))
    folder = Path(warp.config.kernel_cache_dir)
    assert folder.is_dir()
    print(folder.parent == Path(tempfile.gettempdir()), others_may_write(folder))
    sys.exit()
"""


@pytest.mark.skipif(sys.platform != "linux", reason="memory as Linux limits it")
def test_short_memory_is_one_line_and_kernels_are_not_kept_where_others_may_write(tmp_path):
    folders = []
    for mode in (0o700, 0o755, 0o777):
        folders.append(folder := tmp_path / f"{mode:o}")
        (folder / "own").mkdir(parents=True)
        (folder / "cache").mkdir()
        (folder / "cache").chmod(mode)
        folder.chmod(0o755)
    tmp_path.chmod(0o755)
    command = [sys.executable, "-c", STARTS, *map(str, folders)]
    done = subprocess.run(command, capture_output=True, text=True)
    short, *kept = done.stdout.splitlines()
    assert short.startswith("kernels: Warp cannot be loaded (")
    assert short.endswith("; free memory, or give kernels=torch")
    assert kept == ["False False", "False False", "True False"]
    (warning,) = done.stderr.splitlines()
    assert "others may write there" in warning
    own = [[path.name for path in (folder / "own").iterdir()] for folder in folders]
    assert own == [[], [], [f"devrf-kernels-{os.getuid()}"]]


def scene(rng: torch.Generator, count: int = 500) -> tuple[Rays, MarchInputs]:
    """Random rays through a random scene that moves."""
    origins, targets = torch.randn(2, count, 3, generator=rng)
    directions = torch.nn.functional.normalize(targets - 2 * origins, dim=1)
    occupancy = Occupancy(torch.rand(9, 8, 7, generator=rng) < 0.4, BOX)
    inputs = MarchInputs(
        MarchRange(BOX, occupancy.distances, 0.05, 0.1, 6.0),
        density=4 * torch.randn(6, 7, 5, 1, generator=rng),
        shift=-1.5,
        delta=0.4,
        threshold=0.01,
        displacement=0.15 * torch.randn(7, 3, 5, 3, generator=rng),
        displacement_box=BOX.scaled(0.7),
        zero_outside_box=True,
    )
    return Rays(2 * origins, directions, directions), inputs


# Three bands high.
CAMERA = Cameras.looking_at(
    torch.tensor([[3.0, 1.0, 0.0]]), torch.zeros(1, 3), focal=20.0, width=10, height=2 * BAND + 5
)


def gaussians(points: Tensor) -> Gaussians:
    """Gaussians in so many places."""
    sizes = 0.1 + 0.05 * points.cos()
    turns = torch.cat([points, points.sin()], dim=1)[:, :4]
    return Gaussians(points, sizes, turns, points[:, 0].sigmoid(), points.sigmoid())


def test_kernels_take_single_precision_where_they_run() -> None:
    assert is_supported(torch.zeros(1)) and is_supported(torch.zeros(0, 3))
    for other in (torch.float64, torch.float16, torch.bfloat16, torch.int32):
        assert not is_supported(torch.zeros(1, dtype=other))
    assert not is_supported(torch.zeros(1, device="meta"))


def test_kernels_can_be_left_out(in_torch: None) -> None:
    assert not is_supported(torch.zeros(1))
    choose("auto")
    assert is_supported(torch.zeros(1))


def everything(given: tuple[Rays, MarchInputs], points: Tensor, grid: Tensor) -> list[Any]:
    """What all functions of the kernels give."""
    rays, inputs = given
    samples = march(rays, inputs)
    image = splat(gaussians(points), CAMERA, 0.1)
    interpolated = interpolate(grid, points, BOX)
    return [*vars(samples).values(), *vars(image).values(), interpolated, *optimised(grid)]


def optimised(grid: Tensor) -> list[Tensor]:
    """What the optimiser's kernels make of a grid."""
    stepped = [grid.clone(), grid.clone(), grid.clone(), grid.abs()]
    adam_step(*stepped, AdamRule(0.1, 2))
    smoothed = torch.zeros_like(grid)
    add_total_variation_gradient(grid, smoothed, 0.5)
    return [smoothed, *stepped]


def by_definition(given: tuple[Rays, MarchInputs], points: Tensor, grid: Tensor) -> list[Any]:
    """The same, by the definitions."""
    rays, inputs = given
    stepped = [grid.clone(), grid.clone(), grid.clone(), grid.abs()]
    adam.adam_step(*stepped, AdamRule(0.1, 2))
    smoothed = torch.zeros_like(grid)
    adam.add_total_variation_gradient(grid, smoothed, 0.5)
    samples = definition.march(rays, inputs)
    image = splatting.splat(gaussians(points), CAMERA, 0.1)
    interpolated = trilinear.interpolate(grid, points, BOX)
    return [*vars(samples).values(), *vars(image).values(), interpolated, smoothed, *stepped]


def test_without_kernels_everything_is_the_definition_to_the_bit(
    in_torch: None, rng: torch.Generator
) -> None:
    given = scene(rng), torch.randn(900, 3, generator=rng), torch.randn(6, 7, 5, 3, generator=rng)
    expected = by_definition(*given)
    ours = everything(*given)
    assert all(torch.equal(one, other) for one, other in zip(ours, expected, strict=True))
    choose("auto")
    ours = everything(*given)
    same = [torch.equal(one, other) for one, other in zip(ours, expected, strict=True)]
    assert not all(same)  # rounded differently


def test_doubles_are_taken_by_the_definition(rng: torch.Generator) -> None:
    grid, points = torch.randn(6, 7, 5, 3, generator=rng), torch.randn(50, 3, generator=rng)
    double = interpolate(grid.double(), points.double(), BOX)
    assert torch.equal(double, trilinear.interpolate(grid.double(), points.double(), BOX))
    # As every definition it can be differentiated twice.
    places = points[:4].double().requires_grad_()
    values = (interpolate(grid.double(), places, BOX) ** 2).sum()
    (slope,) = torch.autograd.grad(values, places, create_graph=True)
    slope.sum().backward()
    assert places.grad.abs().max() > 0


def with_gradients(given: tuple[Rays, MarchInputs], points: Tensor, grid: Tensor) -> list[Tensor]:
    """What all functions give, and all gradients."""
    rays, inputs = given
    results = everything(given, points, grid)
    leaves = [inputs.density, inputs.displacement, grid, points]
    for leaf in leaves:
        leaf.grad = None
        leaf.requires_grad_()
    samples = march(rays, inputs)
    loss = (samples.canonical**2).sum() + (samples.weight**2).sum()
    loss = loss + (samples.transmittance**2).sum() + (interpolate(grid, points, BOX) ** 2).sum()
    loss = loss + (splat(gaussians(points), CAMERA, 0.1).color ** 2).sum()
    loss.backward()
    # Once more, added to the gradients that are there.
    (march(rays, inputs).weight.sum() + interpolate(grid, points, BOX).sum()).backward()
    results += [leaf.grad for leaf in leaves]
    for leaf in leaves:
        leaf.requires_grad_(False)
    return results


@pytest.mark.parametrize("channels", [1, 3, 12])
@pytest.mark.parametrize("count", [1, 3 * GRAIN_OF_RAYS])
def test_results_are_the_same_to_the_bit_with_any_number_of_threads(
    channels: int, count: int, rng: torch.Generator, threads: Callable[[int], None]
) -> None:
    given = scene(rng, count)
    # Many points a cell: the order of their sums would show.
    points = 0.7 * torch.randn(20 * count, 3, generator=rng)
    grid = torch.randn(6, 7, 5, channels, generator=rng)
    alone = with_gradients(given, points, grid)
    assert all(gradient is not None and gradient.any() for gradient in alone[-2:])
    for number in (2, 3):
        threads(number)
        together = with_gradients(given, points, grid)
        assert all(torch.equal(one, other) for one, other in zip(alone, together, strict=True))


def test_a_step_is_the_same_to_the_bit_with_any_number_of_threads(
    rng: torch.Generator, threads: Callable[[int], None]
) -> None:
    grid = torch.randn(48, 47, 45, 2, generator=rng)
    assert grid[..., 0].numel() >= 3 * GRAIN_OF_VOXELS
    alone = optimised(grid)
    for number in (2, 3):
        threads(number)
        assert all(map(torch.equal, alone, optimised(grid)))
