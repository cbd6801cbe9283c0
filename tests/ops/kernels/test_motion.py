"""Cycle and flow in one pass: as the terms themselves, in both implementations, and by hand."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from devrf.data.batch import RayBatch
from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras
from devrf.geometry.ndc import NormalizedDevice
from devrf.geometry.space import WORLD, Space
from devrf.methods.devrf.grid_warp import GridWarp
from devrf.methods.devrf.losses import (
    FLOW_TERMS,
    MOTION_TERMS,
    FlowMean,
    MotionPrediction,
    cycle,
)
from devrf.methods.devrf.volume_rendering import VoxelOutput
from devrf.methods.devrf.weighted_loss import WeightedLoss, motion_terms
from devrf.ops.dispatch import Kind, using
from devrf.ops.motion import ListedSamples, SeenEarlier, motion_sum
from devrf.ops.selfcheck import Draw
from devrf.ops.selfcheck import motion_terms as both_terms
from devrf.rendering.sampling import Samples

Both = Callable[[Callable[[], Sequence[Tensor]]], None]
BOX = Box((-1.0, -0.9, -0.8), (0.9, 1.0, 0.7))
RAYS, PLACES = 5, 300


def test_both_implementations_agree(agree: Both, device: torch.device) -> None:
    agree(lambda: both_terms(Draw(device)))


def predicted(device: torch.device, space: Space) -> tuple[MotionPrediction, list[Tensor]]:
    """Samples of five rays with padding behind them, and the leaves that learn."""
    draw = Draw(device)
    poses = 0.1 * draw(2, 3, 4) + torch.eye(3, 4).to(device)
    poses[:, 2, 3] += 4
    cameras = Cameras(poses, 20 + draw(2, 2), 8 + draw(2, 2), 16, 16)
    image, pixel = torch.tensor([0, 1, 1, 0, 1]).to(device), 8 + 8 * draw(RAYS, 2)
    batch = RayBatch(
        rays=cameras.rays(image, pixel),
        color=draw(RAYS, 3),
        alpha=None,
        background=torch.ones(3, device=device),
        time=torch.ones(RAYS, device=device),
        frame=torch.ones(RAYS, dtype=torch.long, device=device),
        image=image,
        pixel=pixel,
        flow=2 * draw(RAYS, 2),
        flow_valid=torch.tensor([True, True, False, True, False]).to(device),
    )
    leaves = [draw.leaf(PLACES, 3), draw.leaf(PLACES), draw.leaf(4, 3, 5, 3)]
    present = torch.arange(PLACES, device=device) < 280
    ray = torch.arange(PLACES, device=device) % RAYS
    samples = Samples(ray, draw(PLACES), draw(PLACES, 3), RAYS, present)
    output = VoxelOutput(
        color=draw(RAYS, 3),
        depth=draw(RAYS),
        transmittance=draw(RAYS),
        samples=samples,
        canonical=leaves[0],
        weight=leaves[1],
        sample_color=draw(PLACES, 3),
    )
    grids = GridWarp((leaves[2],), BOX), GridWarp((draw(4, 3, 5, 3),), BOX)
    previous = torch.tensor([1, 0]).to(device)
    return MotionPrediction(output, batch, *grids, cameras, previous, space), leaves


@pytest.mark.parametrize("space", [WORLD, NormalizedDevice(24, 18, (20.0, 20.0))])
@pytest.mark.parametrize("mean", ["rays", "samples"])
def test_one_pass_gives_the_terms_and_their_gradients(
    device: torch.device, space: Space, mean: FlowMean
) -> None:
    weights = {"cycle": 100.0, "flow": 0.005}
    loss: WeightedLoss[MotionPrediction] = WeightedLoss(
        MOTION_TERMS | {"flow": FLOW_TERMS[mean]}, weights
    )
    prediction, leaves = predicted(device, space)
    with using("torch"):
        total, terms = loss(prediction)
        expected = [total, *torch.autograd.grad(total, leaves)]
    with using("triton"):
        assert motion_terms(prediction, {cycle: 1.0}) is not None
        found_total, found_terms = loss(prediction)
        found = [found_total, *torch.autograd.grad(found_total, leaves)]
    assert found_terms.keys() == terms.keys()
    for name, value in terms.items():
        torch.testing.assert_close(found_terms[name], value, rtol=1e-5, atol=1e-6)
    for ours, theirs in zip(found, expected, strict=True):
        assert theirs.any()
        torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-5)


def test_a_term_that_does_not_count_changes_nothing(device: torch.device) -> None:
    prediction, leaves = predicted(device, WORLD)
    for name in ("cycle", "flow"):
        loss: WeightedLoss[MotionPrediction] = WeightedLoss(MOTION_TERMS, {name: 2.0})
        results = []
        for kind in ("torch", "triton"):
            with using(kind):  # type: ignore[arg-type]
                total, terms = loss(prediction)
                assert list(terms) == [name]
                gradients = torch.autograd.grad(
                    total, leaves, allow_unused=True, materialize_grads=True
                )
                results.append([total, *gradients])
        for ours, theirs in zip(*results, strict=True):
            torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-5)


def test_other_warps_take_the_terms_one_by_one(device: torch.device) -> None:
    prediction, _ = predicted(device, WORLD)
    exact = replace(prediction.output.samples, present=None)
    still = replace(prediction.unwarp, still_outside=True)  # type: ignore[type-var]
    with using("triton"):
        for other in (
            replace(prediction, output=replace(prediction.output, samples=exact)),
            replace(prediction, unwarp_previous=GridWarp((), BOX)),
            replace(prediction, unwarp=still),
        ):
            assert motion_terms(other, {cycle: 1.0}) is None
        assert motion_terms(prediction, {}) is None


@pytest.mark.parametrize("kernels", ["torch", "triton"])
def test_by_hand(device: torch.device, kernels: Kind) -> None:
    """Everything has moved by 0.2 along x, and by 0.1 one frame earlier; a camera looks down −z."""
    points = torch.tensor([[0.5, 0.0, -2.0], [0.0, 0.3, -2.0], [9.0, 9.0, 9.0]])
    canonical = torch.tensor([[0.2, 0.0, -2.0], [0.0, 0.0, -2.0], [0.0, 0.0, 0.0]])
    weight, ray = torch.tensor([0.5, 0.25, 7.0]), torch.tensor([0, 1, 0])
    forward, before = torch.zeros(2, 2, 2, 3), torch.zeros(2, 2, 2, 3)
    forward[..., 0], before[..., 0] = 0.2, 0.1
    seen = SeenEarlier(
        torch.tensor([[1.0, -1.0], [5.0, 5.0]]),
        torch.tensor([True, False]),
        torch.tensor([[8.0, 6.0], [1.0, 1.0]]),
        torch.tensor([1, 1]),
        torch.tensor([0, 0]),
        torch.eye(3, 4).repeat(2, 1, 1),
        torch.tensor([[10.0, 20.0], [0.0, 0.0]]),
        torch.tensor([[8.0, 6.0], [0.0, 0.0]]),
    )
    seen = SeenEarlier(*(tensor.to(device) for tensor in seen))
    present = torch.tensor([True, True, False])
    listed = [t.to(device) for t in (points, canonical, weight, ray, present)]
    leaves = [listed[1].requires_grad_(), listed[2].requires_grad_()]
    leaves.append(forward.to(device).requires_grad_())
    with using(kernels):
        found = motion_sum(
            ListedSamples(*listed),
            leaves[2],
            before.to(device),
            seen,
            (2.0, 4.0),
            box=Box((-1.0, -1.0, -3.0), (1.0, 1.0, -1.0)),
            over_samples=True,
        )
        found.total.backward()
    # Missed by (0.1, 0, 0) and (−0.2, 0.3, 0): half of 0.01 + 0.13, over two samples.
    # The first is seen 10·0.3/2 = 1.5 right of the centre: (0.5, 1) off, weight 0.5, two numbers.
    assert found.terms.tolist() == pytest.approx([0.035, 0.375], rel=1e-5)
    assert found.total.item() == pytest.approx(2 * 0.035 + 4 * 0.375, rel=1e-5)
    moved, changed, pulled = (leaf.grad for leaf in leaves)
    assert moved is not None and changed is not None and pulled is not None
    assert changed.tolist() == pytest.approx([4 * 1.5 / 2, 0.0, 0.0], rel=1e-5)
    # Cycle: −2·0.1/2; flow: 4·0.5/2·10/2 across, −4·0.5/2·20/2·sgn(1) down,
    # and along the axis 5·0.3/2 of the first, as its height is 0.
    assert moved[0].tolist() == pytest.approx([-0.1 + 5.0, -10.0, 0.75], rel=1e-4)
    assert moved[1].tolist() == pytest.approx([0.2, -0.3, 0.0], rel=1e-4)
    assert moved[2].tolist() == [0.0, 0.0, 0.0]
    # The corners' weights add up to 1: −2·(0.1 − 0.2)/2 and −2·0.3/2.
    assert pulled.sum(dim=(0, 1, 2)).tolist() == pytest.approx([0.1, -0.3, 0.0], abs=1e-6)


@pytest.mark.parametrize("kernels", ["torch", "triton"])
def test_what_is_at_infinity_or_beside_the_camera_stays_finite(
    device: torch.device, kernels: Kind
) -> None:
    prediction, leaves = predicted(device, NormalizedDevice(24, 18, (20.0, 20.0)))
    with torch.no_grad():
        leaves[0][:, 2] = 1.0
        for grid in (leaves[2], prediction.unwarp_previous.slices[0]):  # type: ignore[attr-defined]
            grid.zero_()
    at_camera, others = predicted(device, WORLD)
    with torch.no_grad():
        others[0].copy_(at_camera.cameras.positions[:1])
        at_camera.unwarp_previous.slices[0].zero_()  # type: ignore[attr-defined]
    loss: WeightedLoss[MotionPrediction] = WeightedLoss(MOTION_TERMS, {"cycle": 1.0, "flow": 1.0})
    for case, known in ((prediction, leaves), (at_camera, others)):
        with using(kernels):
            total, _ = loss(case)
            gradients = torch.autograd.grad(total, known)
        assert total.isfinite() and all(gradient.isfinite().all() for gradient in gradients)
