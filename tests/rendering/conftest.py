"""A scene to render: learned at rest, moved by hand."""

from __future__ import annotations

import copy
from collections.abc import Callable

import pytest
import torch
from lightning import Trainer

from devrf.fields.deformation import DeformationField
from devrf.geometry.clock import FrameClock
from devrf.rendering.model import SceneModel
from devrf.rendering.picture import Picture
from devrf.stages.canonical import CanonicalStage


@pytest.fixture
def moving(learned: tuple[CanonicalStage, Trainer], rng: torch.Generator) -> SceneModel:
    """The tiny scene; at the times 0.4 and 1 every point has moved by up to 5 % of its box."""
    model = copy.deepcopy(learned[0].model)
    box = model.canonical.box
    motion = DeformationField(box, FrameClock((0.0, 0.4, 1.0)), voxels=5**3)
    shape = motion.to_canonical[1:].shape
    motion.to_canonical[1:] = 0.1 * box.longest * (torch.rand(shape, generator=rng) - 0.5)
    model.deformation = motion
    return model


@pytest.fixture
def same() -> Callable[[Picture, Picture], None]:
    """Fails unless two pictures show the same, up to 1e-5."""

    def compare(one: Picture, other: Picture) -> None:
        for name in ("color", "depth", "opacity"):
            torch.testing.assert_close(
                getattr(one, name), getattr(other, name), atol=1e-5, rtol=1e-5
            )

    return compare
