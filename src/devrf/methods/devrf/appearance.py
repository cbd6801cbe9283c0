"""How colours change over time: a residual in canonical space (docs/method.md#appearance)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import torch
from torch import Tensor

from devrf.checkpoints.stored_grids import StoredShape
from devrf.errors import DevrfError
from devrf.geometry.box import Box
from devrf.geometry.clock import FrameClock
from devrf.methods.devrf.frame_field import FrameField
from devrf.methods.devrf.voxel_grid import look_up


@dataclass(frozen=True)
class AppearanceSettings:
    """Whether and how the appearance is learned, beside the displacements.

    Attributes:
        learn: ``never``, ``always``, or ``auto``: where the images say that colours drift
            (docs/method.md#color-drift).
        side: the grid of a frame has about side³ voxels.
        learning_rate: logits a step: how far a value moves at most.
        start_level: the first level that learns it, from 1; the last one where there are fewer.
            The levels before find the motion alone.
        start_level_static_color: the same where ``auto`` finds that colours do not drift, so that
            shading alone changes; None: no level.
        loss_scale_if_color_drift: factors of the weights of ``loss.deformation``, by the term's
            name, at the levels that learn colours that drift: 1 for terms that are not named.
    """

    learn: Literal["never", "always", "auto"] = "never"
    side: int = 64
    learning_rate: float = 0.1
    start_level: int = 2
    start_level_static_color: int | None = None
    loss_scale_if_color_drift: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name, least in (("side", 2), ("start_level", 1), ("start_level_static_color", 1)):
            if (given := getattr(self, name)) is not None and given < least:
                raise DevrfError(
                    f"schedule.appearance.{name}: expected at least {least}, not {given}"
                )
        if not self.learning_rate > 0:
            raise DevrfError(
                f"schedule.appearance.learning_rate: expected more than 0, not {self.learning_rate}"
            )
        for name, factor in self.loss_scale_if_color_drift.items():
            if factor < 0:
                raise DevrfError(
                    f"schedule.appearance.loss_scale_if_color_drift.{name}: expected at least 0, "
                    f"not {factor}"
                )


@dataclass(frozen=True)
class ColorResidual:
    """q → A(q), trilinear in space.

    Attributes:
        grid: (X, Y, Z, 3) logits.
        box: where the grid lives, in canonical space; outside it A is as on its border.
    """

    grid: Tensor
    box: Box

    def __call__(self, points: Tensor) -> Tensor:
        """A (M, 3) at canonical ``points`` (M, 3); differentiable in the grid and the points."""
        return look_up(self.grid, points, self.box)


class AppearanceField(FrameField, StoredShape):
    """Residuals A_t (T, X, Y, Z, 3) over a box: c = sigmoid(decoder(f(q), d) + A_t(q)).

    Frame 0 is zero and never trained: the scene at rest looks as the canonical field says.
    Between two frames both are blended, as displacements are.

    Attributes:
        values: (T, X, Y, Z, 3) logits.
        box: where the field lives, in canonical space.
        clock: the times of the T frames.
    """

    resizable = ("values",)
    values: Tensor

    def __init__(self, box: Box, clock: FrameClock, *, voxels: int) -> None:
        """Residuals of zero for the clock's T frames, each on about ``voxels`` voxels."""
        super().__init__(box, clock)
        self.register_buffer("values", torch.zeros(len(clock), *box.grid_shape(voxels), 3))

    @property
    def shape(self) -> tuple[int, int, int]:
        """Grid points along x, y, z."""
        _, x, y, z, _ = self.values.shape
        return x, y, z

    def at(self, time: float) -> ColorResidual | None:
        """q → A(q) at ``time`` in [0, 1]; None where it is zero everywhere."""
        moment = self.clock.at(time)
        if moment.after == 0:
            return None
        grid = self.values[moment.before]
        if moment.weight:
            grid = grid.lerp(self.values[moment.after], moment.weight)
        return ColorResidual(grid, self.box)

    @torch.no_grad()
    def copy_neighbours(self, frames: Sequence[int], *, after: bool = False) -> None:
        """Initialise ``frames``, from 1 on, from the frames before them, or ``after`` them."""
        for frame in frames:
            neighbour = frame + (1 if after else -1)
            if neighbour < len(self.values):
                self.values[frame] = self.values[neighbour]
