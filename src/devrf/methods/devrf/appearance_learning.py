"""When and with what the deformation stage learns the appearance (docs/method.md#appearance)."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence

from torch import Tensor

from devrf.data.color_change import CHANGING, color_drift
from devrf.errors import DevrfError
from devrf.geometry.clock import FrameClock
from devrf.methods.devrf.appearance import AppearanceField, AppearanceSettings
from devrf.methods.devrf.deformation_schedule import DeformationPhase, DeformationSchedule
from devrf.methods.devrf.losses import total_variation_weight
from devrf.methods.devrf.model import DeVRFModel
from devrf.ops.adam import GridAdam
from devrf.scenes.scene import Views

log = logging.getLogger(__name__)

GROUP = "appearance"


def check_weights(loss: Mapping[str, float]) -> None:
    """Check the names of the weights in ``loss.appearance``.

    Raises:
        DevrfError: there is no such term.
    """
    unknown = sorted(map(str, set(loss) - {"residual", "tv"}))
    if unknown:
        raise DevrfError(
            f"loss.appearance: unknown term {unknown[0]!r}; the terms are residual, tv"
        )


class AppearanceLearning:
    """Gives the deformation stage residuals to learn, level by level.

    Attributes:
        settings: whether and how they are learned.
    """

    def __init__(
        self,
        settings: AppearanceSettings,
        schedule: DeformationSchedule,
        loss: Mapping[str, float],
    ) -> None:
        """Say how to learn.

        Args:
            settings: whether, and on which grids.
            schedule: the stage's levels, and its rays.
            loss: weights of the loss term ``residual``, and of the total variation ``tv``.
        """
        check_weights(loss)
        self.settings = settings
        self._schedule = schedule
        self._smoothing = loss.get("tv", 0.0)
        self._residual = loss.get("residual", 0.0)
        self._first = settings.start_level - 1
        # Of the weights of loss.deformation, from that level on.
        self._factors: Mapping[str, float] = {}

    @property
    def weights(self) -> dict[str, float]:
        """The weights of further loss terms of the stage; none where nothing can be learned."""
        return {} if self.settings.learn == "never" else {"residual": self._residual}

    def setup(
        self, model: DeVRFModel, clock: FrameClock, optimizer: GridAdam, views: Views
    ) -> None:
        """Build the residuals, zero, and their parameter group, empty as yet, if they are learned.

        Args:
            model: gets the residuals.
            clock: the times of the frames.
            optimizer: gets the group.
            views: the dynamic training views, on the host.
        """
        first, drifting = self._decide(views)
        if first is None:
            return
        if drifting:
            self._factors = self.settings.loss_scale_if_color_drift
        # The ablation without levels has one.
        self._first = min(first, len(self._schedule.levels)) - 1
        voxels, rate = self.settings.side**3, self.settings.learning_rate
        model.appearance = AppearanceField(model.box, clock, voxels=voxels)
        group = {"params": [], "lr": rate, "base_lr": rate, "name": GROUP}
        optimizer.add_param_group(group)

    def _decide(self, views: Views) -> tuple[int | None, bool]:
        """From which level residuals are learned, None: never; whether colours are to drift."""
        s = self.settings
        if s.learn != "auto":
            return (s.start_level if s.learn == "always" else None), True
        drift = color_drift(views)
        drifting = drift is not None and drift >= CHANGING
        first = s.start_level if drifting else s.start_level_static_color
        said = "cannot be followed" if drift is None else f"drift by {100 * drift:.1f} %"
        learned = "not learned" if first is None else f"learned from level {first} on"
        log.info("colours %s: their change is %s", said, learned)
        return first, drifting

    def at_level(self, model: DeVRFModel, level: int) -> AppearanceField | None:
        """The residuals, if ``level`` learns them."""
        return model.appearance if level >= self._first else None

    def weight_factor(self, term: str, level: int) -> float:
        """Factor of the weight of a loss term at ``level``, of a stage that has been set up."""
        return self._factors.get(term, 1.0) if level >= self._first else 1.0

    def initialise(self, model: DeVRFModel, phase: DeformationPhase) -> None:
        """At the first level that learns it, start a frame from the one visited before it."""
        if model.appearance is not None and phase.level == self._first:
            model.appearance.copy_neighbours(phase.frames, after=phase.backward)

    def give_parameters(self, optimizer: GridAdam, residuals: Sequence[Tensor], level: int) -> None:
        """Let the optimiser learn the active frames' ``residuals``, (X, Y, Z, 3) each.

        Within a visit their rate falls as that of the displacements does; from level to level it
        does not.
        """
        for number, group in enumerate(optimizer.param_groups):
            if group["name"] == GROUP:
                factor = self._schedule.learning_rate_factor(level)
                group["base_lr"] = self.settings.learning_rate / factor
                longest = max([2, *(max(one.shape) for one in residuals)])
                weight = total_variation_weight(self._smoothing, longest, self._schedule.rays)
                optimizer.replace(number, residuals, smoothing=weight)
