"""A batch of rays taken in parts, when it is too large for the memory."""

from __future__ import annotations

import logging
from collections.abc import Callable

import torch
from torch import Tensor

from devrf.data.batch import Pixels
from devrf.engine.ddp import world_size
from devrf.errors import DevrfError
from devrf.system.out_of_memory import OutOfMemoryError, free_cache, is_oom, numbers

log = logging.getLogger(__name__)

Terms = dict[str, Tensor]


class MicroBatching:
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

    def gradients(
        self,
        loss: Callable[[Pixels], tuple[Tensor, Terms]],
        pixels: Pixels,
        backward: Callable[[Tensor], None],
        divided: Callable[[], None],
    ) -> tuple[Tensor, Terms]:
        """Loss and gradients of one iteration, in as few parts as the memory has room for.

        Args:
            loss: gives the loss of pixels and its terms.
            pixels: the batch.
            backward: adds the gradients of a loss to those that are there.
            divided: removes the gradients that are there, and whatever is as large as a part.

        Raises:
            OutOfMemoryError: there is no room for the smallest part; nothing has changed.
            DevrfError: several processes learn together, and one has no room.
        """
        device = pixels.image.device
        while True:
            try:
                return self._add_up(loss, pixels, backward)
            except (RuntimeError, MemoryError) as error:
                # What is being captured cannot be begun anew.
                capturing = device.type == "cuda" and torch.cuda.is_current_stream_capturing()
                if capturing or not is_oom(error):
                    raise
                said = str(error)
            # Only now the tensors that the error's traceback held are gone.
            self._divide(said, device, len(pixels))
            divided()
            free_cache(device)

    def _add_up(
        self,
        loss: Callable[[Pixels], tuple[Tensor, Terms]],
        pixels: Pixels,
        backward: Callable[[Tensor], None],
    ) -> tuple[Tensor, Terms]:
        sums: Terms = {}
        for present in range(self.count):
            start, stop = (len(pixels) * k // self.count for k in (present, present + 1))
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

    def _divide(self, said: str, device: torch.device, rays: int) -> None:
        """Take twice as many parts from now on."""
        if world_size() > 1:
            # The others wait for this process's gradients by now.
            raise DevrfError(
                f"schedule: one of {world_size()} processes is out of memory "
                f"({numbers(said, device)}); fewer rays, smaller grids or more processes"
            )
        if self.count >= min(self.MOST, rays):
            raise OutOfMemoryError(f"out of memory ({numbers(said, device)})")
        self.count *= 2
        log.warning(
            "out of memory (%s): batches are taken in %d parts from now on",
            numbers(said, device),
            self.count,
        )
