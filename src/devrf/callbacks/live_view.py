"""The scene in a browser while a stage learns it."""

from __future__ import annotations

import logging
import time
from typing import Any

from lightning import Callback, LightningModule, Trainer

from devrf.apps.viewer.drawing import Drawing
from devrf.apps.viewer.session import Session
from devrf.engine.stage import ScheduledStage
from devrf.evaluation.held_out import background_value
from devrf.rendering.renderer import Renderer

log = logging.getLogger(__name__)

# Seconds between two pictures at least, however fast they are.
PAUSE = 0.2


class LiveView(Callback):
    """Renders a picture for those who watch, between iterations, as seldom as a share allows.

    Nothing is rendered while nobody has the page open, and learning is the same with and without.

    Attributes:
        seconds: what the pictures of the present stage have taken.
    """

    def __init__(self, session: Session, share: float) -> None:
        """``share`` is the most of a stage's time that pictures may take."""
        self.session, self.share = session, share
        self.seconds = 0.0
        self._began = self._last = 0.0

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Show this stage."""
        assert isinstance(pl_module, ScheduledStage)
        self.seconds, self._began = 0.0, time.perf_counter()
        self._drawing = Drawing(_renderer(pl_module), background_value(pl_module.scene.background))
        self.session.present(self._drawing)

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Render a picture, if one is due."""
        assert isinstance(pl_module, ScheduledStage)
        scheduler, now = self.session.scheduler, time.perf_counter()
        if scheduler is None or not scheduler.watched or now - self._last < PAUSE:
            return
        if self.seconds > self.share * (now - self._began):
            return
        self._drawing.renderer = _renderer(pl_module)
        scheduler.again()
        self.session.step(0.0)
        self._last = time.perf_counter()
        self.seconds += self._last - now

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Say what this stage's pictures have taken."""
        if self.seconds:
            passed = time.perf_counter() - self._began
            log.info("viewer: pictures took %.1f of %.1f s", self.seconds, passed)


def _renderer(stage: ScheduledStage) -> Renderer:
    """Renders what has been learned so far; it has no views of before."""
    return Renderer(stage.current_model(), times=2)
