"""Cycle and flow by hand, and the induced flow of an exact motion against the scene's own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from devrf.data.batch import RayBatch
from devrf.data.flow import previous_images
from devrf.engine.batches import gather_batch
from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras
from devrf.methods.devrf.losses import (
    MotionPrediction,
    cycle,
    flow,
    induced_flow,
    total_variation_weight,
)
from devrf.rendering.output import VoxelOutput
from devrf.rendering.sampling import Samples
from devrf.scenes.procedural import Material, ProceduralScene
from devrf.scenes.scene import Scene


def seen(
    batch: RayBatch,
    ray: Tensor,
    points: Tensor,
    canonical: Tensor,
    weight: Tensor,
) -> VoxelOutput:
    """An output that holds what the motion terms look at."""
    rays = len(batch.rays)
    return VoxelOutput(
        color=torch.zeros(rays, 3),
        depth=torch.zeros(rays),
        transmittance=torch.zeros(rays),
        samples=Samples(ray, torch.zeros(len(ray)), points, rays),
        canonical=canonical,
        weight=weight,
        sample_color=torch.zeros(len(ray), 3),
    )


@pytest.fixture
def by_hand(ray_batch: Callable[..., RayBatch]) -> MotionPrediction:
    """Two rays of image 1, whose flow leads into image 0; three samples before them.

    Both cameras are at the origin and look along −z; image 0 has another lens. The motion: at t
    everything has moved by (0.3, 0, 0), one frame earlier by (0.1, 0, 0).
    """
    cameras = Cameras(
        torch.eye(3, 4)[None].repeat(2, 1, 1),
        torch.tensor([[10.0, 20.0], [3.0, 4.0]]),
        torch.tensor([[8.0, 6.0]] * 2),
        16,
        12,
    )
    pixel = torch.tensor([[8.5, 6.5], [10.5, 4.5]])
    image = torch.tensor([1, 1])
    batch = ray_batch(
        cameras.rays(image, pixel),
        time=torch.ones(2),
        frame=torch.ones(2, dtype=torch.long),
        image=image,
        pixel=pixel,
        flow=torch.tensor([[-1.0, 0.5], [9.0, 9.0]]),
        flow_valid=torch.tensor([True, False]),
    )
    ray = torch.tensor([0, 0, 1])
    points = torch.tensor([[0.1, -0.05, -2.0], [0.2, -0.1, -4.0], [0.5, 0.15, -2.0]])
    output = seen(
        batch, ray, points, points - torch.tensor([0.3, 0.0, 0.0]), torch.tensor([0.5, 0.25, 1.0])
    )
    forth, before = torch.tensor([0.3, 0.0, 0.0]), torch.tensor([0.1, 0.0, 0.0])
    return MotionPrediction(
        output,
        batch,
        lambda q: q + forth,
        lambda q: q + before,
        cameras,
        torch.tensor([0, 0]),
        torch.zeros(2, 2, 2, 3),
        Box((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)),
    )


def test_cycle_of_an_exact_motion_is_zero_and_of_another_by_hand(
    by_hand: MotionPrediction,
) -> None:
    assert cycle(by_hand).item() == pytest.approx(0, abs=1e-12)
    # There by −0.3, back by (0.3, 0.2, −0.1): ½ (0.04 + 0.01) at each sample.
    way = torch.tensor([0.3, 0.2, -0.1])
    off = replace(by_hand, unwarp=lambda q: q + way)
    assert cycle(off).item() == pytest.approx(0.025)


def test_flow_by_hand(by_hand: MotionPrediction) -> None:
    # Through image 0's lens both samples of ray 0 lie on its pixel. Moved back by 0.2 along x
    # they shift by −10·0.2/2 = −1 and −10·0.2/4 = −0.5 pixels, with none along y.
    # Against (−1, 0.5): 0.5 and 1.0, weighted by 0.5 and 0.25; one valid ray; ray 1 is masked.
    assert flow(by_hand).item() == pytest.approx(0.5 * 0.5 + 0.25 * 1.0, abs=1e-5)


def test_flow_as_a_mean_over_both_components_of_the_samples(by_hand: MotionPrediction) -> None:
    """Two of the three samples are on the ray whose flow is valid."""
    value = (0.5 * 0.5 + 0.25 * 1.0) / (2 * 2)
    assert flow(replace(by_hand, flow_mean="samples")).item() == pytest.approx(value, abs=1e-6)


def test_flow_counts_valid_rays_even_those_that_see_nothing(by_hand: MotionPrediction) -> None:
    both = replace(by_hand.batch, flow_valid=torch.tensor([True, True]))
    # Ray 1: −10·0.2/2 = −1 along x, against (9, 9): 10 + 9, weight 1; now two rays.
    assert flow(replace(by_hand, batch=both)).item() == pytest.approx((0.5 + 19) / 2, abs=1e-4)


def test_without_observed_flow_or_samples_nothing_is_learned(by_hand: MotionPrediction) -> None:
    blind = replace(by_hand.batch, flow=None, flow_valid=None)
    assert flow(replace(by_hand, batch=blind)).item() == 0
    nothing = by_hand.batch.flow_valid
    assert nothing is not None
    masked = replace(by_hand.batch, flow_valid=torch.zeros_like(nothing))
    assert flow(replace(by_hand, batch=masked)).item() == 0
    none = torch.zeros(0, 3)
    empty = seen(by_hand.batch, torch.zeros(0, dtype=torch.long), none, none, torch.zeros(0))
    assert cycle(replace(by_hand, output=empty)).item() == 0
    assert flow(replace(by_hand, output=empty)).item() == 0


def exact(scene: Scene, recipe: ProceduralScene, frame: int) -> MotionPrediction:
    """Each valid pixel of a frame with its exact surface point and the exact motion."""
    views, shape = scene.dynamic.train, recipe.model()
    assert views.flow is not None and views.depth is not None
    times = scene.clock.times
    chosen = scene.clock.frames_of(views.times) == frame
    image, row, column = (views.flow.valid & chosen[:, None, None]).nonzero().unbind(-1)
    flat = row * views.width + column
    batch = gather_batch(views, image, flat, torch.ones(3))
    every = torch.arange(len(flat))
    points = batch.rays.at(every, views.depth[image, row, column])
    material = shape.material(points, times[frame])

    def at(time: float, q: Tensor) -> Tensor:
        return shape.forward(Material(q, material.part), time)

    return MotionPrediction(
        seen(batch, every, points, material.rest, torch.ones(len(flat))),
        batch,
        lambda q: at(times[frame], q),
        lambda q: at(times[frame - 1], q),
        views.cameras,
        previous_images(views),
        torch.zeros(2, 2, 2, 3),
        scene.bounds.box,
    )


@pytest.mark.parametrize("frame", [1, 2])
def test_induced_flow_of_the_exact_motion_is_the_exact_flow(
    tiny_scene: Scene, tiny_recipe: ProceduralScene, frame: int
) -> None:
    prediction = exact(tiny_scene, tiny_recipe, frame)
    batch, output = prediction.batch, prediction.output
    assert batch.flow is not None and len(batch.flow) > 100
    induced = induced_flow(
        output.canonical,
        prediction.unwarp_previous,
        prediction.cameras,
        prediction.previous_image[batch.image],
        batch.pixel,
    )
    torch.testing.assert_close(induced, batch.flow, atol=1e-3, rtol=0)
    assert batch.flow.abs().amax(dim=0).min() > 0.5
    assert cycle(prediction).item() < 1e-9
    assert flow(prediction).item() < 1e-3
    swapped = replace(batch, flow=batch.flow.flip(1))
    assert flow(replace(prediction, batch=swapped)).item() > 0.2


def test_total_variation_weight_by_hand() -> None:
    assert total_variation_weight(2.0, 64, 100) == pytest.approx(1 / 600)
