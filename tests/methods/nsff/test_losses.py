"""The loss terms, where they are known by hand."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
import torch

from devrf.data.batch import RayBatch
from devrf.methods.nsff import losses
from devrf.methods.nsff.fields import DynamicSamples
from devrf.methods.nsff.losses import TERMS, LossInput, normalised, photometric
from devrf.methods.nsff.model import NSFF
from devrf.methods.nsff.priors import ImagePriors
from devrf.methods.nsff.renders import BlendedOutput, Renders
from devrf.scenes.scene import Scene


def given(model: NSFF, batch: RayBatch, *, chains: bool = False, **changes: Any) -> LossInput:
    """What the terms see of a batch; ``changes`` are made to the dynamic field's samples."""
    output = model(batch)
    assert isinstance(output, BlendedOutput)
    output = replace(output, dynamic=replace(output.dynamic, **changes))
    renders = Renders(model.fields, model.times, output, batch, both=True, weighted=False)
    return LossInput(renders, model.placement, None, 0, chains, 1.0)


def still(model: NSFF, batch: RayBatch) -> torch.Tensor:
    """Flows (S, 2, 3) of nothing."""
    output = model(batch)
    assert isinstance(output, BlendedOutput)
    return torch.zeros_like(output.dynamic.flow)


def test_errors_are_weighted_by_ray() -> None:
    color = torch.tensor([[0.5, 0.0, 0.0], [1.0, 1.0, 1.0]])
    found = photometric(color, torch.zeros(2, 3), torch.tensor([3.0, 1.0]))
    assert found.item() == pytest.approx((3 * 0.25 / 3 + 1 * 1) / 4)
    assert photometric(color, color * 0, torch.zeros(2)).item() == 0


def test_a_scene_at_rest_costs_nothing(placed: NSFF, batch: RayBatch) -> None:
    at_rest = given(placed, batch, flow=still(placed, batch))
    for name in ("small_flow", "smooth_space", "smooth_time"):
        assert TERMS[name](at_rest).item() == 0, name


def test_a_translation_is_smooth_but_not_small(placed: NSFF, batch: RayBatch) -> None:
    flow = still(placed, batch)
    flow[:, 0], flow[:, 1] = torch.tensor([0.1, 0.0, 0.0]), torch.tensor([-0.1, 0.0, 0.0])
    moving = given(placed, batch, flow=flow)
    assert TERMS["smooth_space"](moving).item() == pytest.approx(0, abs=1e-6)
    assert TERMS["smooth_time"](moving).item() == pytest.approx(0, abs=1e-6)
    # |0.1| on one of three axes, as far as a ray is opaque.
    opacity = torch.zeros(8).index_add(0, moving.renders.output.samples.ray, moving.renders.seen[1])
    assert TERMS["small_flow"](moving).item() == pytest.approx(
        0.1 / 3 * opacity.mean().item(), rel=1e-4
    )


def test_a_turn_in_the_path_is_bent(placed: NSFF, batch: RayBatch) -> None:
    flow = still(placed, batch)
    flow[..., 0] = 0.1  # there and there again: X⁺ + X⁻ − 2X = 0.2 along x
    found = TERMS["smooth_time"](given(placed, batch, flow=flow)).item()
    assert found == pytest.approx(2 * 0.5 * 0.2**2 / 3, rel=1e-4)


def test_a_flow_that_changes_along_a_ray_is_rough(placed: NSFF, batch: RayBatch) -> None:
    output = placed(batch)
    assert isinstance(output, BlendedOutput)
    flow, ray = still(placed, batch), output.samples.ray
    number = torch.arange(len(ray)) - torch.searchsorted(ray, ray)
    flow[:, 0, 1] = 0.01 * number
    found = TERMS["smooth_space"](given(placed, batch, flow=flow)).item()
    assert found == pytest.approx(0.01 / 3, rel=1e-3)


@pytest.mark.parametrize(("occluded", "expected"), [(0.0, 0.1 / 3), (1.0, 0.0)])
def test_what_does_not_return_costs_where_it_is_seen(
    placed: NSFF, batch: RayBatch, occluded: float, expected: float
) -> None:
    """There by 0.1 along x; no way back."""
    flow = still(placed, batch)
    flow[..., 0] = 0.1
    head = placed.fields.dynamic.further
    with torch.no_grad():
        head.weight[:6], head.bias[:6] = 0.0, 0.0
    seen = torch.full_like(flow[..., 0], occluded)
    found = TERMS["cycle"](given(placed, batch, flow=flow, occlusion=seen)).item()
    assert found == pytest.approx(2 * expected, rel=1e-4, abs=1e-6)


