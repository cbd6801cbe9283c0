"""Front to back a picture shows what the plain renderer shows, and what is hidden is not asked."""

from __future__ import annotations

from functools import partial

import torch

from devrf.geometry.box import Box
from devrf.geometry.rays import Rays
from devrf.methods.devrf.architecture import Architecture
from devrf.methods.devrf.canonical_field import look_up
from devrf.methods.devrf.deformation_field import GridWarp
from devrf.methods.devrf.volume_rendering import render
from devrf.rendering import front_to_back
from devrf.rendering.occupancy import Occupancy
from devrf.rendering.sampling import RenderSettings

RAYS = 24
SETTINGS = RenderSettings(step=0.5, alpha_threshold=0.02, near=0.2, far=9.0)


class World:
    """A random field in a box, partly occupied, that is seen through a warp."""

    def __init__(self, dtype, frames, planes=None):
        rng = torch.Generator().manual_seed(2)

        def draw(*shape):
            return 2 * torch.rand(*shape, generator=rng, dtype=torch.float64) - 1

        box = Box((-1.0, -0.9, -0.8), (0.9, 1.0, 0.7))
        sizes = Architecture(channels=4, width=8, frequencies=1, alpha_init=0.1, planes=planes)
        self.field = sizes.radiance_field(box, 7**3, 9**3).to(dtype)
        with torch.no_grad():
            values = self.field.density.values
            values.copy_(4 * draw(*values.shape))
            self.field.color.values.copy_(draw(*self.field.color.values.shape))
        self.occupancy = Occupancy(draw(6, 7, 5) > -0.4, box)
        self.slices = tuple(
            (0.1 * draw(4, 3, 5, 3)).to(dtype).requires_grad_() for _ in range(frames)
        )
        self.warp = GridWarp(self.slices, box, 0.3 if frames == 2 else 0.0)
        # Colours change while something moves.
        self.residual = (draw(3, 4, 3, 3)).to(dtype).requires_grad_() if frames else None
        self.color_change = (
            None if self.residual is None else partial(look_up, self.residual, box=box)
        )
        origins = torch.tensor([[-3.0, 0.0, 0.0]]) + 0.3 * draw(RAYS, 3)
        directions = torch.nn.functional.normalize(
            torch.tensor([[1.0, 0.0, 0.0]]) + 0.25 * draw(RAYS, 3), dim=1
        )
        self.rays = Rays(origins.to(dtype), directions.to(dtype), directions.to(dtype))
        self.behind = draw(RAYS, 3).abs().to(dtype)

    def exactly(self):
        return render(
            self.rays,
            self.field,
            self.occupancy,
            SETTINGS,
            self.behind,
            self.warp,
            color_change=self.color_change,
        )


def test_front_to_back_sees_the_same_and_looks_no_further_than_it_has_to(monkeypatch):
    world, asked = World(torch.float64, 1), []
    with torch.no_grad():
        expected = world.exactly()
        world.field.density.values += 6.0  # most rays end early
        opaque = world.exactly()
    monkeypatch.setattr(front_to_back, "SLAB", 1)

    def warp(points):
        asked.append(len(points))
        return world.warp(points)

    scene = world.rays, world.field, world.occupancy, SETTINGS, world.behind, warp
    seen = front_to_back.picture(*scene, world.color_change)
    torch.testing.assert_close(seen.color, opaque.color)
    torch.testing.assert_close(seen.depth, opaque.depth)
    torch.testing.assert_close(1 - seen.opacity, opaque.transmittance)
    all_looked_at = sum(asked)
    asked.clear()
    with torch.no_grad():
        world.field.density.values -= 6.0
    seen = front_to_back.picture(*scene, world.color_change)
    torch.testing.assert_close(seen.color, expected.color)
    assert all_looked_at < 0.7 * sum(asked)
