"""Where a field itself has been empty at all times, so that rays skip it."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from devrf.checkpoints.stored_grids import StoredShape
from devrf.geometry.box import Box

# A cell is empty below LEAST of opacity a step: what it is at a random place and time, or DECAY
# of what it was. EVERY so many iterations a SHARE of all cells is looked at anew; the first time
# all of them, at FIRST times.
LEAST, DECAY, EVERY, SHARE, FIRST = 0.01, 0.9, 16, 0.5, 4
# Points that a field is asked for at once.
CHUNK = 1 << 18


class LearnedOccupancy(StoredShape):
    """A decaying maximum over places and times of each cell's opacity, learned beside the field.

    Attributes:
        opacity: (X, Y, Z) of a step; 1 until the field is asked. (0, 0, 0): nothing is left out.
    """

    resizable = ("opacity",)
    opacity: Tensor

    def __init__(self, shape: tuple[int, int, int] = (0, 0, 0)) -> None:
        """Exclude nothing.

        Args:
            shape: cells over a box, corners on its corners; all 0: nothing is ever left out.
        """
        super().__init__()
        self.register_buffer("opacity", torch.ones(shape))

    def occupied(self, cell: Tensor) -> Tensor | None:
        """Whether something may be in cells of row-major numbers (S,): (S,) bool; None: in all."""
        if not self.opacity.numel():
            return None
        return self.opacity.view(-1)[cell] > LEAST

    @torch.no_grad()
    def follow(
        self,
        step: int,
        total: int,
        share: float | None,
        box: Box,
        opacity_at: Callable[[Tensor, Tensor], Tensor],
    ) -> None:
        """Look at cells again if iteration ``step`` is one to do so.

        Args:
            step: of a stage, from 0; what another stage saw is forgotten there.
            total: iterations of the stage.
            share: of these, before which nothing is left out; None: nothing ever is.
            box: where the cells are, in the fields' space.
            opacity_at: the opacity (S,) of a step at points (S, 3) of that space and times (S,) in
                [0, 1].
        """
        if share is None or not self.opacity.numel():
            return
        if step == 0:
            self.opacity.fill_(1)
        start = round(share * total)
        if step < start or step % EVERY:
            return
        count, flat = self.opacity.numel(), self.opacity.view(-1)
        if step < start + EVERY:
            flat.zero_()
            for _ in range(FIRST):
                self._look(torch.arange(count, device=flat.device), box, opacity_at)
        else:
            chosen = torch.rand(count, device=flat.device) < SHARE
            self._look(chosen.nonzero()[:, 0], box, opacity_at)

    def _look(
        self, cells: Tensor, box: Box, opacity_at: Callable[[Tensor, Tensor], Tensor]
    ) -> None:
        flat = self.opacity.view(-1)
        for part in torch.split(cells, CHUNK):
            points = self._points(part, box)
            seen = opacity_at(points, torch.rand_like(points[:, 0]))
            flat[part] = torch.maximum(DECAY * flat[part], seen)

    def _points(self, cells: Tensor, box: Box) -> Tensor:
        """A random point (S, 3) nearest to each of the grid points of numbers (S,)."""
        _, y, z = self.opacity.shape
        place = torch.stack([cells // (y * z), cells // z % y, cells % z], dim=1)
        low, high = box.corners(self.opacity)
        last = torch.tensor(self.opacity.shape, device=cells.device) - 1
        jittered = place + torch.rand(len(cells), 3, device=cells.device) - 0.5
        return box.nearest(low + jittered / last * (high - low))
