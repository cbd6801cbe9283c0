"""Where samples lie on rays, and what they come to."""

from __future__ import annotations

import math

import pytest
import torch

from devrf.geometry.box import Box
from devrf.geometry.rays import Rays
from devrf.geometry.space import WORLD
from devrf.methods.nerf.occupancy import OccupancyFrames
from devrf.methods.nerf.placement import Placement
from devrf.methods.nerf.samples import (
    RaySamples,
    accumulated,
    flattened,
    importance,
    limits,
    stratified,
)
from devrf.ops.compositing import composite
from devrf.scenes.scene import Scene


def along_x(count: int, start: float = -3.0) -> Rays:
    """``count`` equal rays along +x through the middle of the cube."""
    d = torch.tensor([[1.0, 0.0, 0.0]]).expand(count, 3)
    return Rays(torch.tensor([[start, 0.0, 0.0]]).expand(count, 3), d, d)


def test_rays_are_sampled_inside_the_box_from_near_to_far(cube: Box) -> None:
    beside = Rays(torch.tensor([[-3.0, 5.0, 0.0]]), *[torch.tensor([[1.0, 0.0, 0.0]])] * 2)
    near, far = limits(along_x(1), cube, (0.0, 9.0))
    assert (near.item(), far.item()) == (2.0, 4.0)
    near, far = limits(along_x(1), cube, (2.5, 3.0))
    assert (near.item(), far.item()) == (2.5, 3.0)
    near, far = limits(beside, cube, (0.0, 9.0))
    assert near.item() == far.item()


def test_stratified_samples_have_a_stretch_each() -> None:
    near, far = torch.tensor([0.0]), torch.tensor([4.0])
    middle = stratified(near, far, 4, jitter=False)
    torch.testing.assert_close(middle, torch.tensor([[0.5, 1.5, 2.5, 3.5]]))
    drawn = stratified(near, far, 4, jitter=True)
    assert drawn.floor().tolist() == [[0.0, 1.0, 2.0, 3.0]]


def test_fine_samples_lie_where_the_weight_is() -> None:
    distance = torch.tensor([[0.5, 1.5, 2.5, 3.5]])
    weight = torch.tensor([[0.0, 0.0, 1.0, 0.0]])
    near, far = torch.tensor([0.0]), torch.tensor([4.0])
    drawn = importance(distance, weight, near, far, 100, jitter=False)
    assert ((drawn >= 2.0) & (drawn <= 3.0)).float().mean() > 0.98
    # Evenly spread numbers are placed evenly within the stretch.
    assert drawn.mean().item() == pytest.approx(2.5, abs=0.02)


def test_two_samples_composite_by_hand() -> None:
    # τ = (ln 2, ln 2) leaves 1/2 and 1/4 of the ray.
    samples = RaySamples(
        torch.tensor([0, 0]), torch.tensor([1.0, 2.0]), torch.ones(2), torch.zeros(2, 3), 1
    )
    red, green = [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]
    weight, end = composite(torch.full((2,), math.log(2)), samples.ray, samples.rays)
    color = weight[:, None] * torch.tensor([red, green])
    seen = accumulated(samples, weight, color, end, torch.ones(3))
    torch.testing.assert_close(seen.color[0], torch.tensor([0.75, 0.5, 0.25]))
    assert seen.transmittance.item() == pytest.approx(0.25)
    assert seen.depth.item() == pytest.approx((0.5 * 1 + 0.25 * 2) / 0.75)


def test_the_last_sample_stands_for_the_rest_of_the_stretch() -> None:
    samples = flattened(along_x(1), torch.tensor([[2.0, 2.5]]), torch.tensor([4.0]))
    assert samples.length.tolist() == [0.5, 1.5]
    assert samples.points[:, 0].tolist() == [-1.0, -0.5]


def test_marching_keeps_samples_of_either_frame(cube: Box) -> None:
    occupancy = OccupancyFrames(2, (3, 3, 3))
    occupancy.mask[:] = False
    occupancy.mask[0, 0] = True  # x = -1
    occupancy.mask[1, 2] = True  # x = +1
    first, last = torch.tensor([0]), torch.tensor([1])

    def places(frames: tuple[torch.Tensor, torch.Tensor]) -> list[float]:
        found = occupancy.march(along_x(1), frames, cube, (0.0, 9.0), 0.25, jitter=False)
        return found.points[:, 0].tolist()

    assert max(places((first, first))) < -0.5 and min(places((last, last))) > 0.5
    both = places((first, last))
    assert both == places((first, first)) + places((last, last))


def test_the_hull_of_each_frame_holds_its_shape(tiny_scene: Scene) -> None:
    box = tiny_scene.bounds.motion
    assert box is not None
    occupancy = OccupancyFrames.of(tiny_scene, box, 16, hull=True)
    shares = occupancy.mask.flatten(1).float().mean(dim=1)
    # Eight static views carve frame 0 further than two views carve the others.
    assert 0 < shares[0] < shares[1:].min() < 1


def test_normalised_samples_have_points_and_lengths_in_halves_of_the_longest_edge() -> None:
    placement = Placement(Box((0.0, 0.0, 0.0), (8.0, 4.0, 4.0)), WORLD)
    samples = flattened(along_x(1), torch.tensor([[3.0, 5.0]]), torch.tensor([7.0]))
    normalised = samples.normalised(placement)
    assert normalised.points.tolist() == [[-1.0, -0.5, -0.5], [-0.5, -0.5, -0.5]]
    assert normalised.length.tolist() == [0.5, 0.5]
    assert normalised.distance.tolist() == [3.0, 5.0]
