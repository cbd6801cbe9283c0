"""Whether batches have anything left to gain, found without the host waiting for the device."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor


def converged(losses: Sequence[float], min_rel_improvement: float) -> bool:
    """Whether the last two steps took less than ``min_rel_improvement`` off the best loss before.

    Two, since one may have drawn difficult pixels; fewer than three steps never tell.

    Args:
        losses: mean loss of each Lightning step of a visit.
        min_rel_improvement: a share of the loss, in (0, 1].
    """
    if len(losses) < 3:
        return False
    return min(losses[-2:]) > (1 - min_rel_improvement) * min(losses[:-2])


class Convergence:
    """Watches the losses of parallel batches, step by step; on a GPU one step late.

    What was given last may still be queued on the device; what was given before that has been
    computed long ago, so that the device is never left without work. The delay is the same each
    time, whatever the device's speed.
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget all losses: a visit begins, or begins again."""
        self._losses: list[list[float]] = []
        self._waiting: Tensor | None = None
        self._copied: torch.cuda.Event | None = None

    def converged(self, losses: Tensor, min_rel_improvement: float) -> bool:
        """Whether each batch's loss has stopped falling (docs/method.md#coarse-to-fine).

        Args:
            losses: (batches,) mean losses of a Lightning step.
            min_rel_improvement: as of :func:`converged`.
        """
        known = self._exchange(losses) if losses.is_cuda else losses.tolist()
        if known is None:
            return False
        self._losses = self._losses or [[] for _ in known]
        for course, loss in zip(self._losses, known, strict=True):
            course.append(loss)
        return all(converged(course, min_rel_improvement) for course in self._losses)

    def _exchange(self, losses: Tensor) -> list[float] | None:
        """The losses of the call before, None at the first; these ones are for the next."""
        before = self._read()
        self._waiting = torch.empty(losses.shape, dtype=losses.dtype, pin_memory=True)
        self._waiting.copy_(losses, non_blocking=True)
        self._copied = torch.cuda.Event()  # type: ignore[no-untyped-call]
        self._copied.record()
        return before

    def _read(self) -> list[float] | None:
        """The losses that the next call is for, once the device has computed them."""
        if self._copied is not None:
            self._copied.synchronize()
        return None if self._waiting is None else list(self._waiting.tolist())

    def state(self) -> dict[str, Any]:
        """What :meth:`load_state` takes, as plain data."""
        return {"losses": [list(course) for course in self._losses], "late": self._read()}

    def load_state(self, state: dict[str, Any]) -> None:
        """Go on with what :meth:`state` gave."""
        self.reset()
        self._losses = [list(course) for course in state["losses"]]
        self._waiting = None if state["late"] is None else torch.tensor(state["late"])
