"""Every layout read as ``data=`` reads it: one scene through all of them."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from devrf.data.recorded import READERS, RecordedDataModule
from devrf.engine.protocol import ProtocolStage
from devrf.methods.dnerf.model import DNeRF, DNeRFSettings
from devrf.methods.ray_schedule import RaySchedule
from devrf.methods.ray_stage import RayStage
from layouts import write_nerf_ds, write_scene


def test_the_layouts_say_the_same(tiny_scene, write_layout, tmp_path):
    """The same rays, times and pixels."""
    given = tiny_scene.dynamic.train
    for choice in ("inward", "nerfstudio", "nerfies", "dycheck", "panoptic", "easyvolcap"):
        write_layout(choice, tmp_path / choice)
        train = READERS[choice](tmp_path / choice).read().dynamic.train
        moving = ["static" not in Path(name).stem for name in train.names]
        views = train[torch.tensor(moving).nonzero()[:, 0]]
        torch.testing.assert_close(views.times, given.times)
        assert torch.equal(views.pixels, given.pixels)
        for image in range(len(given)):
            expected, found = given.cameras.image_rays(image), views.cameras.image_rays(image)
            torch.testing.assert_close(found.origins, expected.origins, atol=1e-5, rtol=0)
            torch.testing.assert_close(found.directions, expected.directions, atol=1e-5, rtol=0)


SMALL = DNeRFSettings(
    width=8, depth=2, bands=2, direction_bands=1, deformation_width=8, deformation_depth=2,
    time_bands=2, sampling="occupancy", steps=16, occupancy_side=8, coarse=8, fine=8,
)  # fmt: skip


@pytest.mark.parametrize("layout", ["nerf_ds", "panoptic", "easyvolcap"])
def test_a_layout_is_read_learned_and_scored(layout, tiny_scene, trainer, tmp_path):
    root = tmp_path / "scene"
    if layout == "nerf_ds":
        write_nerf_ds(tiny_scene, root)
        module = RecordedDataModule(READERS["nerfies"], root)
    else:
        write_scene(layout, tiny_scene, root)
        module = RecordedDataModule(READERS[layout], root, masks="alpha")
    schedule = RaySchedule(
        iterations=10, rays=32, iterations_per_step=5, learning_rate=1e-2, final_learning_rate=1e-3
    )
    step = ProtocolStage("dynamic", "dynamic")
    stage = RayStage(DNeRF(SMALL), schedule, {"render": 1.0}, step, 0.5, None)
    fitted = trainer(max_epochs=1)
    fitted.fit(stage, datamodule=module)
    assert stage.position.iteration == 10
    (scores,) = fitted.test(stage, datamodule=module, verbose=False)
    assert 3 < scores["test/dynamic/psnr"] < 40
    assert len(module.scene.dynamic.test) == 3 and len(module.scene.dynamic.train) == 6
