"""Curves and pictures of a stage while it learns: for loggers, and drawn at its end."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from lightning import Callback, LightningModule, Trainer
from torch import Tensor

from devrf.apps.records import peak_host_memory
from devrf.apps.still import preview
from devrf.apps.trackers import trackers
from devrf.engine.stage import Stage
from devrf.system.device import arriving

log = logging.getLogger(__name__)

Numbers = dict[str, float]

# Steps whose values are read from the device at once.
AT_ONCE = 200


def batch_error(means: Mapping[str, Tensor]) -> Tensor | None:
    """Mean squared error () of a step's pixels, in [0, 1]; None where no loss is that.

    Args:
        means: the step's mean losses () by name; ``color`` or ``render`` is that error.
    """
    return means.get("color", means.get("render"))


def batch_psnr(means: Mapping[str, Tensor]) -> Tensor | None:
    """PSNR () in dB of a step's batches; None where no loss is the error of colours."""
    error = batch_error(means)
    return None if error is None else -10 * error.detach().clamp_min(1e-12).log10()


class Meter(Callback):
    """Logs losses, the batches' PSNR, learning rates, speed, resolution and memory.

    A row is written when the next is due, or a progress file: a GPU goes on learning meanwhile.

    Attributes:
        row: the row that was written last.
    """

    def __init__(self) -> None:
        self.row: Numbers = {}
        self._last = (0.0, 0)
        # Of the row to come: its trainer, capture, iteration, numbers, and those on their way.
        self._begun: tuple[Trainer, str, int, Numbers, Callable[[], Numbers]] | None = None

    def state_dict(self) -> dict[str, Any]:
        """Nothing; but a run that is resumed needs the rows before."""
        self._flush()
        return {}

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Start the clock."""
        assert isinstance(pl_module, Stage)
        self._last = (time.perf_counter(), pl_module.iteration)

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Begin a row every ``log_every_n_steps`` steps; nothing waits for the device."""
        assert isinstance(pl_module, Stage)
        every: int = trainer.log_every_n_steps  # type: ignore[attr-defined]
        if not (trainer.should_stop or (every > 0 and (batch_idx + 1) % every == 0)):
            return
        now = time.perf_counter()
        done = pl_module.iteration
        since, before = self._last
        self._last = (now, done)
        values = {"iterations_per_second": (done - before) / (now - since)}
        if (peak := peak_host_memory()) is not None:
            values["peak_host_gb"] = peak
        if pl_module.resolution:
            values["voxels"] = math.prod(pl_module.resolution)
        for group in pl_module.optimizer.param_groups:
            values[f"lr/{group['name']}"] = group["lr"]
        if pl_module.phase is not None and pl_module.phase.frame is not None:
            values["frame"] = pl_module.phase.frame
        if pl_module.device.type == "cuda":
            values["peak_gpu_gb"] = torch.cuda.max_memory_allocated(pl_module.device) / 2**30
        means = outputs or {}
        psnr = batch_psnr(outputs or {})
        read = arriving(means if psnr is None else {**means, "psnr": psnr})
        self._flush()
        self._begun = trainer, pl_module.capture, done, values, read

    def _flush(self) -> None:
        """Write the row that was begun."""
        if self._begun is None:
            return
        trainer, capture, iteration, values, read = self._begun
        self._begun = None
        self.row = {f"{capture}/{name}": value for name, value in {**read(), **values}.items()}
        for logger in trainer.loggers:
            logger.log_metrics(self.row, iteration)

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Write the last row."""
        self._flush()

    def on_exception(
        self, trainer: Trainer, pl_module: LightningModule, exception: BaseException
    ) -> None:
        """Write the row that waits."""
        self._flush()


class Previews(Callback):
    """Shows the held-out view in the middle of the recording, where a logger takes pictures.

    Attributes:
        seconds: what the pictures of the present stage have taken.
        psnr: (iteration, dB) of the pictures of the present stage.
    """

    def __init__(self, times: int = 6) -> None:
        """``times``: pictures of each stage, evenly spread, the last at its end."""
        self.times = times
        self.seconds = 0.0
        self.psnr: list[tuple[int, float]] = []
        self._shown = 0

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Forget the stage before."""
        self.psnr = []

    def state_dict(self) -> dict[str, Any]:
        """The PSNR of the pictures so far."""
        return {"psnr": list(self.psnr)}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on with what :meth:`state_dict` gave."""
        self.psnr = [(int(k), float(value)) for k, value in state_dict["psnr"]]

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Begin to count."""
        assert isinstance(pl_module, Stage)
        self.seconds = 0.0
        self._shown = self._due(pl_module)

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Show the view, if a picture is due."""
        assert isinstance(pl_module, Stage)
        due = self._due(pl_module)
        if due == self._shown or not trainer.is_global_zero:
            return
        self._shown = due
        started = time.perf_counter()
        if watching := trackers(trainer.loggers):
            views = pl_module.scene.capture(pl_module.scored_capture).test
            scored = preview(
                pl_module.current_model(), views, len(views) // 2, pl_module.scene.background
            )
            done = pl_module.iteration
            capture = pl_module.capture
            self.psnr = [point for point in self.psnr if point[0] < done] + [(done, scored.psnr)]
            for tracker in watching:
                for name, image in scored.images.items():
                    tracker.show_image(f"{capture}/{name}", image, done)
            for logger in trainer.loggers:
                logger.log_metrics({f"{capture}/held_out_psnr": scored.psnr}, done)
        self.seconds += time.perf_counter() - started

    def _due(self, stage: Stage) -> int:
        return stage.iteration * self.times // stage.total_iterations


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
        assert isinstance(pl_module, Stage)
        psnr = batch_psnr(outputs or {})
        done = pl_module.iteration
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

    def on_fit_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Draw the curve, in one process; the stage's seconds have been taken."""
        assert isinstance(pl_module, Stage)
        self._read()
        # A resumed run gives every process the points so far.
        leads = trainer.is_global_zero
        if not self._points or not leads or trainer.fast_dev_run:  # type: ignore[attr-defined]
            return
        # Only this hook draws with matplotlib.
        from devrf.apps.report.plots import write_training_curve

        callbacks: list[Callback] = trainer.callbacks  # type: ignore[attr-defined]
        previews = [
            point for other in callbacks if isinstance(other, Previews) for point in other.psnr
        ]
        path = self.folder / f"training_{pl_module.name}.png"
        frames = pl_module.record.get("frame_psnr") or []  # of a FrameFit
        assert isinstance(frames, list)
        try:
            write_training_curve(path, pl_module.name, self._points, previews, self._grids, frames)
        except OSError as error:  # a full disk must not cost what was learned
            log.warning("%s: %s; the curve is not drawn", path, error.strerror)
