"""What tests of several methods share: stages of a few iterations on tiny networks."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest
import torch
from lightning import Callback, Trainer

from devrf.checkpoints.checkpoint import LoadedCheckpoint, load_checkpoint
from devrf.data.batch import RayBatch
from devrf.engine.protocol import ProtocolStage
from devrf.engine.stage import Stage
from devrf.methods.base import RayTrainable
from devrf.methods.batch import gather_batch
from devrf.methods.ray_schedule import RaySchedule
from devrf.methods.ray_stage import RayStage
from devrf.scenes.procedural.recipe import ProceduralForwardScene
from devrf.scenes.scene import Scene

STEPS = {
    "joint": ProtocolStage("joint", "both"),
    "dynamic": ProtocolStage("dynamic", "dynamic"),
    "canonical": ProtocolStage("canonical", "static"),
}


def assert_same_weights(one: RayStage, other: RayStage) -> None:
    state = other.state_dict()
    for name, value in one.state_dict().items():
        assert not isinstance(value, torch.Tensor) or torch.equal(value, state[name]), name


@pytest.fixture
def same_weights() -> Callable[[RayStage, RayStage], None]:
    """``same_weights(one, other)``: asserts that two stages have learned the same, bit by bit."""
    return assert_same_weights


@pytest.fixture
def ray_stage() -> Callable[..., RayStage]:
    """``ray_stage(model, step)``: a stage of four iterations; other options change its schedule."""

    def make(
        model: RayTrainable,
        step: str | ProtocolStage = "joint",
        loss: Mapping[str, float] | None = None,
        earlier: LoadedCheckpoint | None = None,
        static_share: float = 0.5,
        **changes: Any,
    ) -> RayStage:
        usual = {"iterations": 4, "rays": 32, "iterations_per_step": 2}
        rates = {"learning_rate": 1e-2, "final_learning_rate": 1e-3}
        schedule = RaySchedule(**{**usual, **rates, **changes})
        step = STEPS[step] if isinstance(step, str) else step
        return RayStage(model, schedule, loss or {"render": 1.0}, step, static_share, earlier)

    return make


@pytest.fixture
def learned_losses(ray_stage: Callable[..., RayStage], fit: Callable[..., RayStage]) -> Any:
    """``learned_losses(model, **schedule)``: a term at each Lightning step of a fitted stage."""

    def learn(model: RayTrainable, term: str = "loss", **changes: Any) -> list[float]:
        found: list[float] = []

        class Note(Callback):
            def on_train_batch_end(self, *arguments: Any) -> None:
                found.append(float(arguments[2][term]))

        fit(ray_stage(model, **changes), Note())
        return found

    return learn


@pytest.fixture
def stopped_and_resumed(fit: Callable[..., RayStage], tmp_path: Path) -> Any:
    """``stopped_and_resumed(make, at)``: a stage that ran whole, to iteration ``at``, and on.

    ``make()`` gives the stage anew. The last one begins with other random numbers and goes on from
    the second's progress file; asserts that it learns what the first has learned, bit by bit.
    """

    def learn(make: Callable[[], RayStage], at: int) -> tuple[RayStage, RayStage, RayStage]:
        path = tmp_path / "progress.ckpt"

        class Stop(Callback):
            def on_train_batch_end(self, fitted: Trainer, *arguments: object) -> None:
                if fitted.lightning_module.position.iteration == at:
                    fitted.save_checkpoint(path)
                    fitted.should_stop = True

        def begin(seed: int) -> RayStage:
            torch.manual_seed(0)
            stage = make()
            torch.manual_seed(seed)
            return stage

        whole = fit(begin(0))
        stopped = fit(begin(0), Stop())
        assert stopped.position.iteration == at
        resumed = fit(begin(123), ckpt_path=path)
        assert_same_weights(whole, resumed)
        return whole, stopped, resumed

    return learn


@pytest.fixture
def stored(tmp_path: Path) -> Callable[[Stage], LoadedCheckpoint]:
    """``stored(stage)``: what the checkpoint of a fitted stage holds."""

    def store(stage: Stage) -> LoadedCheckpoint:
        path = tmp_path / f"{stage.name}.ckpt"
        stage.trainer.save_checkpoint(path, weights_only=True)
        return load_checkpoint(path, stage.scene)

    return store


@pytest.fixture(scope="session")
def some_rays(tiny_scene: Scene) -> RayBatch:
    """Rays through some pixels of all moving images of the tiny scene."""
    views = tiny_scene.dynamic.train
    image = torch.arange(len(views)).repeat_interleave(30)
    flat = torch.arange(len(image)) * 7 % (views.width * views.height)
    return gather_batch(views, image, flat, torch.ones(3))


@pytest.fixture(scope="session")
def facing() -> Scene:
    """A toy before a wall, without alpha masks, in NDC: 24×18 pixels, 2 views of 2 frames."""
    return ProceduralForwardScene(
        width=24, height=18, static_views=4, train_views=2, frames=2, supersample=1
    )()
