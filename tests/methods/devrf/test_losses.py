"""The terms of the loss by hand, and the flow that an exact motion induces in a scene."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from devrf.data.batch import RayBatch
from devrf.data.flow import previous_images
from devrf.errors import DevrfError
from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras
from devrf.geometry.rays import Rays
from devrf.methods.batch import gather_batch
from devrf.methods.devrf.losses import (
    PHOTOMETRIC_TERMS,
    DeformationPrediction,
    Prediction,
    batch_loss,
    cycle,
    flow,
    induced_flow,
)
from devrf.methods.weighted_loss import counted_weights
from devrf.ops.compositing import firsts
from devrf.ops.march import Samples
from devrf.ops.photometric import distortion
from devrf.rendering.output import VoxelOutput
from devrf.scenes.procedural import Material, ProceduralScene
from devrf.scenes.scene import Scene

RAY = torch.tensor([0, 0, 2])


def batch_of(rays: Rays, **known: Any) -> RayBatch:
    """A batch of rays with what is ``known`` of them, and nothing else."""
    count = len(rays)
    usual: dict[str, Any] = {
        "color": torch.zeros(count, 3),
        "alpha": None,
        "background": torch.zeros(3),
        "time": torch.zeros(count),
        "frame": torch.zeros(count, dtype=torch.long),
        "image": torch.zeros(count, dtype=torch.long),
        "pixel": torch.zeros(count, 2),
        "flow": None,
        "flow_valid": None,
    }
    return RayBatch(rays, **{**usual, **known})


@pytest.fixture
def prediction() -> Prediction:
    """Rays 0 and 2 see two samples and one, ray 1 sees none."""
    weight = torch.tensor([0.5, 0.25, 0.8], requires_grad=True)
    sample_color = torch.tensor(
        [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.5, 0.5, 0.5]], requires_grad=True
    )
    left = torch.tensor([0.25, 1.0, 0.2])
    output = VoxelOutput(
        color=torch.tensor([[0.5, 0.25, 0.0], [0.0, 0.0, 0.0], [0.4, 0.4, 0.4]]),
        depth=torch.zeros(3),
        transmittance=left,
        samples=Samples(
            RAY,
            torch.ones(3),
            *torch.zeros(2, 3, 3),
            weight,
            left,
            torch.zeros(3),
            torch.tensor([2, 2, 3]),
        ),
        sample_color=sample_color,
        background=torch.zeros(3),
    )
    batch = batch_of(
        Rays(*[torch.zeros(3, 3)] * 3),
        color=torch.tensor([[1.0, 0.25, 0.0], [0.0, 0.0, 0.6], [0.4, 0.4, 0.1]]),
        alpha=torch.tensor([1.0, 0.0, 0.5]),
    )
    return Prediction(output, batch)


def test_color_and_per_sample_color_by_hand(prediction):
    assert PHOTOMETRIC_TERMS["render"](prediction).item() == pytest.approx((0.25 + 0.36 + 0.09) / 9)
    # |c − C|²: (0, .25, 0)² = .0625; (1, .75, 0)² = 1.5625; (.1, .1, .4)² = .18; three rays.
    expected = (0.5 * 0.0625 + 0.25 * 1.5625 + 0.8 * 0.18) / 3
    assert PHOTOMETRIC_TERMS["per_sample_color"](prediction).item() == pytest.approx(expected)
    # Its gradient stops at the weights.
    PHOTOMETRIC_TERMS["per_sample_color"](prediction).backward()
    assert prediction.output.samples.weight.grad is None
    # 2 · w · (c − C) / R of the first sample's green.
    assert prediction.output.sample_color.grad is not None
    assert prediction.output.sample_color.grad[0, 1].item() == pytest.approx(2 * 0.5 * -0.25 / 3)


def test_entropy_by_hand_and_with_finite_gradients_at_its_ends(prediction):
    def entropy(p: float) -> float:
        return -(p * math.log(p) + (1 - p) * math.log(1 - p))

    expected = (entropy(0.25) + 0 + entropy(0.2)) / 3
    assert PHOTOMETRIC_TERMS["entropy"](prediction).item() == pytest.approx(expected, abs=1e-5)
    end = torch.tensor([0.0, 1.0, 1.0], requires_grad=True)
    output = replace(prediction.output, transmittance=end)
    PHOTOMETRIC_TERMS["entropy"](replace(prediction, output=output)).backward()
    assert end.grad is not None and end.grad.isfinite().all()


def test_distortion_by_hand():
    # Rays 0 and 2 of four; 2 · (0.5 · 0.25 · 2 + 0.5 · 0.125 · 3 + 0.25 · 0.125 · 1) of ray 0.
    weight = torch.tensor([0.5, 0.25, 0.125, 0.75], requires_grad=True)
    distance, ray = torch.tensor([1.0, 3.0, 4.0, 2.0]), torch.tensor([0, 0, 0, 2])
    spread = distortion(weight, distance, ray, 4)
    assert spread.item() == pytest.approx(2 * (0.25 + 0.1875 + 0.03125) / 4)
    spread.backward()
    assert weight.grad is not None
    # A sample alone on its ray may be as opaque as it likes.
    assert weight.grad.tolist() == pytest.approx([0.4375, 0.5625, 0.875, 0.0])


def test_samples_of_unequal_lengths_are_spread_by_themselves_too():
    weight = torch.tensor([0.5, 0.25, 0.75])
    distance, ray = torch.tensor([1.0, 3.0, 2.0]), torch.tensor([0, 0, 1])
    length = torch.tensor([2.0, 1.0, 4.0])
    own = (0.5**2 * 2 + 0.25**2 * 1 + 0.75**2 * 4) / 3
    spread = distortion(weight, distance, ray, 2, length)
    assert spread.item() == pytest.approx((2 * 0.5 * 0.25 * 2 + own) / 2)


def test_alpha_mask_by_hand_and_without_one(prediction):
    # T − (1 − alpha) = 0.25, 0, −0.3.
    assert PHOTOMETRIC_TERMS["alpha_mask"](prediction).item() == pytest.approx((0.0625 + 0.09) / 3)
    without = replace(prediction, batch=replace(prediction.batch, alpha=None))
    assert PHOTOMETRIC_TERMS["alpha_mask"](without).item() == 0


def test_the_loss_weighs_what_counts_and_reports_it_unweighted(prediction):
    weights = counted_weights({"alpha_mask": 2.0, "render": 0.0}, PHOTOMETRIC_TERMS, "loss.fine")
    total, values = batch_loss(prediction, PHOTOMETRIC_TERMS, weights)
    assert (
        list(values) == ["alpha_mask", "opacity", "coverage"] and total == 2 * values["alpha_mask"]
    )
    # 1 − (0.25 + 1 + 0.2) / 3, and (1 + 0 + 0.5) / 3.
    assert values["opacity"].item() == pytest.approx(1.55 / 3)
    assert values["coverage"].item() == pytest.approx(0.5)
    without = replace(prediction, batch=replace(prediction.batch, alpha=None))
    assert batch_loss(without, PHOTOMETRIC_TERMS, weights)[1].keys() == {"alpha_mask", "opacity"}
    with pytest.raises(DevrfError, match="loss.fine: unknown term 'colour'.*alpha_mask, entropy"):
        counted_weights({"colour": 1.0}, PHOTOMETRIC_TERMS, "loss.fine")
    with pytest.raises(DevrfError, match="loss.fine.render: .*at least 0, not -1"):
        counted_weights({"render": -1.0}, PHOTOMETRIC_TERMS, "loss.fine")


def test_a_term_of_ones_own_counts_beside_those_of_the_kernel(prediction):
    def mass(prediction: Prediction) -> Tensor:
        return prediction.output.samples.weight.sum()

    # A further name, and another function under a known one.
    terms = {**PHOTOMETRIC_TERMS, "mass": mass, "entropy": lambda seen: 3 * mass(seen)}
    weights = {"alpha_mask": 2.0, "mass": 0.5, "entropy": 0.25}
    total, values = batch_loss(prediction, terms, weights)
    assert values["mass"].item() == pytest.approx(1.55)
    assert values["entropy"].item() == pytest.approx(4.65)
    expected = 2 * values["alpha_mask"] + 0.5 * 1.55 + 0.25 * 4.65
    assert total.item() == pytest.approx(expected.item())
    total.backward()
    # 0.5 + 0.25 · 3; the alpha masks' term says nothing of weights.
    assert prediction.output.samples.weight.grad.tolist() == pytest.approx([1.25] * 3)


def seen(
    batch: RayBatch, ray: Tensor, points: Tensor, canonical: Tensor, weight: Tensor
) -> VoxelOutput:
    """An output that holds what the deformation terms look at."""
    none = torch.zeros(len(batch.rays))
    return VoxelOutput(
        color=torch.zeros(len(none), 3),
        depth=none,
        transmittance=none,
        samples=Samples(
            ray,
            torch.zeros(len(ray)),
            points,
            canonical,
            weight,
            none,
            none,
            firsts(ray, len(none))[1:],
        ),
        sample_color=torch.zeros(len(ray), 3),
        background=torch.zeros(3),
    )


@pytest.fixture
def by_hand() -> DeformationPrediction:
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
    batch = batch_of(
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
    return DeformationPrediction(
        output,
        batch,
        lambda q: q + forth,
        lambda q: q + before,
        cameras,
        torch.tensor([0, 0]),
        torch.zeros(2, 2, 2, 3),
        Box((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)),
    )


def test_cycle_of_an_exact_motion_is_zero_and_of_another_by_hand(by_hand):
    assert cycle(by_hand).item() == pytest.approx(0, abs=1e-12)
    # There by −0.3, back by (0.3, 0.2, −0.1): ½ (0.04 + 0.01) at each sample.
    way = torch.tensor([0.3, 0.2, -0.1])
    off = replace(by_hand, forward_warp=lambda q: q + way)
    assert cycle(off).item() == pytest.approx(0.025)


def test_flow_by_hand(by_hand):
    # Through image 0's lens both samples of ray 0 lie on its pixel. Moved back by 0.2 along x
    # they shift by −10·0.2/2 = −1 and −10·0.2/4 = −0.5 pixels, with none along y.
    # Against (−1, 0.5): 0.5 and 1.0, weighted by 0.5 and 0.25; one valid ray; ray 1 is masked.
    by_rays = replace(by_hand, flow_mean="rays")
    assert flow(by_rays).item() == pytest.approx(0.5, abs=1e-5)
    # As a mean over both components of the two samples on the ray whose flow is valid.
    assert flow(replace(by_hand, flow_mean="samples")).item() == pytest.approx(0.125, abs=1e-6)
    both = replace(by_hand.batch, flow_valid=torch.tensor([True, True]))
    # Ray 1: −10·0.2/2 = −1 along x, against (9, 9): 10 + 9, weight 1; now two rays.
    assert flow(replace(by_rays, batch=both)).item() == pytest.approx((0.5 + 19) / 2, abs=1e-4)


def test_without_observed_flow_or_samples_nothing_is_learned(by_hand):
    blind = replace(by_hand.batch, flow=None, flow_valid=None)
    masked = replace(by_hand.batch, flow_valid=torch.tensor([False, False]))
    assert [flow(replace(by_hand, batch=batch)).item() for batch in (blind, masked)] == [0, 0]
    none = torch.zeros(0, 3)
    empty = seen(by_hand.batch, torch.zeros(0, dtype=torch.long), none, none, torch.zeros(0))
    without = replace(by_hand, output=empty)
    assert cycle(without).item() == flow(without).item() == 0


def exact(scene: Scene, recipe: ProceduralScene, frame: int) -> DeformationPrediction:
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

    return DeformationPrediction(
        seen(batch, every, points, material.canonical, torch.ones(len(flat))),
        batch,
        lambda q: at(times[frame], q),
        lambda q: at(times[frame - 1], q),
        views.cameras,
        previous_images(views),
        torch.zeros(2, 2, 2, 3),
        scene.bounds.box,
    )


def test_induced_flow_of_the_exact_motion_is_the_exact_flow(tiny_scene, tiny_recipe):
    prediction = exact(tiny_scene, tiny_recipe, 2)
    batch, output = prediction.batch, prediction.output
    assert batch.flow is not None and len(batch.flow) > 100
    induced = induced_flow(
        output.samples.canonical,
        prediction.previous_forward_warp,
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
