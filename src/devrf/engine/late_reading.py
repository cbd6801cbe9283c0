"""Numbers of a device that the host reads one call late, so that it need not wait for them."""

from __future__ import annotations

import torch
from torch import Tensor


class LateReading:
    """Hands over at each call what was given at the call before.

    What was given last may still be queued on the device; what was given before that has long been
    computed, so that the device is never left without work. The delay is the same each time,
    whatever the device's speed.
    """

    def __init__(self) -> None:
        self._waiting: Tensor | None = None
        self._copied: torch.cuda.Event | None = None

    def exchange(self, values: Tensor) -> list[float] | None:
        """The values (K,) of the call before, None at the first; these ones are for the next."""
        before = self.waiting
        if values.is_cuda:
            self._waiting = torch.empty(values.shape, dtype=values.dtype, pin_memory=True)
            self._waiting.copy_(values, non_blocking=True)
            self._copied = torch.cuda.Event()  # type: ignore[no-untyped-call]
            self._copied.record()
        else:
            self._waiting, self._copied = values.clone(), None
        return before

    @property
    def waiting(self) -> list[float] | None:
        """What the next call hands over; read when the device has it."""
        if self._copied is not None:
            self._copied.synchronize()
        return None if self._waiting is None else list(self._waiting.tolist())

    def reset(self, waiting: list[float] | None = None) -> None:
        """Forget what was given, or hand over ``waiting`` next."""
        self._waiting = None if waiting is None else torch.tensor(waiting)
        self._copied = None
