"""The colour residual, by which colours change over time (docs/method.md#color-residual)."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from functools import partial
from typing import ClassVar, Literal

import torch
from torch import Tensor

from devrf.checkpoints.stored_grids import StoredShape
from devrf.data.color_change import CHANGING, color_drift
from devrf.errors import expect
from devrf.geometry.box import Box
from devrf.geometry.clock import FrameClock
from devrf.kernels.trilinear import interpolate
from devrf.methods.devrf.active_frame import ActiveFrame
from devrf.methods.devrf.deformation_schedule import DeformationPhase
from devrf.methods.devrf.extension import DeformationContext, Extension
from devrf.methods.devrf.frame_store import FrameField
from devrf.methods.devrf.losses import DeformationPrediction, total_variation_weight
from devrf.methods.devrf.model import ColorResidualField
from devrf.rendering.output import ColorResidual
from devrf.scenes.scene import Views

log = logging.getLogger(__name__)

# Of the frames' field, and of the optimiser's group.
NAME = "color_residual"


class ColorResidualGrid(ColorResidualField, StoredShape):
    """Residuals A_t (T, X, Y, Z, 3) over a box: c = sigmoid(decoder(f(q), d) + A_t(q)).

    Frame 0 is zero and never trained: the scene at rest looks as the canonical field says.
    Between two frames both are blended, as displacements are.

    Attributes:
        values: (T, X, Y, Z, 3) logits.
        box: of the field, in canonical space.
        clock: the times of the T frames.
    """

    resizable: ClassVar = {"values": 4}
    values: Tensor

    def __init__(self, box: Box, clock: FrameClock, *, voxels: int) -> None:
        """Residuals of zero for the clock's T frames, each on about ``voxels`` voxels."""
        super().__init__(box, clock)
        self.register_buffer("values", torch.zeros(len(clock), *box.grid_shape(voxels), 3))

    def at(self, time: float) -> ColorResidual | None:
        """q → A_t(q) at ``time`` in [0, 1], trilinear in space; None where it is zero."""
        moment = self.clock.at(time)
        if moment.after == 0:
            return None
        grid = self.values[moment.before]
        if moment.weight:
            grid = grid.lerp(self.values[moment.after], moment.weight)
        return partial(interpolate, grid, box=self.box)


