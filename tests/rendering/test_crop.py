"""A crop shows what is in its box alone, from any distance: two opaque walls, exactly."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from devrf.geometry.box import Box
from devrf.geometry.contraction import ContractedSpace
from devrf.geometry.rays import Rays
from devrf.geometry.space import WORLD, Space
from devrf.rendering.rendered_image import RenderedImage
from devrf.rendering.renderer import Renderer

RED, BLUE = torch.tensor([1.0, 0, 0]), torch.tensor([0.0, 0, 1])
NEAR, FAR = 0.5, 10.0


class Walls:
    """A red wall at x = 0.5 and a blue one at x = −0.5, seen along −x from NEAR to FAR."""

    box = Box((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
    depth_limits = NEAR, FAR
    device = torch.device("cpu")
    chunk, at_rest = 2, False

    def __init__(self, space: Space = WORLD) -> None:
        self.space = space

    def at(self, time: float, *, half: bool = False) -> Walls:
        return self

    def render(self, rays: Rays, background: Tensor) -> RenderedImage:
        color, depth = background.repeat(len(rays), 1), torch.zeros(len(rays))
        for wall, paint in ((-0.5, BLUE), (0.5, RED)):
            distance = (rays.origins[:, 0] - wall) / -rays.directions[:, 0]
            hit = (distance >= NEAR) & (distance <= FAR)
            color[hit], depth[hit] = paint, distance[hit]
        return RenderedImage(color, depth, (depth > 0).float())


def along(x: float) -> Rays:
    """Rays from (x, 0, 0) and (x, 5, 0), which passes the box by, along −x."""
    ahead = torch.tensor([[-1.0, 0, 0]]).repeat(2, 1)
    return Rays(torch.tensor([[x, 0.0, 0.0], [x, 5.0, 0.0]]), ahead, ahead)


@pytest.mark.parametrize("space", [WORLD, ContractedSpace((-1.0,) * 3, (1.0,) * 3)])
@pytest.mark.parametrize(
    ("low", "high", "color", "depth"),
    [
        (-1.0, 1.0, RED, 2.5),
        (-1.0, 0.0, BLUE, 3.5),  # the red wall is cut away before it
        (0.0, 1.0, RED, 2.5),
        (-0.3, 0.3, torch.ones(3), 0.0),  # between them; the blue one is behind the box
    ],
)
def test_what_is_outside_is_left_out(space, low, high, color, depth):
    crop = Box((low, -1.0, -1.0), (high, 1.0, 1.0))
    seen = Renderer(Walls(space)).picture(along(3.0), 0.0, 1.0, crop)
    torch.testing.assert_close(seen.color[0], color)
    assert float(seen.depth[0]) == pytest.approx(depth)
    assert float(seen.opacity[0]) == (depth > 0)
    assert seen.color[1].tolist() == [1, 1, 1] and float(seen.opacity[1]) == 0


def test_a_distant_camera_is_cropped_to_the_box():
    renderer, rays = Renderer(Walls()), along(30.0)
    assert float(renderer.picture(rays, 0.0, 1.0).opacity[0]) == 0  # beyond the far limit
    box = renderer.reach(rays.origins[0])
    assert box == Walls.box
    seen = renderer.picture(rays, 0.0, 1.0, box)
    assert (float(seen.depth[0]), seen.color[0].tolist()) == (29.5, RED.tolist())
    assert renderer.reach(torch.tensor([3.0, 0, 0])) is None
