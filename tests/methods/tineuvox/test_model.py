"""TiNeuVox: the grid at several distances, its growth, what is published, and that it learns."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch

from devrf.checkpoints.checkpoint import LoadedCheckpoint
from devrf.data.datamodule import SceneDataModule
from devrf.engine.protocol import ProtocolStage
from devrf.errors import DevrfError
from devrf.geometry.box import Box
from devrf.methods.ray_stage import RayStage
from devrf.methods.tineuvox.model import TiNeuVox
from devrf.methods.tineuvox.networks import MultiDistanceGrid
from devrf.methods.tineuvox.settings import TiNeuVoxSettings
from devrf.rendering.renderer import Renderer
from devrf.scenes.scene import Scene

TINY = TiNeuVoxSettings(
    side=16, channels=2, width=8, bands=2, direction_bands=1, time_bands=2, feature_bands=1,
    alpha_init=1e-2, step=1.0, occupancy_side=8,
)  # fmt: skip
LOSS = {"render": 1.0, "background_entropy": 1e-3, "sample_color": 1e-2}
UNIT = Box((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))


def test_a_spacing_is_a_grid_of_every_so_many_points_over_the_same_box() -> None:
    grid = MultiDistanceGrid(1, (1, 2, 4))
    grid.values = torch.nn.Parameter(torch.zeros(5, 5, 5, 1))
    with torch.no_grad():
        grid.values[1] = 1.0  # the plane x = 1/4
        grid.values[2] = 4.0  # the plane x = 1/2
    points = torch.tensor([[0.25, 0.3, 0.9], [0.125, 0.3, 0.9], [0.5, 0.0, 1.0]])
    # Linear in x through (0, 1, 4, 0, 0), through (0, 4, 0), and through (0, 0).
    expected = torch.tensor([[1.0, 2.0, 0.0], [0.5, 1.0, 0.0], [4.0, 4.0, 0.0]])
    torch.testing.assert_close(grid(points, UNIT), expected)


@pytest.mark.parametrize("kept", [False, True])
def test_a_spacing_teaches_the_points_that_it_has(kept: bool) -> None:
    grid = MultiDistanceGrid(1, (1, 4))
    if kept:  # as the optimiser keeps it
        grid.values.grad = torch.zeros_like(grid.values)
    grid(torch.full((1, 3), 0.5), UNIT).sum().backward()
    gradient = grid.values.grad
    assert gradient is not None
    # The middle is a point of the fine grid, and of eight equal corners of the other.
    corners = gradient[::4, ::4, ::4]
    torch.testing.assert_close(corners, torch.full_like(corners, 1 / 8))
    assert gradient[2, 2, 2] == 1 and gradient.sum() == 2


@pytest.mark.parametrize(
    ("side", "size", "shape"),
    [(160, (1, 1, 1), (161, 161, 161)), (10, (1, 1, 1), (13, 13, 13)), (8, (1, 2, 4), (5, 9, 17))],
)
def test_all_strides_fit_into_the_grid(
    side: int, size: tuple[float, float, float], shape: tuple[int, int, int]
) -> None:
    grid = MultiDistanceGrid(1, (1, 2, 4))
    assert grid.fitting(Box((0.0, 0.0, 0.0), size), side) == shape


def test_the_number_of_voxels_doubles_when_it_is_published_to() -> None:
    model = TiNeuVox(TINY)
    assert model.growths(20000) == [2000, 4000, 6000]
    model.grid.resize((5, 5, 5))
    voxels = []
    for count in range(4):
        model.grow(count)
        voxels.append((model.resolution[0] - 1, model.step_length))
    assert [cells for cells, _ in voxels] == [8, 12, 12, 16]  # of 8, 10, 12.7 and 16 points
    model.grow(0)
    assert model.resolution == (17, 17, 17)  # what has grown stays


def test_density_without_features_has_the_initial_opacity() -> None:
    model = TiNeuVox(replace(TINY, alpha_init=0.25))
    torch.nn.init.zeros_(model.radiance.density.weight)
    torch.nn.init.zeros_(model.radiance.density.bias)
    length = model.base_voxel / model.placement.half_edge
    depth = model.optical_depth(torch.zeros(1, 3), torch.zeros(1), length)
    assert -math.expm1(-depth.item()) == pytest.approx(0.25)


@torch.no_grad()
def test_a_model_that_starts_still_is_the_same_at_all_times() -> None:
    points, times = torch.rand(5, 3).repeat(2, 1), torch.tensor([0.1] * 5 + [0.9] * 5)
    for starts_still in (True, False):
        model = TiNeuVox(replace(TINY, starts_still=starts_still))
        torch.nn.init.uniform_(model.grid.values)
        early, late = model.optical_depth(points, times, 1.0).split(5)
        assert torch.allclose(early, late) == starts_still


@torch.no_grad()
def test_samples_of_little_weight_hide_what_is_behind_but_have_no_color(
    tiny_scene: Scene, some_rays: Any
) -> None:
    torch.manual_seed(0)
    model = TiNeuVox(replace(TINY, weight_threshold=0.0)).eval()
    model.setup(tiny_scene)
    whole = model(some_rays)
    weight = whole.extras["weight"]
    model.least_weight = float(weight.median())
    shown = weight > model.least_weight
    part = model(some_rays)
    assert 0 < shown.sum() < len(shown)
    assert torch.equal(part.extras["weight"], weight[shown])
    assert torch.equal(part.extras["sample_color"], whole.extras["sample_color"][shown])
    assert torch.equal(part.transmittance, whole.transmittance)
    assert (part.color <= whole.color + 1e-6).all() and not torch.equal(part.color, whole.color)


def test_terms_by_hand(tiny_scene: Scene, some_rays: Any) -> None:
    model = TiNeuVox(TINY)
    model.setup(tiny_scene)
    output = model(some_rays)
    terms = model.loss_terms(output, some_rays, [*LOSS])
    extras = output.extras
    error = (extras["sample_color"] - some_rays.color[extras["ray"]]).square().sum(dim=1)
    expected = (extras["weight"] * error).sum() / len(some_rays.time)
    torch.testing.assert_close(terms["sample_color"], expected)
    assert set(terms) == set(LOSS)
    terms["sample_color"].backward()
    assert model.radiance.color.output.weight.grad is not None
    assert model.radiance.density.weight.grad is None  # weights have no gradient


@pytest.mark.parametrize("hull", [True, False])
def test_it_learns(hull: bool, learned_losses: Callable[..., list[float]]) -> None:
    model = TiNeuVox(replace(TINY, hull=hull))
    sizes = {"iterations": 45, "rays": 128, "iterations_per_step": 15}
    losses = learned_losses(model, loss=LOSS, learning_rate=3e-3, betas=(0.9, 0.99), **sizes)
    assert losses[-1] < 0.7 * losses[0]
    assert model.resolution == model.grid.fitting(model.grid_box, 16)


def test_a_run_that_was_stopped_between_two_growths_goes_on_to_the_same_weights(
    ray_stage: Callable[..., RayStage], stopped_and_resumed: Callable[..., Any]
) -> None:
    small = replace(TINY, hull=False, empty_from=0.0, upsample_at=(0.25, 0.75), tv=1e-4)

    def stage() -> RayStage:
        return ray_stage(TiNeuVox(small), loss=LOSS, iterations=8)

    whole, stopped, _ = stopped_and_resumed(stage, at=4)
    assert stopped.scene_model.resolution < whole.scene_model.resolution


def test_a_grid_that_has_not_grown_comes_back_and_is_forecast_as_if_it_had(
    ray_stage: Callable[..., RayStage], fit: Callable[..., RayStage],
    stored: Callable[[RayStage], LoadedCheckpoint],
) -> None:  # fmt: skip
    model = TiNeuVox(replace(TINY, side=48, upsample_at=(1.0, 1.0, 1.0)))
    others = sum(p.numel() for p in model.parameters()) - model.grid.values.numel()
    assert model.most_bytes == 4 * (others + 49**3 * 2)
    stage = fit(ray_stage(model, loss=LOSS))
    assert stored(stage).model.resolution == stage.scene_model.resolution
    assert math.prod(stage.scene_model.resolution) < 49**3 / 4


def test_two_stages_leave_the_canonical_part_as_it_was(
    ray_stage: Callable[..., RayStage], fit: Callable[..., RayStage]
) -> None:
    first = fit(ray_stage(TiNeuVox(TINY), "canonical", loss=LOSS))
    step = ProtocolStage("deformation", "dynamic", frozen=("canonical",), builds_on="canonical")
    before = {n: t.clone() for n, t in first.scene_model.state_dict().items()}
    second = fit(ray_stage(TiNeuVox(TINY), step, loss=LOSS, earlier=first.result()))
    after = second.scene_model.state_dict()
    changed = {name.split(".")[0] for name in before if not torch.equal(before[name], after[name])}
    assert changed == {"deformation", "time"}


@pytest.mark.parametrize("name", ["tiny_room", "facing"])
def test_scenes_of_every_space_are_learned_and_come_back(
    name: str, request: pytest.FixtureRequest, serve: Callable[[Scene], SceneDataModule],
    ray_stage: Callable[..., RayStage], fit: Callable[..., RayStage],
    stored: Callable[[RayStage], LoadedCheckpoint],
) -> None:  # fmt: skip
    scene = request.getfixturevalue(name)
    stage = fit(ray_stage(TiNeuVox(TINY), loss=LOSS), data=serve(scene))
    model = stored(stage).model
    assert model.space == scene.space and model.resolution == stage.scene_model.resolution
    cameras = scene.static.test.cameras
    now, then = (Renderer(m).view(cameras, 0, 0.5, 1.0) for m in (stage.scene_model, model))
    assert torch.equal(now.color, then.color)
    if not scene.space.is_linear:  # the last sample stands for all that is behind it
        torch.testing.assert_close(then.opacity, torch.ones_like(then.opacity))


def test_a_surface_at_a_time_is_what_rays_meet_then(tiny_scene: Scene) -> None:
    torch.manual_seed(0)
    model = TiNeuVox(TINY)
    model.setup(tiny_scene)
    model.occupancy.mask[1, 0] = False
    field = model.surface_at(model.clock.times[1])
    low, high = model.box.corners(torch.zeros(()))
    points = low + (high - low) * torch.tensor([[0.0, 0.5, 0.5], [0.6, 0.4, 0.5]])
    depth = field.optical_depth(points)
    # Nothing is where the masks of the frame leave nothing; elsewhere it is the field's.
    assert depth[0] == 0
    voxel = model.box.voxel_size(math.prod(field.shape)) / model.placement.half_edge
    time = torch.full((1,), model.clock.times[1])
    expected = model.optical_depth(model.placement.normalised(points[1:]), time, voxel)
    torch.testing.assert_close(depth[1:], expected.detach())
    assert field.color(points, torch.eye(3)[:2]).shape == (2, 3)


def test_impossible_sizes_are_refused() -> None:
    with pytest.raises(DevrfError, match="strides: expected numbers that divide"):
        replace(TINY, strides=(1, 3, 4))
    with pytest.raises(DevrfError, match="empty_from: expected at least 0"):
        replace(TINY, empty_from=-1.0)
    with pytest.raises(DevrfError, match="upsample_at: expected ascending shares"):
        replace(TINY, upsample_at=(0.5, 0.2))
