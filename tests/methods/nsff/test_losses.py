"""The loss terms, where they are known by hand."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch

from devrf.data.batch import RayBatch
from devrf.methods.nsff import losses
from devrf.methods.nsff.fields import DynamicSamples
from devrf.methods.nsff.losses import TERMS, normalised, photometric
from devrf.methods.nsff.model import NSFF
from devrf.methods.nsff.priors import ImagePriors
from devrf.methods.nsff.renders import BlendedOutput, Renders
from devrf.scenes.scene import Scene

Compared = Callable[..., Renders]


def still(model: NSFF, batch: RayBatch) -> torch.Tensor:
    """Flows (S, 2, 3) of nothing."""
    return torch.zeros_like(model(batch).dynamic.flow)


def test_errors_are_weighted_by_ray() -> None:
    color = torch.tensor([[0.5, 0.0, 0.0], [1.0, 1.0, 1.0]])
    error = photometric(color, torch.zeros(2, 3), torch.tensor([3.0, 1.0]))
    assert error.item() == pytest.approx((3 * 0.25 / 3 + 1 * 1) / 4)
    assert photometric(color, color * 0, torch.zeros(2)).item() == 0


def everywhere(model: NSFF, forward: float, backward: float) -> None:
    """Make the network's flows the same everywhere, along x."""
    head, reach = model.fields.dynamic.further, model.fields.dynamic.reach
    with torch.no_grad():
        head.weight[:6], head.bias[:6] = 0.0, 0.0
        head.bias[0], head.bias[3] = math.atanh(forward / reach), math.atanh(backward / reach)


def test_a_scene_at_rest_costs_nothing_and_a_translation_is_smooth_but_not_small(
    placed: NSFF, batch: RayBatch, compared: Compared
) -> None:
    everywhere(placed, 0.0, 0.0)
    at_rest = compared(placed, batch)
    for name in ("small_flow", "smooth_space", "smooth_time"):
        assert TERMS[name](at_rest).item() == 0, name
    everywhere(placed, 0.1, -0.1)
    moving = compared(placed, batch)
    assert TERMS["smooth_space"](moving).item() == pytest.approx(0, abs=1e-6)
    assert TERMS["smooth_time"](moving).item() == pytest.approx(0, abs=1e-6)
    # The release takes the mean of w |f| over the samples, of which each ray here has eight.
    mean = (moving.seen[1] * 0.1).mean().item()
    assert TERMS["small_flow"](moving).item() / 8 == pytest.approx(2 * mean, rel=1e-4)


def test_a_turn_in_the_path_is_bent(placed: NSFF, batch: RayBatch, compared: Compared) -> None:
    everywhere(placed, 0.1, 0.1)  # there and there again: X⁺ + X⁻ − 2X = 0.2 along x, chained 0
    bent = TERMS["smooth_time"](compared(placed, batch)).item()
    assert bent == pytest.approx(2 * 0.5 * 0.2**2 / 3, rel=1e-4)


@pytest.mark.parametrize("both", [True, False])
def test_a_path_that_stops_at_the_neighbour_is_bent_from_the_first_iteration(
    placed: NSFF, batch: RayBatch, compared: Compared, both: bool
) -> None:
    everywhere(placed, 0.0, 0.0)  # of the neighbour; that it came from here does not count
    flow = still(placed, batch)
    flow[:, 0, 0], flow[:, 1, 0] = 0.1, -0.1
    bent = TERMS["smooth_time"](compared(placed, batch, {"flow": flow}, both=both)).item()
    assert bent == pytest.approx(0.5 * 0.1**2 / 3, rel=1e-4)


def test_a_flow_that_changes_along_a_ray_is_rough(
    placed: NSFF, batch: RayBatch, compared: Compared
) -> None:
    flow, ray = still(placed, batch), placed(batch).samples.ray
    flow[:, 0, 1] = 0.01 * (torch.arange(len(ray)) - torch.searchsorted(ray, ray))
    rough = TERMS["smooth_space"](compared(placed, batch, {"flow": flow})).item()
    assert rough == pytest.approx(0.01 / 3, rel=1e-3)


@pytest.mark.parametrize(("occluded", "expected"), [(0.0, 0.1 / 3), (1.0, 0.0)])
def test_what_does_not_return_costs_where_it_is_seen(
    placed: NSFF, batch: RayBatch, compared: Compared, occluded: float, expected: float
) -> None:
    """There by 0.1 along x; no way back."""
    flow = still(placed, batch)
    flow[..., 0] = 0.1
    head = placed.fields.dynamic.further
    with torch.no_grad():
        head.weight[:6], head.bias[:6] = 0.0, 0.0
    occlusion = torch.full_like(flow[..., 0], occluded)
    miss = TERMS["cycle"](compared(placed, batch, {"flow": flow, "occlusion": occlusion})).item()
    assert miss == pytest.approx(2 * expected, rel=1e-4, abs=1e-6)


