"""Rendering of a slab whose colour, depth and transmittance are known in closed form."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import pytest
import torch
from torch import Tensor
from torch.autograd import gradcheck

from devrf.geometry.box import Box
from devrf.geometry.clock import FrameClock
from devrf.geometry.rays import Rays
from devrf.geometry.space import WORLD
from devrf.kernels.trilinear import interpolate
from devrf.methods.devrf.architecture import Architecture
from devrf.methods.devrf.canonical_field import CanonicalField
from devrf.methods.devrf.deformation_field import DeformationField, GridWarp
from devrf.methods.devrf.model import ColorResidualField, DeVRFModel
from devrf.methods.devrf.volume_rendering import render
from devrf.rendering.occupancy import Occupancy
from devrf.rendering.output import ColorResidual
from devrf.rendering.sampling import RenderSettings

SIDE = 21
GREEN = torch.tensor([0.2, 0.7, 0.4])
WHITE = torch.ones(3)
# Samples are 1/21 apart; those at −1 + k/21 for k = 20 … 30 lie in the cells of the slab.
STEP, FIRST, COUNT = 1 / 21, 20, 11


def settings(threshold: float = 0.0, near: float = 0.0, far: float = 9.0) -> RenderSettings:
    return RenderSettings(step=0.5, alpha_threshold=threshold, near=near, far=far)


def fog(box: Box, alpha: float) -> CanonicalField:
    """A green field of which every step of half a voxel has opacity ``alpha``."""
    field = Architecture().search_field(box, SIDE**3)
    with torch.no_grad():
        tau = -math.log1p(-alpha) / 0.5
        field.density.values.fill_(math.log(math.expm1(tau)) - field.shift)
        field.color.values.copy_(torch.logit(GREEN).expand(SIDE, SIDE, SIDE, 3))
    return field


def slab(box: Box) -> Occupancy:
    """Grid points 10 to 14 of 21 along x: from −0.05 to 0.45."""
    mask = torch.zeros(SIDE, SIDE, SIDE, dtype=torch.bool)
    mask[10:15] = True
    return Occupancy(mask, box)


def along_x(*heights: float) -> Rays:
    """Rays from x = −3 along x, at y = ``heights``."""
    origins = torch.tensor([[-3.0, y, 0.0] for y in heights])
    d = torch.tensor([[1.0, 0.0, 0.0]]).expand(len(heights), 3)
    return Rays(origins, d, d)


def test_a_slab_by_its_geometric_series(cube: Box) -> None:
    backgrounds = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    out = render(along_x(0.1, 2.0), fog(cube, 0.1), slab(cube), settings(), backgrounds)
    left = 0.9**COUNT
    torch.testing.assert_close(out.transmittance, torch.tensor([left, 1.0]))
    expected = torch.stack([(1 - left) * GREEN + left * backgrounds[0], backgrounds[1]])
    torch.testing.assert_close(out.color, expected)
    weights = [0.1 * 0.9**k for k in range(COUNT)]
    torch.testing.assert_close(out.samples.weight, torch.tensor(weights))
    distance = [2 + (FIRST + k) * STEP for k in range(COUNT)]
    torch.testing.assert_close(out.samples.distance, torch.tensor(distance))
    mean = sum(w * d for w, d in zip(weights, distance, strict=True)) / sum(weights)
    assert out.depth[0].item() == pytest.approx(mean, rel=1e-5)
    assert out.depth[1].item() == 0


def test_samples_too_faint_are_not_there_at_all(cube: Box) -> None:
    out = render(along_x(0.0), fog(cube, 0.1), slab(cube), settings(0.11), WHITE / 2)
    assert len(out.samples.ray) == len(out.samples.weight) == len(out.sample_color) == 0
    assert torch.equal(out.color, torch.full((1, 3), 0.5))
    assert out.transmittance.item() == 1 and out.depth.item() == 0


def test_samples_of_too_little_weight_shade_but_have_no_colour(cube: Box) -> None:
    out = render(along_x(0.0), fog(cube, 0.5), slab(cube), settings(0.2), torch.zeros(3))
    torch.testing.assert_close(out.samples.weight, torch.tensor([0.5, 0.25]))
    torch.testing.assert_close(out.color[0], 0.75 * GREEN)
    assert out.transmittance.item() == pytest.approx(0.5**COUNT, rel=1e-4)


def test_rays_that_see_nothing_see_the_background_and_have_gradients(cube: Box) -> None:
    field = fog(cube, 0.1)
    out = render(along_x(3.0, -2.0), field, slab(cube), settings(), WHITE)
    assert torch.equal(out.color, torch.ones(2, 3))
    out.color.sum().backward()
    for parameter in field.parameters():
        assert parameter.grad is None or not parameter.grad.any()
    empty = render(Rays(*[torch.zeros(0, 3)] * 3), field, slab(cube), settings(), WHITE)
    assert empty.color.shape == (0, 3) and empty.transmittance.shape == (0,)


def test_a_warp_looks_up_samples_elsewhere_but_leaves_them_in_place(cube: Box) -> None:
    field = fog(cube, 0.999999)
    ramp = cube.grid_points((SIDE, SIDE, SIDE), field.color.values)[..., :1]
    with torch.no_grad():
        field.color.values.copy_(ramp.expand(-1, -1, -1, 3))
    shift = torch.tensor([0.3, 0.1, 0.0])
    warp = GridWarp(shift.expand(2, 2, 2, 3), cube)
    out = render(along_x(0.0), field, slab(cube), settings(1e-3), WHITE, warp)
    torch.testing.assert_close(out.samples.canonical, out.samples.points + shift)
    x = -1 + FIRST * STEP
    assert out.samples.points[0, 0].item() == pytest.approx(x, abs=1e-5)
    # What is seen at x has the colour of the place x + 0.3.
    assert out.color[0, 0].item() == pytest.approx(1 / (1 + math.exp(-x - 0.3)), abs=1e-4)


def test_gradients_of_field_and_warp(cube: Box, rng: torch.Generator) -> None:
    field = Architecture(search_alpha_init=0.2).search_field(cube, 27).double()
    color = torch.randn(3, 3, 3, 3, generator=rng, dtype=torch.float64)
    field.color.values.data.copy_(color)
    full = Occupancy.full((3, 3, 3), cube)
    d = torch.nn.functional.normalize(
        torch.tensor([[1.0, 0.13, 0.21], [1.0, -0.17, 0.11]], dtype=torch.float64), dim=1
    )
    rays = Rays(torch.tensor([[-3.0, 0.05, 0.1]], dtype=torch.float64).expand(2, 3), d, d)

    def seen(density: Tensor, move: Tensor) -> tuple[Tensor, Tensor]:
        del field.density.values
        field.density.values = density  # type: ignore[assignment]
        out = render(rays, field, full, settings(), d.new_ones(3), GridWarp(move, cube))
        return out.color, out.transmittance

    density = torch.randn(3, 3, 3, 1, generator=rng, dtype=torch.float64, requires_grad=True)
    move = torch.randn(2, 2, 2, 3, generator=rng, dtype=torch.float64).mul_(0.02)
    assert gradcheck(seen, (density, move.requires_grad_()))


@pytest.mark.parametrize("time", [0.5, 0.7])
def test_a_picture_is_the_same_as_a_batch(cube: Box, rng: torch.Generator, time: float) -> None:
    def draw(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=rng)

    sizes = Architecture(channels=4, width=8, frequencies=1, alpha_init=0.1)
    field = sizes.radiance_field(cube, 7**3, 9**3)
    deformation = DeformationField(cube, FrameClock((0.0, 0.5, 1.0)), voxels=4**3)
    with torch.no_grad():
        field.density.values.copy_(4 * draw(*field.density.values.shape))
        field.color.values.copy_(draw(*field.color.values.shape))
        deformation.backward_slices[1:] = 0.1 * draw(2, 4, 4, 4, 3)
    occupancy = Occupancy(torch.rand(9, 9, 9, generator=rng) < 0.1, cube)
    residual = draw(3, 4, 3, 3)
    how = RenderSettings(step=0.5, alpha_threshold=0.02, near=0.2, far=9.0)
    color_residual = partial(interpolate, residual, box=cube)

    class Residual(ColorResidualField):
        def at(self, time: float) -> ColorResidual:
            return color_residual

    changing = Residual(cube, deformation.clock)
    view = DeVRFModel(sizes, field, occupancy, how, deformation, WORLD, changing).at(time)
    d = torch.nn.functional.normalize(0.3 * draw(200, 3) + torch.tensor([1.0, 0.0, 0.0]), dim=1)
    rays = Rays(0.3 * draw(200, 3) - torch.tensor([3.0, 0.0, 0.0]), d, d)
    seen = view.render(rays, WHITE)
    warp = deformation.backward_warp(time)
    # While it is learned, gradients flow into the displacement.
    displacement = warp.displacement.clone().requires_grad_()
    batch = render(
        rays,
        field,
        view.occupancy,
        how,
        WHITE,
        replace(warp, displacement=displacement),
        color_residual=color_residual,
    )
    assert batch.color.requires_grad and not seen.color.requires_grad
    torch.testing.assert_close(seen.color, batch.color)
    torch.testing.assert_close(seen.depth, batch.depth)
    torch.testing.assert_close(seen.opacity, 1 - batch.transmittance)
    assert 0.2 < (seen.opacity > 0.5).float().mean() < 0.9
    batch.color.sum().backward()
    assert displacement.grad.any()
