"""Training PSNR of each frame in the end, and the frames that were lost."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from statistics import fmean, median
from typing import Any

import torch
from lightning import Callback, LightningModule, Trainer
from torch import Tensor

from devrf.engine.stage import Stage

log = logging.getLogger(__name__)

# A frame is lost if its images are fitted by so many dB less than those of the median frame.
LOST = 4.0
# Images of 8 bits are rounded by 59 dB: what is fitted so well has met the background alone.
BEST = 60.0


class FrameFit(Callback):
    """Measures each frame's training PSNR in its last visit, and names the frames that were lost.

    It is the PSNR of the mean error over the visit's batches: of the pixels that were learned from.
    A stage that learns all times at once has no such figures. Errors stay on the device until a
    progress file is written or the stage ends.
    """

    def __init__(self) -> None:
        self._forget()

    def _forget(self) -> None:
        # Kind of the phase, frame, and rollbacks, before which errors may be no numbers: a budget
        # changes the iterations of a visit on its way.
        self._visit: tuple[str, int | None, int] | None = None
        # Of each frame's last visit so far: the sum () of its batches' errors, and their number.
        self._errors: dict[int, tuple[Tensor, int]] = {}
        self._done = 0

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Forget the stage before."""
        self._forget()

    def state_dict(self) -> dict[str, Any]:
        """The errors so far."""
        return {"errors": {k: (float(total), n) for k, (total, n) in self._errors.items()}}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on with what :meth:`state_dict` gave."""
        self._errors = {
            int(frame): (torch.tensor(float(total)), int(batches))
            for frame, (total, batches) in state_dict["errors"].items()
        }

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Go on with the visit that was interrupted, if one was."""
        assert isinstance(pl_module, Stage)
        phase = pl_module.phase
        rollbacks = pl_module.position.num_rollbacks
        self._visit = None if phase is None else (phase.kind, phase.frame, rollbacks)

    def on_train_batch_start(
        self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int
    ) -> None:
        """Count the step's batches from here: the last step of a visit may have fewer."""
        assert isinstance(pl_module, Stage)
        self._done = pl_module.position.iterations_done

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Add the errors of the step's batches to those of the frame's visit."""
        assert isinstance(pl_module, Stage)
        phase = pl_module.phase
        error = (outputs or {}).get("render")
        if phase is None or phase.frame is None or error is None:
            return
        visit = (phase.kind, phase.frame, pl_module.position.num_rollbacks)
        if visit != self._visit:
            self._visit = visit
            self._errors.pop(phase.frame, None)
        total, batches = self._errors.get(phase.frame, (torch.zeros_like(error), 0))
        count = pl_module.position.iterations_done - self._done
        added = total.to(error.device) + count * error.detach()
        self._errors[phase.frame] = (added, batches + count)

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Add the figures to the stage's record; say which frames were lost."""
        assert isinstance(pl_module, Stage)
        psnr = self.psnr
        if not psnr:
            return
        frames = lost(psnr)
        pl_module.provenance.record |= {
            "lost_frames": len(frames),
            "frame_psnr": [round(value, 2) for _, value in sorted(psnr.items())],
        }
        if frames and trainer.is_global_zero:
            log.warning("%s: %s", pl_module.name, complaint(psnr, frames))

    @property
    def psnr(self) -> dict[int, float]:
        """The training PSNR in dB of each frame, in order; :data:`BEST` at most."""
        return {
            frame: min(-10 * math.log10(max(float(total) / batches, 1e-12)), BEST)
            for frame, (total, batches) in sorted(self._errors.items())
        }


def lost(psnr: Mapping[int, float]) -> list[int]:
    """The frames that are fitted by more than :data:`LOST` dB less than the median frame.

    Frames of which the last visit, of a few rays, met the background alone are not compared.
    """
    measured = {frame: value for frame, value in psnr.items() if value < BEST}
    middle = median(measured.values()) if measured else BEST
    return [frame for frame, value in measured.items() if value < middle - LOST]


def complaint(psnr: Mapping[int, float], frames: Sequence[int]) -> str:
    """``frames 20 to 35 fit worse than the rest: 25.0 dB, the others 37.0``."""
    worse = fmean(psnr[frame] for frame in frames)
    others = fmean(v for frame, v in psnr.items() if frame not in frames and v < BEST)
    noun, verb = ("frame", "fits") if len(frames) == 1 else ("frames", "fit")
    where = f"{noun} {in_ranges(frames)} {verb} worse than the rest"
    return f"{where}: {worse:.1f} dB, the others {others:.1f}"


def in_ranges(frames: Sequence[int]) -> str:
    """Ascending numbers in words: ``3, 5, 20 to 35``."""
    ends = [k for k, (a, b) in enumerate(pairwise(frames), start=1) if b != a + 1]
    runs = [frames[a:b] for a, b in pairwise([0, *ends, len(frames)])]
    return ", ".join(str(run[0]) if len(run) == 1 else f"{run[0]} to {run[-1]}" for run in runs)
