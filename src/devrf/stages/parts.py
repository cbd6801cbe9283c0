"""A batch of rays taken in parts, when it is too large for the memory."""

from __future__ import annotations

import logging
from collections.abc import Callable

import torch
from torch import Tensor

from devrf.data.batch import RayBatch
from devrf.errors import DevrfError
from devrf.shortage import ShortageError, give_back, is_shortage, numbers
from devrf.stages.ranks import world_size

log = logging.getLogger(__name__)

Terms = dict[str, Tensor]


class Parts:
    """In how many parts a batch is taken: one, until memory runs out.

    The parts of a batch are the same rays in the same order, and each counts by its share of
    them: sums and means over rays are what they would be, up to rounding. A term that is a mean
    over what its rays have met (cycle, flow) becomes a mean of the parts' means.

    Attributes:
        count: how many parts; once memory ran out, for the rest of the stage.
    """

    MOST = 8

    def __init__(self) -> None:
        self.count = 1
        self._present = 0
        self._share = 1.0
        self._rays = 0

    def of(self, batch: RayBatch) -> RayBatch:
        """What is to be learned from now, of the whole batch."""
        self._rays = len(batch.rays)
        if self.count == 1:
            return batch
        start, stop = (self._rays * k // self.count for k in (self._present, self._present + 1))
        self._share = (stop - start) / self._rays
        return batch.between(start, stop)

    def gradients(
        self,
        loss: Callable[[], tuple[Tensor, Terms]],
        backward: Callable[[Tensor], None],
        forget: Callable[[], None],
        generator: torch.Generator,
    ) -> tuple[Tensor, Terms]:
        """Loss and gradients of one iteration, in as few parts as the memory has room for.

        Args:
            loss: draws the batch, takes :meth:`of` it, and gives the loss and its terms.
            backward: adds the gradients of a loss to those that are there.
            forget: removes the gradients that are there.
            generator: what the batch is drawn with; it draws the same batch for all its parts.

        Raises:
            ShortageError: there is no room for the smallest part; nothing has changed.
            DevrfError: several processes learn together, and one has no room.
        """
        while True:
            state = generator.get_state()
            forget()
            try:
                return self._add_up(loss, backward, generator, state)
            except (RuntimeError, MemoryError) as error:
                if not is_shortage(error):
                    raise
                said = str(error)
            # Only now the tensors that the error's traceback held are gone.
            forget()
            generator.set_state(state)
            give_back(generator.device)
            self._divide(said, generator.device)

    def _add_up(
        self,
        loss: Callable[[], tuple[Tensor, Terms]],
        backward: Callable[[Tensor], None],
        generator: torch.Generator,
        state: Tensor,
    ) -> tuple[Tensor, Terms]:
        sums: Terms = {}
        for present in range(self.count):
            self._present = present
            if present:
                generator.set_state(state)
            total, terms = loss()
            if self.count > 1:
                total = total * self._share
                terms = {name: value * self._share for name, value in terms.items()}
            if total.requires_grad:
                backward(total)
            for name, value in {"": total.detach(), **terms}.items():
                sums[name] = sums[name] + value if name in sums else value
        return sums.pop(""), sums

    def _divide(self, said: str, device: torch.device) -> None:
        """Take twice as many parts from now on."""
        if world_size() > 1:
            # The others wait for this process's gradients by now.
            raise DevrfError(
                f"schedule: one of {world_size()} processes is out of memory "
                f"({numbers(said, device)}); fewer rays, smaller grids or more processes"
            )
        if self.count >= min(self.MOST, self._rays):
            raise ShortageError(f"out of memory ({numbers(said, device)})")
        self.count *= 2
        log.warning(
            "out of memory (%s): batches are taken in %d parts from now on", numbers(said, device),
            self.count,
        )
