"""How long the lists of a batch's samples are, where their length must not depend on data."""

from __future__ import annotations

import logging

import torch
from torch import Tensor

log = logging.getLogger(__name__)


class SampleCapacity:
    """The length of the lists that a batch's samples are written to; it follows what is needed.

    A list that was too short has lost the samples of the batch's last rays. That is seen a few
    steps later, without the host ever waiting for the device, and the lists grow.

    Attributes:
        visible: places for the samples that can be seen.
        significant: places for those whose colour counts; no more than ``visible``.
    """

    # Places for each ray before anything is known; spare places beyond what was needed.
    VISIBLE, SIGNIFICANT = 64, 16
    SPARE, GROWTH = 1.25, 1.5
    # Lists that are this many times longer than need be are shortened: fog clears.
    WASTE = 4
    GRAIN = 256

    def __init__(self, rays: int, device: torch.device) -> None:
        """Make room for batches of ``rays`` on ``device``."""
        self.visible, self.significant = (
            _rounded(rays * n) for n in (self.VISIBLE, self.SIGNIFICANT)
        )
        self._needed = torch.zeros(2, dtype=torch.int64, device=device)
        self._seen = torch.zeros(2, dtype=torch.int64, pin_memory=device.type == "cuda")
        self._under_way: torch.cuda.Event | None = None
        self._asked = self._said = False

    def note(self, visible: Tensor, significant: Tensor) -> None:
        """Remember, on the device, how many samples () there were to find."""
        torch.maximum(self._needed, torch.stack([visible, significant]), out=self._needed)

    def measure(self) -> bool:
        """Wait for what was noted, and fit the lists to it; whether their length has changed."""
        visible, significant = self._needed.tolist()
        self._needed.zero_()
        self._asked = False
        return self._fit(visible, significant, waste=1)

    def poll(self) -> bool:
        """As :meth:`measure`, without waiting: what was noted counts at a later call."""
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

    def _fit(self, visible: int, significant: int, waste: int) -> bool:
        before = self.visible, self.significant
        if (visible > self.visible or significant > self.significant) and not self._said:
            self._said = True
            log.info(
                "a batch had %d samples, %d of them to be coloured, for %d and %d places: its "
                "last rays lost theirs, and the lists grow",
                visible,
                significant,
                *before,
            )
        self.visible = self._length(self.visible, visible, waste)
        self.significant = min(self._length(self.significant, significant, waste), self.visible)
        return before != (self.visible, self.significant)

    def _length(self, length: int, needed: int, waste: int) -> int:
        if needed > length:
            return _rounded(max(self.GROWTH * length, self.SPARE * needed))
        return min(length, _rounded(waste * self.SPARE * needed))


def _rounded(places: float) -> int:
    return max(1, -(-int(places) // SampleCapacity.GRAIN)) * SampleCapacity.GRAIN
