"""The deformation losses by kernels, and their gradients, against their definitions."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch

from devrf.data.batch import RayBatch
from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras
from devrf.geometry.ndc import NormalizedDevice
from devrf.geometry.space import WORLD, Space
from devrf.methods.devrf.deformation_field import GridWarp
from devrf.methods.devrf.losses import DeformationPrediction, cycle, flow
from devrf.rendering.output import VoxelOutput
from random_samples import samples_of

BOX = Box((0.2, 0.1, 0.0), (0.9, 0.8, 0.95))
RAYS = 100


def predicted(
    zero_outside_box: bool, space: Space, flow_mean: Any, rng: torch.Generator
) -> DeformationPrediction:
    """Random samples in and around a box of random displacements; half of the rays have flow."""
    ray = torch.randint(RAYS, (900,), generator=rng).sort().values
    samples = samples_of(ray, RAYS, rng)
    samples = replace(samples, points=torch.rand(900, 3, generator=rng))
    samples.canonical.requires_grad_()
    samples.weight.requires_grad_()
    there, before = 0.1 * torch.randn(2, 4, 5, 3, 3, generator=rng)
    positions = torch.tensor([[0.5, 0.5, 3.0]]) + 0.2 * torch.randn(3, 3, generator=rng)
    cameras = Cameras.looking_at(
        positions, torch.full((3, 3), 0.5), focal=30.0, width=20, height=20
    )
    image = torch.randint(3, (RAYS,), generator=rng)
    pixel = 20 * torch.rand(RAYS, 2, generator=rng)
    nothing = torch.zeros(RAYS)
    batch = RayBatch(
        rays=cameras.rays(image, pixel),
        color=torch.zeros(RAYS, 3),
        alpha=None,
        background=torch.zeros(3),
        time=nothing,
        frame=image,
        image=image,
        pixel=pixel,
        flow=torch.randn(RAYS, 2, generator=rng),
        flow_valid=torch.rand(RAYS, generator=rng) < 0.5,
    )
    output = VoxelOutput(
        color=batch.color,
        depth=nothing,
        transmittance=nothing,
        samples=samples,
        sample_color=torch.zeros(900, 3),
        background=batch.background,
    )
    outside = {"zero_outside_box": zero_outside_box}
    return DeformationPrediction(
        output,
        batch,
        forward_warp=GridWarp(there.requires_grad_(), BOX, **outside),
        previous_forward_warp=GridWarp(before, BOX, **outside),
        cameras=cameras,
        previous_image=torch.tensor([2, 0, 1]),
        forward_slice=there,
        box=BOX,
        space=space,
        flow_mean=flow_mean,
    )


@pytest.mark.parametrize("zero_outside_box", [False, True])
@pytest.mark.parametrize("space", [WORLD, NormalizedDevice(20, 20, (30.0, 31.0), near=0.5)])
@pytest.mark.parametrize("flow_mean", ["rays", "samples"])
@pytest.mark.parametrize("moves", [True, False])
def test_values_and_gradients_are_those_of_the_definitions(
    zero_outside_box: bool, space: Space, flow_mean: str, moves: bool, rng: torch.Generator
) -> None:
    prediction = predicted(zero_outside_box, space, flow_mean, rng)
    if not moves:
        prediction = replace(prediction, previous_forward_warp=GridWarp(None, BOX))
    samples = prediction.output.samples
    learned = [samples.canonical, samples.weight, prediction.forward_slice]
    # A function is no grid: it takes the definition.
    forth, before = prediction.forward_warp, prediction.previous_forward_warp
    plain = replace(
        prediction,
        forward_warp=lambda q: forth(q),
        previous_forward_warp=lambda q: before(q),
    )
    for term, of in ((cycle, [0, 2]), (flow, [0, 1])):
        ours, theirs = term(prediction), term(plain)
        torch.testing.assert_close(ours, theirs, rtol=1e-5, atol=1e-7)
        assert theirs > 1e-3
        inputs = [learned[k] for k in of]
        of_ours = torch.autograd.grad(3 * ours, inputs)
        of_theirs = torch.autograd.grad(3 * theirs, inputs)
        for one, other in zip(of_ours, of_theirs, strict=True):
            scale = other.abs().max()
            torch.testing.assert_close(one / scale, other / scale, rtol=0, atol=2e-5)


def test_nothing_is_learned_without_samples_or_flow(rng: torch.Generator) -> None:
    prediction = predicted(False, WORLD, "samples", rng)
    none = samples_of(torch.zeros(0, dtype=torch.long), RAYS, rng)
    empty = replace(prediction, output=replace(prediction.output, samples=none))
    assert cycle(empty).item() == flow(empty).item() == 0
    nowhere = replace(prediction.batch, flow_valid=torch.zeros(RAYS, dtype=torch.bool))
    for mean in ("rays", "samples"):
        assert flow(replace(prediction, batch=nowhere, flow_mean=mean)).item() == 0
