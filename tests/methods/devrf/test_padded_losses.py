"""Every term of a padded list, and every gradient, is that of the list without its padding."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from devrf.data.batch import RayBatch
from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras
from devrf.methods.devrf.deformation_field import GridWarp
from devrf.methods.devrf.losses import MOTION_TERMS, MotionPrediction, flow
from devrf.rendering.output import VoxelOutput
from devrf.rendering.sampling import Samples

RAYS = 6
BOX = Box((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))


def draw(seed: int, *shape: int) -> Tensor:
    rng = torch.Generator().manual_seed(seed)
    return torch.rand(*shape, generator=rng, dtype=torch.float64)


class Case:
    """Six rays with random samples, as an exact list and with padding behind it."""

    def __init__(self, ray: Tensor, padding: int) -> None:
        count = len(ray)
        self.weight = draw(1, count).requires_grad_()
        self.color = draw(2, count, 3).requires_grad_()
        self.canonical = (2 * draw(3, count, 3) - 1).requires_grad_()
        self.slices = [(0.2 * draw(seed, 3, 4, 3, 3)).requires_grad_() for seed in (4, 5)]
        self.ray, self.points, self.padding = ray, 2 * draw(6, count, 3) - 1, padding
        position = torch.tensor([[0.0, 0.0, 4.0], [0.3, 0.0, 5.0]], dtype=torch.float64)
        upright = torch.eye(3, dtype=torch.float64).repeat(2, 1, 1)
        pose = torch.cat([upright, position[..., None]], dim=2)
        cameras = Cameras(pose, 20 + draw(7, 2, 2), 8 + draw(8, 2, 2), 16, 16)
        flow_valid = torch.tensor([True, False, True, True, False, True])
        flow = torch.where(flow_valid[:, None], 4 * draw(9, RAYS, 2), 0.0)
        image, pixel = torch.tensor([1, 1, 0, 1, 0, 1]), 16 * draw(10, RAYS, 2)
        self.batch = RayBatch(
            rays=cameras.rays(image, pixel),
            color=draw(11, RAYS, 3),
            alpha=draw(12, RAYS),
            background=torch.zeros(3),
            time=torch.ones(RAYS),
            frame=torch.ones(RAYS, dtype=torch.long),
            image=image,
            pixel=pixel,
            flow=flow,
            flow_valid=flow_valid,
        )
        self.cameras = cameras

    @property
    def leaves(self) -> list[Tensor]:
        return [self.weight, self.color, self.canonical, *self.slices]

    def prediction(self, *, padded: bool) -> MotionPrediction:
        ray, points, weight = self.ray, self.points, self.weight
        color, canonical, present = self.color, self.canonical, None
        if padded:
            # Padding repeats samples, and has places where nothing should be looked at.
            more = torch.arange(self.padding)
            ray = torch.cat([ray, more % RAYS])
            points = torch.cat([points, 50 * draw(13, self.padding, 3)])
            color = torch.cat([color, color[:1].expand(self.padding, 3)])
            elsewhere = canonical[:1].expand(self.padding, 3) * torch.tensor([0.0, 0.0, 4.0])
            canonical = torch.cat([canonical, elsewhere])
            weight = torch.cat([weight, weight.new_zeros(self.padding)])
            present = torch.arange(len(ray)) < len(self.ray)
        output = VoxelOutput(
            color=draw(14, RAYS, 3),
            depth=draw(15, RAYS),
            transmittance=draw(16, RAYS),
            samples=Samples(ray, draw(17, len(ray)), points, RAYS, present),
            canonical=canonical,
            weight=weight,
            sample_color=color,
        )
        return MotionPrediction(
            output,
            self.batch,
            GridWarp((self.slices[0],), BOX),
            GridWarp((self.slices[1],), BOX),
            self.cameras,
            torch.tensor([0, 0]),
            self.slices[0],
            BOX,
        )


def flow_over_samples(prediction: MotionPrediction) -> Tensor:
    return flow(replace(prediction, flow_mean="samples"))


TERMS = {**MOTION_TERMS, "flow over samples": flow_over_samples}


@pytest.mark.parametrize("name", list(TERMS))
def test_padding_changes_no_term_and_no_gradient(name: str) -> None:
    case, term = Case(torch.tensor([0, 0, 1, 3, 3, 3, 4, 5]), 5), TERMS[name]
    exact, listed = term(case.prediction(padded=False)), term(case.prediction(padded=True))
    torch.testing.assert_close(listed, exact, atol=1e-14, rtol=1e-12)
    if not exact.requires_grad:
        return
    assert exact.item() > 0
    expected = torch.autograd.grad(exact, case.leaves, allow_unused=True, materialize_grads=True)
    found = torch.autograd.grad(listed, case.leaves, allow_unused=True, materialize_grads=True)
    for ours, theirs in zip(found, expected, strict=True):
        torch.testing.assert_close(ours, theirs, atol=1e-14, rtol=1e-12)


def test_padding_alone_teaches_nothing() -> None:
    case = Case(torch.zeros(1, dtype=torch.long), 4)
    alone = case.prediction(padded=True)
    samples = replace(alone.output.samples, present=torch.zeros(5, dtype=torch.bool))
    output = replace(alone.output, samples=samples, weight=torch.zeros(5, dtype=torch.float64))
    for name in ("cycle", "flow", "per_sample_color"):
        assert MOTION_TERMS[name](replace(alone, output=output)).item() == 0