def test_certainty_has_no_entropy_and_occlusion_is_counted(placed: NSFF, batch: RayBatch) -> None:
    output = placed(batch)
    assert isinstance(output, BlendedOutput)
    for v, expected in ((1.0, 0.0), (0.5, 0.5 * math.log(2)), (0.0, 0.0)):
        blend = torch.full_like(output.static.blend, v)
        changed = replace(output, static=replace(output.static, blend=blend))
        renders = Renders(placed.fields, placed.times, changed, batch, both=True, weighted=False)
        entropy = TERMS["blend_entropy"](LossInput(renders, placed.placement, None, 0, False, 1.0))
        assert entropy.item() == pytest.approx(expected, abs=1e-6)
    o = torch.tensor([0.25, 0.5]).expand(len(output.points), 2)
    assert TERMS["disocclusion"](given(placed, batch, occlusion=o)).item() == pytest.approx(0.75)


def test_depths_are_compared_up_to_scale_and_shift() -> None:
    depth = torch.tensor([1.0, 2.0, 4.0, 8.0, 9.0])
    torch.testing.assert_close(normalised(depth), normalised(3 * depth + 7))
    # Median 4, mean absolute deviation (3 + 2 + 0 + 4 + 5) / 5.
    assert normalised(depth)[0].item() == pytest.approx(-3 / 2.8)


def opaque_surface(model: NSFF, batch: RayBatch, distance: torch.Tensor) -> BlendedOutput:
    """The batch with one sample a ray, at ``distance`` along it, opaque and dynamic."""
    output = model(batch)
    assert isinstance(output, BlendedOutput)
    count = len(batch.rays)
    ray = torch.arange(count)
    points = model.placement.normalised(batch.rays.at(ray, distance))
    samples = replace(
        output.samples, ray=ray, distance=distance, length=torch.ones(count), points=points
    )
    zeros = torch.zeros(count)
    dynamic = DynamicSamples(
        zeros, torch.zeros(count, 3), torch.zeros(count, 2, 3), torch.zeros(count, 2)
    )
    depths = (torch.full((count,), 50.0), zeros)
    return replace(output, samples=samples, points=points, dynamic=dynamic, depths=depths)


@pytest.fixture
def seen(tiny_scene: Scene) -> tuple[ImagePriors, Scene]:
    """The priors of the dynamic images alone."""
    return ImagePriors([tiny_scene.dynamic.train], tiny_scene.space), tiny_scene


def test_exact_surfaces_agree_with_the_priors(
    placed: NSFF, batch: RayBatch, seen: tuple[ImagePriors, Scene], tiny_recipe: Any
) -> None:
    """On the true surface, moved as it truly moves, depth and flow cost next to nothing."""
    priors, scene = seen
    truth = priors.distance(batch)
    hit = truth.isfinite() & batch.flow_valid
    assert hit.sum() == 6
    output = opaque_surface(placed, batch, torch.where(hit, truth, 1.0))
    shape = tiny_recipe.filmed()
    world = batch.rays.at(torch.arange(8), torch.where(hit, truth, 1.0))
    before = shape.forward(shape.material(world, 0.5), 0.0)
    flow = output.dynamic.flow.clone()
    flow[:, 1] = torch.where(
        hit[:, None], (before - world) / placed.placement.half_edge, flow[:, 1]
    )
    moved = replace(output, dynamic=replace(output.dynamic, flow=flow))
    costs = {}
    for name, out in (("still", output), ("moved", moved)):
        renders = Renders(placed.fields, placed.times, out, batch, both=True, weighted=False)
        known = LossInput(renders, placed.placement, priors, 0, False, 0.5)
        costs[name] = losses.flow(known).item()
        assert losses.depth(known).item() < 1e-6
    assert costs["moved"] < 1e-3 < costs["still"]


def test_priors_weigh_what_they_have_decayed_to(
    placed: NSFF, batch: RayBatch, seen: tuple[ImagePriors, Scene]
) -> None:
    output = placed(batch)
    assert isinstance(output, BlendedOutput)
    renders = Renders(placed.fields, placed.times, output, batch, both=True, weighted=False)
    for term in (losses.flow, losses.depth):
        one, tenth = (
            term(LossInput(renders, placed.placement, seen[0], 0, False, factor)).item()
            for factor in (1.0, 0.1)
        )
        assert one > 0 and tenth == pytest.approx(0.1 * one)


def test_rays_count_by_how_dynamic_they_are_after_the_beginning(
    placed: NSFF, batch: RayBatch
) -> None:
    output = placed(batch)
    assert isinstance(output, BlendedOutput)
    early, late = (
        Renders(placed.fields, placed.times, output, batch, both=True, weighted=weighted)
        for weighted in (False, True)
    )
    assert torch.equal(early.dynamic_share, torch.ones(8))
    torch.testing.assert_close(
        late.dynamic_share,
        torch.zeros(8).index_add(0, output.samples.ray, output.blend.dynamic).detach(),
    )
    assert not late.dynamic_share.requires_grad


def test_nothing_is_chained_too_early(placed: NSFF, batch: RayBatch) -> None:
    assert TERMS["chained"](given(placed, batch)).item() == 0
    # Of three frames only the outer ones have one two steps away.
    assert TERMS["chained"](given(placed, batch, chains=True)).item() == 0
    first = replace(batch, frame=torch.zeros_like(batch.frame))
    assert TERMS["chained"](given(placed, first, chains=True)).item() > 0
