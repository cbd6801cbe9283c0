"""The checks of the machine: on a GPU all of them, on a CPU those that it can make."""

from __future__ import annotations

import pytest
import torch

from devrf import selfcheck
from devrf.engine.stage import Stage
from devrf.errors import DevrfError
from devrf.selfcheck import SmallScene, rendering, resume, small_scene


@pytest.fixture(scope="module")
def gpu_scene() -> SmallScene:
    return small_scene(torch.device("cuda", 0))


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
@pytest.mark.parametrize("name", selfcheck.CHECKS)
def test_a_check_passes(name, gpu_scene):
    selfcheck.CHECKS[name](gpu_scene)


@pytest.fixture(scope="module")
def scene() -> SmallScene:
    return small_scene(torch.device("cpu"))


def test_a_stage_that_a_signal_stops_goes_on_to_equal_bits(scene, monkeypatch):
    assert resume(scene, "canonical").endswith("equal bits")
    usual = Stage.on_train_start

    def other(self: Stage) -> None:
        usual(self)
        if self.trainer.ckpt_path:
            self.generator.manual_seed(5)

    monkeypatch.setattr(Stage, "on_train_start", other)
    with pytest.raises(DevrfError, match="came to other fields"):
        resume(scene, "canonical")


def test_pictures_are_compared(scene, monkeypatch):
    monkeypatch.setattr(selfcheck, "require_gpu", lambda scene, reason: None)
    assert rendering(scene).startswith("0 off")
    monkeypatch.setattr(selfcheck, "PICTURE_LIMIT", -1.0)
    with pytest.raises(DevrfError, match="off the CPU's picture"):
        rendering(scene)
