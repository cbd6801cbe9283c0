"""What extensions of the deformation stage may add to it."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING

from devrf.methods.devrf.active_frame import ActiveFrame
from devrf.methods.devrf.deformation_schedule import DeformationPhase
from devrf.methods.devrf.frame_store import FrameField
from devrf.methods.devrf.losses import MotionTerm
from devrf.rendering.output import ColorChange

if TYPE_CHECKING:
    from devrf.methods.devrf.deformation_stage import DeformationStage


class Extension:
    """Adds to the deformation stage; what is not overridden adds nothing.

    An extension is one file of ``extensions/`` and one block of ``schedule.extensions``; without
    both, all else runs as before. Hooks are called in the order in which they stand here.
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

    def setup(self, stage: DeformationStage) -> None:
        """Add fields to the model and groups to the optimiser, before learning starts."""

    def frame_fields(self, stage: DeformationStage, level: int) -> Mapping[str, FrameField]:
        """Fields whose frames are learned at ``level`` as the displacements are, by name."""
        return {}

    def begin_level(self, stage: DeformationStage, level: int) -> None:
        """Memory of the active frame is ready; give the optimiser what is learned of it."""

    def weight_factor(self, term: str, level: int, share: float) -> float:
        """Factor of the weight of any loss term at ``level``, a ``share`` of a visit being over."""
        return 1.0

    def initialise(self, stage: DeformationStage, phase: DeformationPhase) -> None:
        """Give the phase's frame its first values, in the fields, before a visit."""

    def color_change(self, frame: ActiveFrame) -> ColorChange | None:
        """What is added to the colours' logits of an active frame; None: nothing."""
        return None
