"""A stage's curve as a picture, drawn at its end."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import torch
from lightning import Callback, LightningModule, Trainer
from matplotlib.figure import Figure
from torch import Tensor

from devrf.callbacks.previews import Previews
from devrf.engine.stage import Stage
from devrf.pictures.figures import STYLE, write_figure

log = logging.getLogger(__name__)

# Steps whose values are read from the device at once.
AT_ONCE = 200
BATCHES = "#9ec9e6"
MEAN = "#0072b2"
VALIDATED = "#d55e00"
# The running mean is over this share of the curve.
WINDOW = 1 / 25
# More labels of grids would overlap.
MOST_GRIDS = 8


class TrainingCurve(Callback):
    """Draws ``training_<stage>.png``: the batches' PSNR of every step, and that of validated views.

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
        assert isinstance(pl_module, Stage)
        psnr = (outputs or {}).get("psnr")
        done = pl_module.position.iterations_done
        if psnr is None or not trainer.is_global_zero:
            return
        self._unread.append((done, psnr))
        shape = "x".join(map(str, pl_module.scene_model.resolution))
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

    def on_fit_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Draw the curve, in one process; the stage's seconds have been taken."""
        assert isinstance(pl_module, Stage)
        self._read()
        # A resumed run gives every process the points so far.
        leads = trainer.is_global_zero
        if not self._points or not leads or trainer.fast_dev_run:  # type: ignore[attr-defined]
            return
        callbacks: list[Callback] = trainer.callbacks  # type: ignore[attr-defined]
        looks = [p for other in callbacks if isinstance(other, Previews) for p in other.psnr]
        path = self.folder / f"training_{pl_module.name}.png"
        frames = pl_module.provenance.record.get("frame_psnr") or []  # of a FrameFit
        assert isinstance(frames, list)
        try:
            write_training_curve(path, pl_module.name, self._points, looks, self._grids, frames)
        except OSError as error:  # a full disk must not cost what was learned
            log.warning("%s: %s; the curve is not drawn", path, error.strerror)


@mpl.rc_context(STYLE)
def write_training_curve(
    path: Path,
    stage: str,
    batches: Sequence[tuple[int, float]],
    validated: Sequence[tuple[int, float]] = (),
    grids: Sequence[tuple[int, str]] = (),
    frames: Sequence[float] = (),
) -> None:
    """Plot (iteration, PSNR in dB) of at least one training batch, and write it as a PNG.

    ``validated`` are the same of a held-out view; at iterations of ``grids`` the grid took that
    size. ``frames`` is the training PSNR of frames 1, 2, … in their last visit: a second plot.
    """
    import pandas as pd  # slow: commands that draw no curve do without it

    panels = 2 if frames else 1
    figure = Figure(figsize=(8.0, 4.2 * panels), dpi=120, layout="constrained")
    axes = figure.subplots(panels, squeeze=False)[0, 0]
    curve = pd.Series(dict(batches), dtype=float)
    mean = curve.rolling(max(1, round(WINDOW * len(curve))), min_periods=1).mean()
    axes.plot(curve.index, curve, color=BATCHES, linewidth=0.9, label="batches")
    axes.plot(mean.index, mean, color=MEAN, linewidth=1.8, label="running mean")
    if validated:
        iterations, psnr = zip(*validated, strict=True)
        axes.plot(iterations, psnr, "o", color=VALIDATED, label="held-out view")
    if 1 < len(grids) <= MOST_GRIDS:
        for iteration, shape in grids:
            axes.axvline(iteration, color="0.75", linewidth=0.8, linestyle=":")
            axes.text(iteration, 1, f" {shape}", transform=axes.get_xaxis_transform(), color="0.4")
    axes.set(xlabel="iteration", ylabel="PSNR (dB)")
    axes.set_title(f"{stage}: PSNR of the training batches", loc="left", pad=20)
    if frames:
        figure.axes[1].plot(range(1, len(frames) + 1), frames, ".-", color=MEAN)
        figure.axes[1].set(xlabel="frame", ylabel="PSNR (dB)")
        figure.axes[1].set_title("the last visit of each frame", loc="left")
    axes.legend(loc="lower right", ncols=3)
    write_figure(path, figure)