def test_certainty_has_no_entropy_and_occlusion_is_counted(
    placed: NSFF, batch: RayBatch, compared: Compared
) -> None:
    samples = len(placed(batch).samples.ray)
    for v, expected in ((1.0, 0.0), (0.5, 0.5 * math.log(2)), (0.0, 0.0)):
        renders = compared(placed, batch, static={"blend": torch.full((samples,), v)})
        assert TERMS["blend_entropy"](renders).item() == pytest.approx(expected, abs=1e-6)
    o = torch.tensor([0.25, 0.5]).expand(samples, 2)
    renders = compared(placed, batch, {"occlusion": o})
    assert TERMS["disocclusion"](renders).item() == pytest.approx(0.75)


def test_depths_are_compared_up_to_scale_and_shift() -> None:
    depth = torch.tensor([1.0, 2.0, 4.0, 8.0, 9.0])
    torch.testing.assert_close(normalised(depth), normalised(3 * depth + 7))
    # Median 4, mean absolute deviation (3 + 2 + 0 + 4 + 5) / 5.
    assert normalised(depth)[0].item() == pytest.approx(-3 / 2.8)


def opaque_surface(model: NSFF, batch: RayBatch, distance: torch.Tensor) -> BlendedOutput:
    """The batch with one sample a ray, at ``distance`` along it, opaque and dynamic."""
    output, count = model(batch), len(batch.rays)
    ray, zeros = torch.arange(count), torch.zeros(count)
    points = model.placement.normalised(batch.rays.at(ray, distance))
    samples = replace(
        output.samples, ray=ray, distance=distance, length=torch.ones(count), points=points
    )
    dynamic = DynamicSamples(
        zeros, torch.zeros(count, 3), torch.zeros(count, 2, 3), torch.zeros(count, 2)
    )
    depths = (torch.full((count,), 50.0), zeros)
    return replace(output, samples=samples, dynamic=dynamic, depths=depths)


def test_exact_surfaces_agree_with_the_priors(
    placed: NSFF, batch: RayBatch, compared: Compared, tiny_scene: Scene, tiny_recipe: Any
) -> None:
    """On the true surface, moved as it truly moves, depth and flow cost next to nothing."""
    priors = ImagePriors([tiny_scene.dynamic.train], tiny_scene.space)
    truth = priors.distance(batch)
    hit = truth.isfinite() & batch.flow_valid
    assert hit.sum() == 6
    distance = torch.where(hit, truth, 1.0)
    output = opaque_surface(placed, batch, distance)
    shape, world = tiny_recipe.visible_shape(), batch.rays.at(torch.arange(8), distance)
    moved = shape.forward(shape.material(world, 0.5), 0.0) - world
    flow = output.dynamic.flow.clone()
    flow[:, 1] = torch.where(hit[:, None], moved / placed.placement.half_edge, 0.0)
    costs = []
    for dynamic in ({}, {"flow": flow}):
        renders = compared(placed, batch, dynamic, output=output, priors=priors)
        costs.append(losses.flow(renders).item())
        assert losses.depth(renders).item() < 1e-6
    assert costs[1] < 2e-3 < costs[0]


def test_priors_weigh_what_they_have_decayed_to(
    placed: NSFF, batch: RayBatch, compared: Compared, tiny_scene: Scene
) -> None:
    priors = ImagePriors([tiny_scene.dynamic.train], tiny_scene.space)
    whole, tenth = (
        compared(placed, batch, priors=priors, prior_factor=factor) for factor in (1.0, 0.1)
    )
    for term in (losses.flow, losses.depth):
        assert 0 < term(tenth).item() == pytest.approx(0.1 * term(whole).item())


def test_rays_count_by_how_dynamic_they_are_after_the_beginning(
    placed: NSFF, batch: RayBatch, compared: Compared
) -> None:
    assert torch.equal(compared(placed, batch).dynamic_share, torch.ones(8))
    late = compared(placed, batch, weighted=True)
    weight = torch.zeros(8).index_add(0, late.output.samples.ray, late.output.blend.dynamic)
    torch.testing.assert_close(late.dynamic_share, weight.detach())
    assert not late.dynamic_share.requires_grad


def test_nothing_is_chained_too_early(placed: NSFF, batch: RayBatch, compared: Compared) -> None:
    assert TERMS["chained"](compared(placed, batch)).item() == 0
    # Of three frames only the outer ones have one two steps away.
    assert TERMS["chained"](compared(placed, batch, chains=True)).item() == 0
    first = replace(batch, frame=torch.zeros_like(batch.frame))
    assert TERMS["chained"](compared(placed, first, chains=True)).item() > 0