class LearnColorResidual(Extension):
    """Learns residuals beside the displacements, from some level on."""

    scaled_terms: Mapping[str, float]

    def __init__(
        self,
        learn: Literal["never", "always", "auto"] = "never",
        side: int = 64,
        learning_rate: float = 0.1,
        start_level: int = 2,
        start_level_static_color: int | None = None,
        loss_scale_if_color_drift: Mapping[str, float] | None = None,
        residual: float = 1e-3,
        tv: float = 0.002,
    ) -> None:
        """Choose whether and how to learn.

        Args:
            learn: ``never``, ``always``, or ``auto``: if the images show that colours drift
                (docs/method.md#color-drift).
            side: the grid of a frame has about side³ voxels.
            learning_rate: the most logits that a value moves in a step.
            start_level: the first level that learns it, from 1; the last one where there are
                fewer. The levels before find the motion alone.
            start_level_static_color: the same where ``auto`` finds that colours do not drift, so
                that shading alone changes; None: no level.
            loss_scale_if_color_drift: factors of the weights of loss terms, by name, at the levels
                that learn it where colours drift: 1 for terms that are not named.
            residual: weight of the squared residuals in the loss.
            tv: weight of their total variation.
        """
        key = "schedule.extensions.color_residual"
        static = start_level_static_color
        holds = learn in ("never", "always", "auto")
        expect(holds, f"{key}.learn", "never, always or auto", learn)
        expect(start_level >= 1, f"{key}.start_level", "at least 1", start_level)
        good = static is None or static >= 1
        expect(good, f"{key}.start_level_static_color", "at least 1, or null", static)
        expect(side >= 2, f"{key}.side", "at least 2", side)
        expect(learning_rate > 0, f"{key}.learning_rate", "above 0", learning_rate)
        self._learn = learn
        self._side = side
        self._learning_rate = learning_rate
        self._start = start_level
        self._start_if_static = start_level_static_color
        self.scaled_terms = loss_scale_if_color_drift or {}
        for name, factor in self.scaled_terms.items():
            term_key = f"{key}.loss_scale_if_color_drift.{name}"
            expect(factor >= 0, term_key, "at least 0", factor)
        self.terms = {"residual": squared_residual}
        # Where nothing can be learned there is none.
        self.weights = {} if learn == "never" else {"residual": residual}
        self._tv = tv
        # Once set up: the first level that learns it, from 0; factors of weights from it on.
        self._first: int | None = None
        self._scale: Mapping[str, float] = {}

    def setup(self, context: DeformationContext) -> None:
        """Build the residuals, zero, and their empty parameter group, if they are learned."""
        first, drifting = self._decide(context.datamodule.scene.dynamic.train)
        if first is None:
            return
        self._scale = self.scaled_terms if drifting else {}
        # The ablation without levels has one.
        self._first = min(first, len(context.settings.levels)) - 1
        model = context.model
        rate = self._learning_rate
        model.color_residual = ColorResidualGrid(
            model.box, context.field.clock, voxels=self._side**3
        )
        context.optimizer.add_param_group({"params": [], "lr": rate, "base_lr": rate, "name": NAME})

    def _decide(self, views: Views) -> tuple[int | None, bool]:
        """The level from which residuals are learned, None: never; whether colours are to drift."""
        if self._learn != "auto":
            return (self._start if self._learn == "always" else None), True
        drift = color_drift(views)
        drifting = drift is not None and drift >= CHANGING
        first = self._start if drifting else self._start_if_static
        how = "cannot be followed" if drift is None else f"drift by {100 * drift:.1f} %"
        learned = "not learned" if first is None else f"learned from level {first} on"
        log.info("colours %s: their residual is %s", how, learned)
        return first, drifting

    def frame_fields(self, context: DeformationContext, level: int) -> Mapping[str, FrameField]:
        """The residuals, if ``level`` learns them."""
        field = context.model.color_residual
        learned = self._first is not None and level >= self._first
        return {NAME: field} if learned and field is not None else {}

    def begin_level(self, context: DeformationContext, level: int) -> None:
        """Let the optimiser learn the active frame's residuals (X, Y, Z, 3).

        Their rate falls within a visit as that of the displacements does, but not from level to
        level.
        """
        assert context.active is not None
        residuals = [grid for name, grid in context.active.further.items() if name == NAME]
        for number, group in enumerate(context.optimizer.param_groups):
            if group["name"] == NAME:
                group["base_lr"] = self._learning_rate / context.settings.level_rate_factor(level)
                longest = max([2, *(max(grid.shape) for grid in residuals)])
                weight = total_variation_weight(self._tv, longest, context.settings.rays)
                context.optimizer.replace(number, residuals, smoothing=weight)

    def weight_factor(self, term: str, level: int, share: float) -> float:
        """Lower some terms where a texture may slide over the surface."""
        return 1.0 if self._first is None or level < self._first else self._scale.get(term, 1.0)

    def initialise(self, context: DeformationContext, phase: DeformationPhase) -> None:
        """At the first level that learns it, start a frame from the one visited before it."""
        field = context.model.color_residual
        before = phase.frame - phase.step
        if field is None or phase.level != self._first:
            return
        if before < len(field.clock):  # backwards, the last frame is the first
            field.values[phase.frame] = field.values[before]

    def color_residual(self, frame: ActiveFrame) -> ColorResidual | None:
        """q → A_t(q), as learned so far."""
        if NAME not in frame.further:
            return None
        return partial(interpolate, frame.further[NAME], box=frame.fields[NAME].box)


def squared_residual(prediction: DeformationPrediction) -> Tensor:
    """(1/R) Σ_i w_i |A_t(q_i)|²: colours stay as at rest; 0 without residuals."""
    output = prediction.output
    if output.color_residual is None:
        return output.color.new_zeros(())
    large = (output.samples.weight.detach() * output.color_residual.square().sum(dim=1)).sum()
    return large / len(prediction.batch.rays)
