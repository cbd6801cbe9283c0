"""The PSNR of training batches over the iterations of a stage, drawn at its end."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from lightning import Callback, LightningModule, Trainer
from torch import Tensor

from devrf.callbacks.previews import Previews
from devrf.engine.stage import ScheduledStage

log = logging.getLogger(__name__)

# Steps whose values are read from the device at once.
AT_ONCE = 200


def batch_psnr(means: Mapping[str, Tensor]) -> Tensor | None:
    """PSNR () in dB of a step's batches; None where no loss is the error of colours.

    Args:
        means: the step's mean losses () by name; ``color`` or ``render`` is the mean squared
            error of pixels in [0, 1].
    """
    error = means.get("color", means.get("render"))
    return None if error is None else -10 * error.detach().clamp_min(1e-12).log10()


class TrainingCurve(Callback):
    """Draws ``training_<stage>.png``: the batches' PSNR of every step, and that of previews.

    Values are read from the device every 200 steps. A resumed stage's curve begins at its start.
    """

    def __init__(self, folder: str | Path = "images") -> None:
        """``folder``: gets the picture."""
        self.folder = Path(folder)
        self._forget()

    def _forget(self) -> None:
        self._points: list[tuple[int, float]] = []
        self._unread: list[tuple[int, Tensor]] = []
        self._grids: list[tuple[int, str]] = []

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Forget the stage before."""
        self._forget()

    def state_dict(self) -> dict[str, Any]:
        """The curve so far."""
        self._read()
        return {"points": list(self._points), "grids": list(self._grids)}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on with what :meth:`state_dict` gave."""
        self._points = [(int(k), float(value)) for k, value in state_dict["points"]]
        self._grids = [(int(k), str(shape)) for k, shape in state_dict["grids"]]

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Keep the step's PSNR, and the grid's size where it changes."""
        assert isinstance(pl_module, ScheduledStage)
        psnr, done = batch_psnr(outputs or {}), pl_module.iteration
        if psnr is None or not trainer.is_global_zero:
            return
        self._unread.append((done, psnr))
        shape = "x".join(map(str, pl_module.resolution))
        if shape != (self._grids[-1][1] if self._grids else ""):
            self._grids.append((done, shape))
        if len(self._unread) >= AT_ONCE:
            self._read()

    def _read(self) -> None:
        """Read what waits on the device; a step that was rolled back gives way to the later one."""
        if not self._unread:
            return
        values = torch.stack([value.float() for _, value in self._unread]).tolist()
        for (iteration, _), value in zip(self._unread, values, strict=True):
            while self._points and self._points[-1][0] >= iteration:
                self._points.pop()
            self._points.append((iteration, value))
        self._unread = []

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Draw the curve."""
        assert isinstance(pl_module, ScheduledStage)
        self._read()
        if not self._points:
            return
        # Only this hook draws with matplotlib.
        from devrf.apps.report.plots import write_training_curve

        callbacks: list[Callback] = trainer.callbacks  # type: ignore[attr-defined]
        previews = [point for one in callbacks if isinstance(one, Previews) for point in one.psnr]
        path = self.folder / f"training_{pl_module.name}.png"
        try:
            write_training_curve(path, pl_module.name, self._points, previews, self._grids)
        except OSError as error:  # a full disk must not cost what was learned
            log.warning("%s: %s; the curve is not drawn", path, error.strerror)
