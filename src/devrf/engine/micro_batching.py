"""Micro-batches: a batch that does not fit into memory is processed in parts."""

from __future__ import annotations

import logging
from collections.abc import Callable

import torch
from torch import Tensor

from devrf.data.batch import Pixels
from devrf.engine.ddp import world_size
from devrf.errors import DevrfError
from devrf.system.memory import OutOfMemoryError, free_cache, is_oom, numbers

log = logging.getLogger(__name__)

Terms = dict[str, Tensor]
Loss = Callable[[Pixels], tuple[Tensor, Terms]]
Backward = Callable[[Tensor], None]


class MicroBatching:
    """Accumulates a batch's gradients over ``count`` micro-batches, more when memory runs out.

    Micro-batches have the rays of the batch in the same order, and each is weighted by its share
    of them: sums and means over rays are unchanged, up to rounding. A term that is a mean over a
    subset of the rays (cycle, flow) becomes a mean of the micro-batches' means.

    Attributes:
        count: micro-batches of a batch: 1, and doubled whenever memory runs out.
    """

    MOST = 8
    count = 1

    def gradients(
        self, loss: Loss, pixels: Pixels, backward: Backward, divided: Callable[[], None]
    ) -> tuple[Tensor, Terms]:
        """Loss and gradients of one iteration, in as few micro-batches as fit into memory.

        Args:
            loss: computes the loss () of pixels and its terms () by name.
            pixels: the batch.
            backward: adds the gradients of a loss to the present ones.
            divided: called after ``count`` was raised: removes the gradients of the failed attempt
                and resizes what is as large as a micro-batch.

        Returns:
            The loss of the batch, detached, and its terms.

        Raises:
            OutOfMemoryError: the smallest micro-batch does not fit.
            DevrfError: memory ran out in one of several processes.
        """
        device = pixels.image.device
        while True:
            try:
                return self._accumulate(loss, pixels, backward)
            except (RuntimeError, MemoryError) as error:
                if not is_oom(error):
                    raise
                message = str(error)
            # Outside the handler, where the error's traceback no longer holds tensors.
            self._divide(message, device, len(pixels))
            divided()
            free_cache(device)

    def _accumulate(self, loss: Loss, pixels: Pixels, backward: Backward) -> tuple[Tensor, Terms]:
        sums: Terms = {}
        for part in range(self.count):
            start, stop = (len(pixels) * k // self.count for k in (part, part + 1))
            total, terms = loss(pixels if self.count == 1 else pixels.between(start, stop))
            if self.count > 1:
                share = (stop - start) / len(pixels)
                total = total * share
                terms = {name: value * share for name, value in terms.items()}
            if total.requires_grad:
                backward(total)
            for name, value in {"": total.detach(), **terms}.items():
                sums[name] = sums[name] + value if name in sums else value
        return sums.pop(""), sums

    def _divide(self, message: str, device: torch.device, rays: int) -> None:
        """Double ``count``, if there are enough rays; ``message`` is the allocator's message."""
        if world_size() > 1:
            # The other processes already wait for this one's gradients.
            raise DevrfError(
                f"schedule: one of {world_size()} processes is out of memory "
                f"({numbers(message, device)}); fewer rays, smaller grids or more processes"
            )
        if self.count >= min(self.MOST, rays):
            raise OutOfMemoryError(f"out of memory ({numbers(message, device)})")
        self.count *= 2
        log.warning(
            "out of memory (%s): batches are split into %d micro-batches from now on",
            *(numbers(message, device), self.count),
        )
