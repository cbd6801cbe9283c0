"""What tests of several methods share."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from devrf.data.datamodule import SceneDataModule
from devrf.scenes.scene import Capture, Scene


@pytest.fixture
def poisoned(tiny_scene: Scene) -> SceneDataModule:
    """Serves the tiny scene, its static training images being black."""

    class Poisoned(SceneDataModule):
        def load(self) -> Scene:
            train = tiny_scene.static.train
            dark = replace(train, pixels=torch.zeros_like(train.pixels))
            return replace(tiny_scene, static=Capture(dark, tiny_scene.static.test))

    return Poisoned()
