"""K-Planes' facts: planes and what keeps them simple, decoders, proposals, and that it learns."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import combinations
from typing import Any

import pytest
import torch
from torch import Tensor

from devrf.checkpoints.checkpoint import LoadedCheckpoint
from devrf.data.datamodule import SceneDataModule
from devrf.engine.protocol import ProtocolStage
from devrf.errors import DevrfError
from devrf.geometry.rays import Rays
from devrf.methods.batch import gather_batch
from devrf.methods.kplanes.decoders import ExplicitDecoder, HybridDecoder, density_of
from devrf.methods.kplanes.model import KPlanes
from devrf.methods.kplanes.planes import SPACE, TIME, SixPlanes
from devrf.methods.kplanes.proposals import drawn_edges, histogram_error, intervals
from devrf.methods.kplanes.settings import KPlanesSettings
from devrf.methods.ray_stage import RayStage
from devrf.rendering.renderer import Renderer
from devrf.scenes.scene import Scene

TINY = KPlanesSettings(
    resolution=6, scales=(1, 2), channels=4, width=8, basis_width=8, steps=24, samples=6,
    proposal_samples=(12, 8), proposal_resolutions=(4, 6), proposal_channels=2, occupancy_side=8,
)  # fmt: skip
LOSS = {"render": 1.0, "tv": 1e-4, "smooth": 1e-2, "change": 1e-4}
LOSS |= {"smooth_proposals": 1e-3, "histogram": 1.0, "distortion": 1e-3}
FORMS: list[Any] = [
    {}, {"decoder": "explicit"}, {"pairing": "hexplane"}, {"sampling": "proposals"},
    {"hull": False, "empty_from": 0.0},
]  # fmt: skip


def plane_of(planes: SixPlanes, axes: tuple[int, int]) -> Tensor:
    """The plane (A, B, 1, C) of two axes, at the first scale; a view."""
    grids, order = (planes.space, SPACE) if axes in SPACE else (planes.time, TIME)
    return grids[0].detach().unflatten(0, (3, -1))[order.index(axes)]


def numbered(pairing: Any) -> SixPlanes:
    """Planes of 2, 3, 5, 7, 11 and 13 everywhere."""
    planes = SixPlanes(1, [2], 2, pairing=pairing)
    for axes, value in zip(combinations(range(4), 2), (2, 3, 5, 7, 11, 13), strict=True):
        plane_of(planes, axes).fill_(value)
    return planes


def test_features_are_multiplied_over_planes_or_paired_as_hexplane_has_them() -> None:
    somewhere = torch.zeros(1, 4)
    assert numbered("product")(somewhere).tolist() == [[2 * 3 * 5 * 7 * 11 * 13]]
    # xy · zt, xz · yt, yz · xt
    assert numbered("hexplane")(somewhere).tolist() == [[2 * 13, 3 * 11, 7 * 5]]


@pytest.mark.parametrize("axes", [*combinations(range(4), 2)])
def test_a_plane_is_looked_up_along_its_own_two_axes_up_to_its_border(
    axes: tuple[int, int],
) -> None:
    planes = SixPlanes(1, [3], 5)
    for every in combinations(range(4), 2):
        plane_of(planes, every).fill_(1)
    plane = plane_of(planes, axes)
    across, along = (torch.linspace(0, 1, points) for points in plane.shape[:2])
    plane[:, :, 0, 0] = across[:, None] + 10 * along
    points = torch.tensor([[0.0, 0.25, 0.625, 0.75], [1.0] * 4, [-1.0, 2.0, 1.5, -0.5]])
    places = points[:, axes].clamp(0, 1)
    torch.testing.assert_close(planes(points)[:, 0], places[:, 0] + 10 * places[:, 1])


def test_scales_are_joined_and_time_has_the_same_points_in_each() -> None:
    planes = SixPlanes(4, [6, 12], 3)
    assert planes.size == 8 and planes(torch.rand(5, 4)).shape == (5, 8)
    assert [tuple(grid.shape[:2]) for grid in planes.time] == [(18, 3), (36, 3)]
    assert all((grid == 1).all() for grid in planes.time)
    still = torch.cat([grid.flatten() for grid in planes.space])
    assert 0.1 <= still.min() and still.max() <= 0.5


def test_terms_of_planes_by_hand() -> None:
    planes = SixPlanes(1, [2], 3)
    for axes in combinations(range(4), 2):
        plane_of(planes, axes).fill_(1)
    assert planes.total_variation() == planes.roughness() == planes.change() == 0
    plane_of(planes, (0, 3))[0, :, 0, 0] = torch.tensor([1.0, 2.0, 1.0])
    # Along x: (0, 1, 0) squared, a third; along t: 1 and 1 of 4 differences, a half; twice both.
    assert planes.total_variation().item() == pytest.approx(2 * (1 / 3 + 1 / 2))
    assert planes.roughness().item() == pytest.approx((1 - 2 * 2 + 1) ** 2 / 2)
    assert planes.change().item() == pytest.approx(1 / 6)


def test_a_density_and_its_gradient() -> None:
    raw = torch.tensor([1.0, 3.0, 200.0], requires_grad=True)
    density = density_of(raw)
    expected = torch.tensor([1.0, math.exp(2), math.exp(15)])
    torch.testing.assert_close(density, expected)
    density.sum().backward()
    torch.testing.assert_close(raw.grad, expected)


def test_without_harmonics_colors_are_the_same_from_all_sides() -> None:
    torch.manual_seed(0)
    further = torch.rand(2, 15)
    viewdirs = torch.nn.functional.normalize(torch.randn(2, 3), dim=1)
    ray = torch.arange(2)
    for harmonics, same in ((0, True), (3, False)):
        decoder = HybridDecoder(8, replace(TINY, harmonics=harmonics))
        here = decoder.rgb(further, viewdirs, ray)
        there = decoder.rgb(further, -viewdirs, ray)
        assert torch.equal(here, there) == same
    with pytest.raises(DevrfError, match="harmonics: expected 3 with decoder=explicit"):
        replace(TINY, harmonics=0, decoder="explicit")


def test_explicit_colors_are_linear_in_the_features_before_the_sigmoid() -> None:
    decoder = ExplicitDecoder(8, TINY)
    features = torch.rand(2, 8)
    viewdirs = torch.nn.functional.normalize(torch.randn(1, 3), dim=1)
    ray = torch.zeros(2, dtype=torch.int64)
    logits = torch.logit(decoder.rgb(features, viewdirs, ray))
    double = torch.logit(decoder.rgb(2 * features, viewdirs, ray))
    torch.testing.assert_close(double, 2 * logits, atol=1e-4, rtol=1e-4)


def test_edges_are_drawn_where_the_weight_is() -> None:
    edges = torch.tensor([[0.0, 1.0, 2.0, 4.0]])
    even = drawn_edges(edges, torch.ones(1, 3), 3, jitter=False)
    torch.testing.assert_close(even, edges)
    drawn = drawn_edges(edges, torch.tensor([[0.0, 100.0, 0.0]]), 10, jitter=True)
    assert (drawn.diff(dim=1) >= 0).all()
    assert drawn[0, 0] == 0 and drawn[0, -1] == 4
    assert (1 <= drawn[0, 1:-1]).all() and (drawn[0, 1:-1] <= 2).all()


def test_intervals_fill_the_ray() -> None:
    x = torch.tensor([[2.0, 0.0, 0.0]])
    samples = intervals(Rays(torch.zeros(1, 3), x, x / 2), torch.tensor([[1.0, 2.0, 4.0]]))
    assert samples.distance.tolist() == [1.5, 3.0]
    assert samples.length.tolist() == [2.0, 4.0]  # of a direction of length 2
    assert samples.points[:, 0].tolist() == [3.0, 6.0]


def test_a_proposal_that_bounds_the_weights_has_no_error() -> None:
    edges = torch.tensor([[0.0, 0.5, 1.0, 2.0]])
    weight = torch.tensor([[0.2, 0.3, 0.1]])
    proposed_edges = torch.tensor([[0.0, 1.0, 2.0]])
    bounding = torch.tensor([[0.5, 0.1]])
    assert histogram_error(edges, weight, proposed_edges, bounding) == 0
    lower = torch.tensor([[0.25, 0.1]])
    # Only the second of three intervals has more than the 0.25 of the one that it lies in.
    expected = (0.3 - 0.25) ** 2 / 0.3 / 3
    assert histogram_error(edges, weight, proposed_edges, lower).item() == pytest.approx(
        expected, rel=1e-4
    )


@pytest.mark.parametrize("total", [30_001, 120_001])
def test_proposals_learn_ever_less_often_and_sharpen_however_long_a_stage_is(total: int) -> None:
    model = KPlanes(replace(TINY, sampling="proposals"))
    taught = []
    for step in range(6000):
        model.on_iteration(step, total)
        taught.append(model._teaches)
        if step in (0, 500, 1000, 5999):
            f = min(step / 1000, 1)
            assert model.sharpness == pytest.approx(10 * f / (9 * f + 1))
    assert all(taught[:10])
    assert sum(taught[:600]) > 500 and sum(taught[-1000:]) == 200
    assert model.milestones(total) == {"weights sharpened": 1000, "proposals learn rarely": 5000}


def test_the_distortion_of_proposals_has_the_lengths_of_their_intervals(
    tiny_scene: Scene, some_rays: Any
) -> None:
    model = KPlanes(replace(TINY, sampling="proposals", hull=False))
    model.setup(tiny_scene)
    output = model(some_rays)
    extras = output.extras
    weight, distance, length = (
        extras[name].view(len(some_rays.time), -1) for name in ("weight", "distance", "length")
    )
    # The middles of intervals that follow one another are half of both apart.
    torch.testing.assert_close(distance.diff(dim=1), (length[:, 1:] + length[:, :-1]) / 2)
    apart = (distance[:, :, None] - distance[:, None]).abs()
    pairs = (weight[:, :, None] * weight[:, None] * apart).sum(dim=(1, 2))
    own = (weight.square() * length).sum(dim=1) / 3
    expected = (pairs + own).mean() / model.placement.half_edge
    terms = model.loss_terms(output, some_rays, {"distortion"})
    torch.testing.assert_close(terms["distortion"], expected, atol=1e-6, rtol=1e-4)


@pytest.mark.parametrize("sampling", ["occupancy", "proposals"])
def test_in_ndc_distortion_is_of_places_in_the_box(tiny_toy: Scene, sampling: Any) -> None:
    model = KPlanes(replace(TINY, sampling=sampling, hull=False)).eval()
    model.setup(tiny_toy)
    views = tiny_toy.dynamic.train
    image = torch.arange(len(views)).repeat_interleave(3)
    batch = gather_batch(views, image, image * 37, torch.ones(3), tiny_toy.space)
    output = model(batch)
    extras = output.extras
    unit = batch.rays.directions.norm(dim=1)
    steps = torch.full_like(extras["weight"], float(model.step_length / unit.max()))
    length = extras.get("length", steps) * unit[extras["ray"]] / model.placement.half_edge
    expected = (extras["weight"].square() * length).sum() / 3
    for ray in range(len(image)):
        own = extras["ray"] == ray
        weight, points = extras["weight"][own], extras["points"][own]  # in normalised space
        apart = (points[:, None] - points).norm(dim=2)
        expected += (weight[:, None] * weight * apart).sum()
    terms = model.loss_terms(output, batch, {"distortion"})
    torch.testing.assert_close(terms["distortion"], expected / len(image), atol=1e-6, rtol=1e-4)


def test_time_has_half_as_many_points_as_frames() -> None:
    model = KPlanes(TINY)
    model.set_times(tuple(k / 49 for k in range(50)))
    assert {plane.shape[1] for plane in model.planes.time} == {25}


@pytest.mark.parametrize("form", FORMS)
def test_it_learns(form: dict[str, Any], learned_losses: Callable[..., list[float]]) -> None:
    torch.manual_seed(0)
    model = KPlanes(replace(TINY, **form))
    sizes = {"iterations": 60, "rays": 128, "iterations_per_step": 10}
    rates = {"learning_rate": 3e-2, "final_learning_rate": 0.0, "decay": "cosine", "warmup": 0.1}
    losses = learned_losses(model, term="render", loss=LOSS, **sizes, **rates)
    assert losses[-1] < 0.7 * losses[0]


@pytest.mark.parametrize("sampling", ["occupancy", "proposals"])
def test_a_killed_run_goes_on_to_the_same_weights(
    sampling: Any, ray_stage: Callable[..., RayStage], stopped_and_resumed: Callable[..., Any]
) -> None:
    def stage() -> RayStage:
        model = KPlanes(replace(TINY, sampling=sampling, hull=False, empty_from=0.0))
        return ray_stage(model, loss=LOSS)

    stopped_and_resumed(stage, at=2)


def test_two_stages_leave_what_space_says_as_it_was(
    ray_stage: Callable[..., RayStage], fit: Callable[..., RayStage]
) -> None:
    first = fit(ray_stage(KPlanes(TINY), "canonical", loss=LOSS))
    step = ProtocolStage("deformation", "dynamic", frozen=("canonical",), builds_on="canonical")
    before = {n: p.clone() for n, p in first.scene_model.named_parameters()}
    second = fit(ray_stage(KPlanes(TINY), step, loss=LOSS, earlier=first.result()))
    model = second.scene_model
    moving = {id(grid) for grid in model.planes.time}  # type: ignore[union-attr]
    for name, parameter in model.named_parameters():
        assert torch.equal(parameter, before[name]) == (id(parameter) not in moving), name


@pytest.mark.parametrize("form", FORMS[:4])
@pytest.mark.parametrize("name", ["tiny_room", "facing"])
def test_scenes_of_every_space_are_learned_and_come_back(
    name: str, form: dict[str, Any], request: pytest.FixtureRequest,
    serve: Callable[[Scene], SceneDataModule], ray_stage: Callable[..., RayStage],
    fit: Callable[..., RayStage], stored: Callable[[RayStage], LoadedCheckpoint],
) -> None:  # fmt: skip
    scene = request.getfixturevalue(name)
    stage = fit(ray_stage(KPlanes(replace(TINY, **form)), loss=LOSS), data=serve(scene))
    model = stored(stage).model
    assert model.space == scene.space
    cameras = scene.static.test.cameras
    now, then = (Renderer(m).view(cameras, 0, 0.5, 1.0) for m in (stage.scene_model, model))
    assert torch.equal(now.color, then.color)


def test_impossible_sizes_are_refused() -> None:
    with pytest.raises(DevrfError, match="proposal_samples: expected as many numbers as"):
        replace(TINY, proposal_samples=(8,))
    with pytest.raises(DevrfError, match="empty_from: expected at most 1"):
        replace(TINY, empty_from=1.5)
    with pytest.raises(DevrfError, match="scales: expected at least 1 item"):
        replace(TINY, scales=())
