"""What tests of several methods share."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from lightning import Callback, Trainer

from devrf.checkpoints.checkpoint import ChecksummedCheckpointIO, save_checkpoint
from devrf.data.datamodule import SceneDataModule
from devrf.methods.ray_stage import RayStage
from devrf.scenes.scene import Scene

MakeStage = Callable[[], RayStage]


def assert_same_weights(one: RayStage, other: RayStage) -> None:
    """Fails unless two stages have learned the same, to the last bit."""
    found = other.state_dict()
    for name, value in one.state_dict().items():
        if isinstance(value, torch.Tensor):
            assert torch.equal(value, found[name]), name


@pytest.fixture
def assert_goes_on_exactly(
    trainer: Callable[..., Trainer], datamodule: SceneDataModule, tmp_path: Path
) -> Callable[[MakeStage], None]:
    """Fails unless a run that is killed half-way goes on to the weights of one that is not."""

    def check(stage: MakeStage) -> None:
        whole, path = stage(), tmp_path / "progress.ckpt"
        trainer(max_epochs=1).fit(whole, datamodule=datamodule)

        class StopHalfWay(Callback):
            def on_train_batch_end(self, fitted: Trainer, *arguments: object) -> None:
                save_checkpoint(fitted, path, weights_only=False)
                fitted.should_stop = True

        trainer(StopHalfWay(), max_epochs=1).fit(stage(), datamodule=datamodule)
        on, resumed = stage(), trainer(max_epochs=1)
        torch.manual_seed(123)
        resumed.strategy.checkpoint_io = ChecksummedCheckpointIO()
        resumed.fit(on, datamodule=datamodule, ckpt_path=str(path))
        assert on.iteration == 4
        assert_same_weights(whole, on)

    return check


@pytest.fixture
def assert_never_reads_the_static_set(
    trainer: Callable[..., Trainer],
    serve: Callable[[Scene], SceneDataModule],
    tiny_scene: Scene,
    dark_scene: Scene,
) -> Callable[[MakeStage], None]:
    """Fails unless a stage learns the same, in the same box, where static images are black."""

    def check(stage: MakeStage) -> None:
        clean, dark = stage(), stage()
        for one, scene in ((clean, tiny_scene), (dark, dark_scene)):
            torch.manual_seed(0)
            trainer(max_epochs=1).fit(one, datamodule=serve(scene))
        assert_same_weights(clean, dark)
        assert clean.scene_model.box == dark.scene_model.box

    return check
