"""What an extension of the deformation stage may add, and what it sees of the stage.

An extension is one file of ``extensions/`` and one block of ``schedule.extensions``; without both,
all else runs as before.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from typing import Protocol

import torch
from torch import Tensor

from devrf.engine.active_frames import ActiveFrame, ActiveFrames
from devrf.engine.loop import Loop
from devrf.methods.devrf.deformation_field import DeformationField, FrameField
from devrf.methods.devrf.deformation_schedule import DeformationPhase, DeformationSchedule
from devrf.methods.devrf.losses import MotionPrediction
from devrf.methods.devrf.model import DeVRFModel
from devrf.ops.adam import GridAdam
from devrf.rendering.output import ColorChange
from devrf.scenes.scene import Scene, Views

# An unweighted loss term: prediction → ().
MotionTerm = Callable[[MotionPrediction], Tensor]


class MotionLearner(Protocol):
    """The deformation stage, as extensions see it.

    Attributes:
        schedule: levels, iterations and rays.
        scene_model: what is learned.
        generator: draws random numbers, on the stage's device.
        active: the frames that are trained.
        loop: carries iterations out.
    """

    schedule: DeformationSchedule
    scene_model: DeVRFModel
    generator: torch.Generator
    active: ActiveFrames
    loop: Loop

    @property
    def weights(self) -> Mapping[str, float]:
        """Of the loss terms that count at the present level."""
        ...

    @property
    def scene(self) -> Scene:
        """The scene."""
        ...

    @property
    def field(self) -> DeformationField:
        """The deformation field; the active frames' part may not be written back yet."""
        ...

    @property
    def optimizer(self) -> GridAdam:
        """Adam; an extension that learns adds a group of its own."""
        ...

    @property
    def views(self) -> Views:
        """The dynamic training views, on the stage's device."""
        ...

    @property
    def previous_images(self) -> Tensor:
        """(N,) for each image the same view's image one frame earlier; itself without one."""
        ...


class Extension:
    """Adds to the deformation stage; what is not overridden adds nothing.

    Hooks are called in the order in which they stand here.
    """

    @property
    def terms(self) -> Mapping[str, MotionTerm]:
        """Further loss terms, by name."""
        return {}

    @property
    def weights(self) -> Mapping[str, float]:
        """How much they count, where ``loss.deformation`` does not say."""
        return {}

    @property
    def scaled_terms(self) -> Collection[str]:
        """The loss terms that :meth:`weight_factor` may change."""
        return ()

    def setup(self, stage: MotionLearner) -> None:
        """Add fields to the model and groups to the optimiser, before learning starts."""

    def frame_fields(self, stage: MotionLearner, level: int) -> Mapping[str, FrameField]:
        """Fields whose frames are learned at ``level`` as the displacements are, by name."""
        return {}

    def begin_level(self, stage: MotionLearner, level: int) -> None:
        """Memory of the active frames is ready; give the optimiser what is learned of them."""

    def weight_factor(self, term: str, level: int) -> float:
        """Factor of the weight of any loss term at ``level``."""
        return 1.0

    def changes(self, stage: MotionLearner, phase: DeformationPhase) -> bool:
        """Whether :meth:`initialise` changes the displacements of the phase's frames."""
        return False

    def initialise(self, stage: MotionLearner, phase: DeformationPhase, frame: int) -> None:
        """Give one of the phase's frames its first values, in the fields, before a visit."""

    def color_change(self, frame: ActiveFrame) -> ColorChange | None:
        """What is added to the colours' logits of an active frame; None: nothing.

        Asked once a level: it reads the frame's present values whenever it is called.
        """
        return None
