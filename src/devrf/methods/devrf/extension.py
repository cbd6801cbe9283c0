"""Extensions of the deformation stage: the hooks by which they add to it."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

import torch

from devrf.data.batch import BackgroundColor
from devrf.data.datamodule import SceneDataModule
from devrf.engine.batch_size import BatchSize
from devrf.engine.grid_adam import GridAdam
from devrf.methods.devrf.active_frame import ActiveFrame
from devrf.methods.devrf.deformation_field import DeformationField
from devrf.methods.devrf.deformation_schedule import DeformationPhase, DeformationSchedule
from devrf.methods.devrf.frame_store import FrameField
from devrf.methods.devrf.losses import DeformationTerm
from devrf.methods.devrf.model import DeVRFModel
from devrf.rendering.output import ColorResidual
from devrf.scenes.scene import Views


@dataclass
class DeformationContext:
    """The parts of the deformation stage that an extension works with.

    Attributes:
        model: the scene; its deformation has been built.
        datamodule: serves the scene.
        settings: of the schedule: levels and rays.
        optimizer: learns the active frame; extensions add groups.
        generator: of all random numbers.
        background: the colours behind the images' pixels.
        batch_size: the share of the schedule's rays that is drawn.
        weights: of the loss terms that count at the present iteration.
        active: the frame that is trained; None before the first, and after the last.
    """

    model: DeVRFModel
    datamodule: SceneDataModule
    settings: DeformationSchedule
    optimizer: GridAdam
    generator: torch.Generator
    background: BackgroundColor
    batch_size: BatchSize
    weights: Mapping[str, float] = field(default_factory=dict)
    active: ActiveFrame | None = None

    @property
    def views(self) -> Views:
        """The dynamic training views, on the device of the model."""
        return self.datamodule.training_views("dynamic", self.model.device)

    @property
    def field(self) -> DeformationField:
        """The deformation field; the active frame may not be written back yet."""
        assert self.model.deformation is not None
        return self.model.deformation


class Extension:
    """Adds to the deformation stage; a hook that is not overridden adds nothing.

    An extension is one file of ``extensions/`` and one block of ``schedule.extensions``; without
    both, all else runs as before. Its attributes are read when the stage is built, then comes
    :meth:`setup`. At each visit of a frame follow :meth:`initialise`, unless the visit is resumed,
    and where a level begins :meth:`frame_fields` and :meth:`begin_level`; in each iteration
    :meth:`weight_factor` and :meth:`color_residual`.

    Attributes:
        terms: further loss terms, by name.
        weights: theirs, unless ``loss.deformation`` gives them.
        scaled_terms: names from the config that have to be those of loss terms.
    """

    terms: Mapping[str, DeformationTerm] = {}
    weights: Mapping[str, float] = {}
    scaled_terms: Collection[str] = ()

    def setup(self, context: DeformationContext) -> None:
        """Add fields to the model and groups to the optimiser, before learning starts."""

    def initialise(self, context: DeformationContext, phase: DeformationPhase) -> None:
        """Give the phase's frame its first values, in the fields, before a visit."""

    def frame_fields(self, context: DeformationContext, level: int) -> Mapping[str, FrameField]:
        """Fields whose frames are learned at ``level`` as the displacements are, by name."""
        return {}

    def begin_level(self, context: DeformationContext, level: int) -> None:
        """Memory of the active frame is ready; give the optimiser its parameters."""

    def weight_factor(self, term: str, level: int, share: float) -> float:
        """Factor of the weight of any loss term at ``level``, a ``share`` of a visit being over."""
        return 1.0

    def color_residual(self, frame: ActiveFrame) -> ColorResidual | None:
        """q → A_t(q), added to the colours' logits, of an active frame; None: nothing is."""
        return None
