"""What the experiments that put quality first choose for a scene."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from hydra.utils import instantiate

from devrf.cli.config_check import check_config
from devrf.geometry.box import Box
from devrf.geometry.ndc import NormalizedDevice
from devrf.methods.devrf.architecture import fitted_to
from devrf.scenes.procedural import ProceduralForwardScene


@pytest.mark.parametrize(
    ("experiment", "data"),
    [
        ("best_small", "inward"),
        ("best_inward", "inward"),
        ("best_small_forward", "forward"),
        ("best_forward", "forward"),
    ],
)
def test_they_take_a_scene_from_disk_and_go_over_its_motion_twice(composed, experiment, data):
    config = composed(f"experiment={experiment}", f"data={data}", "data.root=x", "data.downscale=2")
    check_config(config)
    assert config.loss.deformation.elastic > 0
    moves = instantiate(config.schedule.deformation, _convert_="all")
    *_, before, last = moves.levels
    assert "backward" in (before.order, last.order) and last.side == before.side
    assert config.sampling._target_ == "devrf.methods.devrf.settings.Sampling"


@pytest.mark.parametrize("experiment", ["best_small_forward", "best_forward"])
def test_forward_grids_follow_the_pictures_and_the_parallax(composed, experiment):
    config = composed(f"experiment={experiment}", "data=procedural_forward")
    check_config(config)
    schedule = instantiate(config.schedule.canonical, _convert_="all")
    architecture = instantiate(config.field, _convert_="all")
    assert schedule.crop
    size = {"width": 24, "height": 18, "static_views": 4, "train_views": 1}
    scene = ProceduralForwardScene(**size, frames=2, supersample=1).render()
    # Cameras 0.8 apart see the near plane move by 200 · 0.8 / 1 pixels, four to each of 40 steps.
    cameras = scene.static.train.cameras
    poses = cameras.camera_to_world.clone()
    poses[:, :, 3] = torch.linspace(0, 0.8, len(poses))[:, None] * torch.tensor([0.6, 0.8, 0])
    views = replace(scene.static.train, cameras=replace(cameras, camera_to_world=poses))
    bounds = replace(scene.bounds, box=Box((-1.5, -1.25, -1.0), (1.5, 1.25, 1.0)))
    large = replace(
        scene,
        static=replace(scene.static, train=views),
        bounds=bounds,
        space=NormalizedDevice(240, 136, (200.0, 200.0)),
    )
    fitted, sizes = fitted_to(large, schedule, architecture)
    shape = sizes.radiance_field(bounds.box, 8, round(fitted.side**3)).grid_shape(
        round(fitted.side**3)
    )
    # 0.8 points to a pixel; the box is 1.5 and 1.25 times as wide and high as a picture.
    assert shape == (
        pytest.approx(0.8 * 240 * 1.5, abs=1),
        pytest.approx(0.8 * 136 * 1.25, abs=1),
        41,
    )
