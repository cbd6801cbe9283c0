"""D-NeRF's facts, and that it learns."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch

from devrf.checkpoints.checkpoint import LoadedCheckpoint
from devrf.data.datamodule import SceneDataModule
from devrf.geometry.clock import FrameClock
from devrf.methods.dnerf.model import DNeRF, DNeRFSettings
from devrf.methods.ray_stage import RayStage
from devrf.rendering.renderer import Renderer
from devrf.scenes.scene import Scene

TINY = DNeRFSettings(
    width=8, depth=2, bands=2, direction_bands=1, deformation_width=8, deformation_depth=2,
    time_bands=2, sampling="occupancy", steps=16, occupancy_side=8, coarse=8, fine=8,
)  # fmt: skip


def test_displacements_begin_next_to_zero_and_are_zero_at_time_zero() -> None:
    model, points = DNeRF(TINY), torch.rand(5, 3)
    assert 0 < model.deformation(points, torch.rand(5)).abs().max() < 1e-2
    torch.nn.init.normal_(model.deformation.output.weight)
    moved = model.deformation(points, torch.tensor([0.0, 0.0, 0.5, 1.0, 0.0]))
    assert torch.equal(moved[[0, 1, 4]], torch.zeros(3, 3))
    assert (moved[[2, 3]].abs().sum(dim=1) > 0).all()


def test_the_temporal_term_of_a_deformation_without_time_is_zero(
    tiny_scene: Scene, some_rays: Any
) -> None:
    model = DNeRF(TINY)
    model.setup(tiny_scene)
    terms = model.loss_terms(model(some_rays), some_rays, ["temporal"])
    assert set(terms) == {"temporal"} and terms["temporal"] > 0
    torch.nn.init.zeros_(model.deformation.output.weight)  # no time displaces anything
    assert model.loss_terms(model(some_rays), some_rays, ["temporal"])["temporal"] == 0


def test_the_temporal_term_reaches_to_the_neighbours_of_frames_at_uneven_times(
    tiny_scene: Scene, some_rays: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = DNeRF(TINY)
    model.setup(tiny_scene)
    model.clock = FrameClock((0.0, 0.1, 1.0))
    output = model(some_rays)
    output.extras["time"] = torch.full_like(output.extras["time"], 0.1)
    asked: list[torch.Tensor] = []
    displace = model.deformation.forward

    def heard(points: torch.Tensor, time: torch.Tensor) -> torch.Tensor:
        asked.append(time)
        return displace(points, time)

    monkeypatch.setattr(model.deformation, "forward", heard)
    model.loss_terms(output, some_rays, ["temporal"])
    other = asked[1]
    assert 0 <= other.min() < 0.02 and 0.9 < other.max() <= 1
    assert (other < 0.1).float().mean() == pytest.approx(0.5, abs=0.1)


@pytest.mark.parametrize("sampling", ["occupancy", "hierarchical"])
def test_it_learns(sampling: Any, learned_losses: Callable[..., list[float]]) -> None:
    model = DNeRF(replace(TINY, sampling=sampling))
    losses = learned_losses(model, iterations=60, rays=128, iterations_per_step=20)
    assert len(losses) == 3 and losses[-1] < 0.7 * losses[0]


@pytest.mark.parametrize("sampling", ["occupancy", "hierarchical"])
def test_an_unbounded_scene_is_learned_and_comes_back(
    sampling: Any, tiny_room: Scene, serve: Callable[[Scene], SceneDataModule],
    ray_stage: Callable[..., RayStage], fit: Callable[..., RayStage],
    stored: Callable[[RayStage], LoadedCheckpoint],
) -> None:  # fmt: skip
    stage = fit(ray_stage(DNeRF(replace(TINY, sampling=sampling))), data=serve(tiny_room))
    model = stored(stage).model
    assert model.space == tiny_room.space and model.box == tiny_room.bounds.box
    image = Renderer(model).view(tiny_room.static.test.cameras, 0, 0.5, 1.0)
    # The last sample stands for all that is behind it: no background shows.
    torch.testing.assert_close(image.opacity, torch.ones_like(image.opacity))
