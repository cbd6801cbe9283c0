"""Rays and truth of pixels: as the batches of every method, in both implementations."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from devrf.data.batch import pixel_positions
from devrf.engine.batches import gather_batch
from devrf.geometry.box import Box
from devrf.geometry.ndc import NormalizedDevice
from devrf.geometry.rays import Rays
from devrf.geometry.space import WORLD, Space
from devrf.ops.dispatch import using
from devrf.ops.pixel_rays import steps_in_box
from devrf.ops.selfcheck import Draw, pixel_rays
from devrf.rendering.sampling import steps_through
from devrf.scenes.scene import OpticalFlow, Scene, Views

Both = Callable[[Callable[[], Sequence[Tensor]]], None]
BOX = Box((-1.0, -0.5, -0.8), (0.9, 1.0, 0.7))


def test_both_implementations_agree(agree: Both, device: torch.device) -> None:
    agree(lambda: pixel_rays(Draw(device)))


@pytest.fixture
def views(tiny_scene: Scene, device: torch.device) -> Views:
    """Images with alpha masks, and with flow that is NaN where it is not valid."""
    views = tiny_scene.dynamic.train
    shape = views.pixels.shape[:3]
    valid = torch.arange(shape.numel()).view(shape) % 3 > 0
    vectors = torch.randn(*shape, 2).masked_fill(~valid[..., None], float("nan"))
    return replace(views, flow=OpticalFlow(vectors, valid)).to(device)


@pytest.mark.parametrize("kernels", ["torch", "triton"])
@pytest.mark.parametrize("space", [WORLD, NormalizedDevice(24, 18, (20.0, 20.0))])
@pytest.mark.parametrize("random", [False, True])
def test_a_batch_is_the_same_by_either_kind_of_kernel(
    views: Views, device: torch.device, kernels: str, space: Space, random: bool
) -> None:
    rays = 300  # more than a program has
    image = torch.randint(len(views), (rays,), device=device)
    flat = torch.randint(views.height * views.width, (rays,), device=device)
    behind = torch.rand(*((rays, 3) if random else (3,)), device=device)
    with using("torch"):
        expected = gather_batch(views, image, flat, behind, space)
    own = space.rays(views.cameras.rays(image, pixel_positions(flat, views.width)))
    assert vars(expected.rays).keys() == vars(own).keys()
    for part in ("origins", "directions", "viewdirs"):
        assert torch.equal(getattr(expected.rays, part), getattr(own, part))
    with using(kernels):  # type: ignore[arg-type]
        found = gather_batch(views, image, flat, behind, space)
    for name, value in vars(expected).items():
        ours = getattr(found, name)
        if isinstance(value, Rays):
            for part in ("origins", "directions", "viewdirs"):
                torch.testing.assert_close(
                    getattr(ours, part), getattr(value, part), rtol=2e-5, atol=2e-5
                )
        else:
            torch.testing.assert_close(ours, value, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("kernels", ["torch", "triton"])
def test_steps_are_those_of_sampling(draw: Callable[..., Tensor], kernels: str) -> None:
    rays = Rays(2 * draw(300, 3), draw(300, 3), draw(300, 3))
    rays.directions[0] = torch.tensor([0.0, 0.0, 1.0])  # along an axis
    limits = {"step": 0.07, "near": 0.1, "far": 3.0}
    entry, count = steps_through(rays, BOX, **limits)
    with using(kernels):  # type: ignore[arg-type]
        found, number = steps_in_box(rays.origins, rays.directions, box=BOX, **limits)
    torch.testing.assert_close(found, entry, rtol=1e-5, atol=1e-5)
    assert torch.equal(number, count) and count.any() and (count == 0).any()
