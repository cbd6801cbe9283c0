"""The fixed length of a batch's sample lists, where shapes must not depend on data."""

from __future__ import annotations

import logging
import math

import torch
from torch import Tensor

log = logging.getLogger(__name__)


class SampleCapacity:
    """The lengths of the lists of a batch's samples, adapted to the numbers that were needed.

    Where a list was too short, samples of the batch's last rays were dropped. The host learns this
    a few steps later, without waiting for the device, and lengthens the lists.

    Attributes:
        visible: length of the list of visible samples.
        significant: length of the list of those whose colour is needed; at most ``visible``.
        num_short: how often a list was found to have been too short.
    """

    # Initial places for each ray.
    VISIBLE, SIGNIFICANT = 64, 16
    # A list that was too short gets SPARE times what was needed, and grows at least by GROWTH.
    SPARE, GROWTH = 1.25, 1.5
    # A list is shortened if it is this many times too long: fog clears during training.
    WASTE = 1.5
    # Lengths are multiples of this.
    GRAIN = 256

    def __init__(self, rays: int, device: torch.device) -> None:
        """Initial lengths for batches of ``rays`` on ``device``."""
        self.visible, self.significant = (
            _rounded(rays * n) for n in (self.VISIBLE, self.SIGNIFICANT)
        )
        self._needed = torch.zeros(2, dtype=torch.int64, device=device)
        self._seen = torch.zeros(2, dtype=torch.int64, pin_memory=device.type == "cuda")
        self._under_way: torch.cuda.Event | None = None
        self._asked = False
        self.num_short = 0

    def note(self, visible: Tensor, significant: Tensor) -> None:
        """Record on the device how many samples () a batch had."""
        torch._foreach_maximum_(self._needed.unbind(), [visible, significant])

    def measure(self) -> bool:
        """Wait for the recorded numbers and adapt the lengths; True if they have changed."""
        visible, significant = self._needed.tolist()
        self._needed.zero_()
        self._asked = False
        return self._fit(visible, significant, waste=1)

    def suffices(self) -> bool:
        """Wait for the recorded numbers; False if a list was too short: it is longer now."""
        visible, significant = self._needed.tolist()
        self._needed.zero_()
        enough: bool = visible <= self.visible and significant <= self.significant
        # Of a list that was too short the significant samples are not all known.
        self._set_lengths(visible, significant, self.WASTE if enough else math.inf)
        return enough

    def poll(self) -> bool:
        """As :meth:`measure`, without waiting: recorded numbers take effect at a later call."""
        if not self._asked:
            self._seen.copy_(self._needed, non_blocking=True)
            self._needed.zero_()
            if self._needed.is_cuda:
                self._under_way = torch.cuda.Event()  # type: ignore[no-untyped-call]
                self._under_way.record()
            self._asked = True
            return False
        under_way = self._under_way
        if under_way is not None and not under_way.query():  # type: ignore[no-untyped-call]
            return False
        self._asked = False
        visible, significant = self._seen.tolist()
        return self._fit(visible, significant, waste=self.WASTE)

    def _fit(self, visible: int, significant: int, waste: float) -> bool:
        if visible > self.visible or significant > self.significant:
            if not self.num_short:
                log.info(
                    "a batch had %d samples, %d of them to be coloured, for %d and %d places: "
                    "samples of the last rays were dropped, and the lists grow",
                    *(visible, significant, self.visible, self.significant),
                )
            self.num_short += 1
        return self._set_lengths(visible, significant, waste)

    def _set_lengths(self, visible: int, significant: int, waste: float) -> bool:
        before = self.visible, self.significant
        self.visible = self._length(self.visible, visible, waste)
        self.significant = min(self._length(self.significant, significant, waste), self.visible)
        return before != (self.visible, self.significant)

    def _length(self, length: int, needed: int, waste: float) -> int:
        if needed > length:
            return _rounded(max(self.GROWTH * length, self.SPARE * needed))
        fitting = _rounded(self.SPARE * needed)
        return fitting if length > waste * fitting else length


def _rounded(places: float) -> int:
    return max(1, -(-int(places) // SampleCapacity.GRAIN)) * SampleCapacity.GRAIN
