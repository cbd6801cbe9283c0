"""What NSFF's tests share: tiny networks, and stages of a few iterations."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from lightning import Trainer

from devrf.data.batch import RayBatch
from devrf.data.datamodule import SceneDataModule
from devrf.engine.batches import gather_batch
from devrf.methods.nsff.model import NSFF
from devrf.methods.nsff.settings import NSFFSettings, Warmup
from devrf.methods.protocol import ProtocolStage
from devrf.methods.ray_stage import RaySchedule, RayStage
from devrf.scenes.procedural.recipe import ProceduralForwardScene
from devrf.scenes.scene import Scene

TINY = NSFFSettings(
    width=8, depth=2, skip=None, bands=2, direction_bands=1, density_noise=0.0,
    sampling="occupancy", samples=8, steps=16, occupancy_side=8, hard_rays=4,
    warmup=Warmup(steps_per_frame=1, min_frames=1, max_frames=2, chained_from=1.0),
)  # fmt: skip
QUICK = RaySchedule(
    iterations=4, rays=32, learning_rate=1e-2, final_learning_rate=1e-3, iterations_per_step=2
)
JOINT, DYNAMIC = ProtocolStage("joint", "both"), ProtocolStage("dynamic", "dynamic")
EVERY = dict.fromkeys(NSFF.losses, 0.1)

MakeStage = Callable[..., RayStage]
Fit = Callable[..., Trainer]


@pytest.fixture
def tiny() -> NSFFSettings:
    """Settings of a tiny network, with every term after two iterations."""
    return TINY


@pytest.fixture
def stage() -> MakeStage:
    """Makes a stage of four iterations on tiny networks; all its terms count."""

    def make(step: ProtocolStage = JOINT, settings: NSFFSettings = TINY, **options: Any) -> Any:
        torch.manual_seed(0)
        return RayStage(
            NSFF(settings), **{"schedule": QUICK, "loss": EVERY, "step": step} | options
        )

    return make


@pytest.fixture
def fit(trainer: Callable[..., Trainer], datamodule: SceneDataModule) -> Fit:
    """Trains a stage to its end, on the tiny scene if no other is given."""

    def run(one: RayStage, *callbacks: Any, data: Any = None, **options: Any) -> Trainer:
        fitted = trainer(*callbacks, **{"max_epochs": 1} | options)
        fitted.fit(one, datamodule=data or datamodule)
        return fitted

    return run


@pytest.fixture(scope="session")
def facing() -> Scene:
    """A toy before a wall, without mattes, in NDC: 24×18 pixels, 2 moving views of 2 frames."""
    return ProceduralForwardScene(
        width=24, height=18, static_views=4, train_views=2, frames=2, supersample=1
    )()


@pytest.fixture
def placed(tiny_scene: Scene) -> NSFF:
    """A tiny network in the tiny scene, sampled evenly."""
    torch.manual_seed(0)
    model = NSFF(replace(TINY, sampling="stratified"))
    model.setup(tiny_scene)
    return model.eval()  # at fixed places


@pytest.fixture
def batch(tiny_scene: Scene) -> RayBatch:
    """Rays of the middle frame (of three) of the tiny scene's two views."""
    views = tiny_scene.dynamic.train
    assert views.flow is not None
    # Three pixels of the robot and one beside it in each view.
    shown = [views.flow.valid[k].flatten().nonzero()[9::20, 0][:3] for k in (2, 3)]
    corner = torch.tensor([0])
    flat = torch.cat([shown[0], corner, shown[1], corner])
    image = torch.tensor([2, 2, 2, 2, 3, 3, 3, 3])
    return gather_batch(views, image, flat, torch.ones(3))
