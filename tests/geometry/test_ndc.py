"""Normalised device coordinates by hand."""

from __future__ import annotations

import pytest
import torch

from devrf.geometry.ndc import NormalizedDevice
from devrf.geometry.rays import Rays

# Slopes 2·8/16 = 1 and 2·9/12 = 1.5: not square, so that a swap shows.
NDC = NormalizedDevice(width=16, height=12, focal=(8.0, 9.0), near=1.0)


@pytest.mark.parametrize(
    ("world", "device"),
    [
        ((0.0, 0.0, -1.0), (0.0, 0.0, -1.0)),  # the near plane
        ((0.0, 0.0, -2.0), (0.0, 0.0, 0.0)),  # twice as far: the middle
        ((1.0, 0.0, -1.0), (1.0, 0.0, -1.0)),  # right edge of the picture: (W/2)/f = 1
        ((0.0, 2 / 3, -1.0), (0.0, 1.0, -1.0)),  # upper edge: (H/2)/f = 2/3
        ((2.0, -1.0, -4.0), (0.5, -0.375, 0.5)),
        ((0.0, 0.0, -(2.0**20)), (0.0, 0.0, 1 - 2.0**-19)),  # infinity: the far face
    ],
)
def test_points_by_hand(
    world: tuple[float, float, float], device: tuple[float, float, float]
) -> None:
    torch.testing.assert_close(NDC.from_world(torch.tensor([world])), torch.tensor([device]))
    torch.testing.assert_close(NDC.to_world(torch.tensor([device])), torch.tensor([world]))


def test_there_and_back_with_another_near_plane(rng: torch.Generator) -> None:
    ndc = NormalizedDevice(20, 10, (13.0, 11.0), near=0.7)
    points = torch.randn(100, 3, generator=rng, dtype=torch.float64)
    points[:, 2] = -0.7 - 5 * torch.rand(100, generator=rng, dtype=torch.float64)
    torch.testing.assert_close(ndc.to_world(ndc.from_world(points)), points)


def test_a_ray_by_hand() -> None:
    d = torch.tensor([[0.6, 0.0, -0.8]])
    rays = NDC.rays(Rays(torch.tensor([[0.0, 0.0, 1.0]]), d, d))
    # It meets z = −1 at (1.5, 0, −1) → (1.5, 0, −1), and infinity at x' = 0.75.
    torch.testing.assert_close(rays.origins, torch.tensor([[1.5, 0.0, -1.0]]))
    torch.testing.assert_close(rays.directions, torch.tensor([[-0.75, 0.0, 2.0]]))
    assert torch.equal(rays.viewdirs, d)


def test_points_of_a_world_ray_lie_on_its_ndc_ray(rng: torch.Generator) -> None:
    origins = 0.3 * torch.randn(50, 3, generator=rng, dtype=torch.float64)
    d = torch.randn(50, 3, generator=rng, dtype=torch.float64)
    d[:, 2] = -1 - d[:, 2].abs()
    d = torch.nn.functional.normalize(d, dim=1)
    rays = NDC.rays(Rays(origins, d, d))
    depth = 1.5 + 6 * torch.rand(50, generator=rng, dtype=torch.float64)
    points = origins + d * (-(depth + origins[:, 2]) / d[:, 2])[:, None]
    device = NDC.from_world(points)
    # With o on the near plane and o + d at infinity, the point at depth z is at 1 − n/z.
    share = 1 - NDC.near / depth
    torch.testing.assert_close(rays.at(torch.arange(50), share), device)


def test_infinity_is_far_away_and_its_pixel_stays() -> None:
    # Half to the right in the picture: at any depth x / −z is 0.5, as the slope is 1.
    points = torch.tensor([[0.5, 0.0, 1.0]], requires_grad=True)
    world = NDC.to_world(points)
    assert world.isfinite().all() and bool((world[:, 2] < -9e5).all())
    torch.testing.assert_close(-world[:, 0] / world[:, 2], torch.tensor([0.5]))
    (world[:, 0] / world[:, 2]).sum().backward()
    assert points.grad is not None and points.grad.isfinite().all()
