"""What NSFF's tests share: tiny networks, and stages of a few iterations."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import pytest
import torch

from devrf.data.batch import RayBatch
from devrf.methods.batch import gather_batch
from devrf.methods.nsff.model import NSFF
from devrf.methods.nsff.renders import Renders
from devrf.methods.nsff.settings import NSFFSettings, Warmup
from devrf.scenes.scene import Scene

TINY = NSFFSettings(
    width=8, depth=2, bands=2, direction_bands=1, density_noise=0.0,
    sampling="occupancy", samples=8, steps=16, occupancy_side=8, hard_rays=4,
    warmup=Warmup(steps_per_frame=1, min_frames=1, max_frames=2, chained_from=1.0),
)  # fmt: skip


@pytest.fixture
def tiny() -> NSFFSettings:
    """Settings of a tiny network, with every term after two iterations."""
    return TINY


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


@pytest.fixture
def compared() -> Callable[..., Renders]:
    """``compared(model, batch)``: what the loss terms see of a batch.

    ``dynamic`` and ``static`` are changes of these fields' samples; others are of the renders.
    """

    def renders(
        model: NSFF,
        batch: RayBatch,
        dynamic: Mapping[str, Any] | None = None,
        static: Mapping[str, Any] | None = None,
        **changes: Any,
    ) -> Renders:
        output = changes.pop("output", None) or model(batch)
        output = replace(
            output,
            dynamic=replace(output.dynamic, **(dynamic or {})),
            static=replace(output.static, **(static or {})),
        )
        usual = {"priors": None, "step": 0, "both": True, "weighted": False, "chains": False}
        options = {**usual, "prior_factor": 1.0, **changes}
        return Renders(
            model.fields, model.placement, model.times, output=output, batch=batch, **options
        )

    return renders
