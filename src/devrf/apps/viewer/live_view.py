"""The scene in a browser while a stage learns it."""

from __future__ import annotations

import time
from typing import Any

from lightning import Callback, LightningModule, Trainer

from devrf.apps.viewer.drawing import Drawing
from devrf.apps.viewer.session import Session
from devrf.callbacks.progress import in_one_line
from devrf.engine.schedule import share_done
from devrf.engine.stage import Stage
from devrf.rendering.renderer import Renderer
from devrf.scenes.scene import background_value

# Seconds between two pictures at least, however fast they are.
PAUSE = 0.2


class LiveView(Callback):
    """Renders a picture for those who watch, between iterations, as seldom as a share allows.

    Nothing is rendered while nobody has the page open. Learning is the same with and without, and
    no error of the viewer ends it.

    Attributes:
        seconds: of the rendering of the present stage's pictures.
    """

    def __init__(self, session: Session, share: float) -> None:
        """``share`` is the most of a stage's time that pictures may take."""
        self.session = session
        self.share = share
        self.seconds = 0.0
        self._began = self._last = 0.0

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Show this stage."""
        assert isinstance(pl_module, Stage)
        self.seconds = 0.0
        self._began = time.perf_counter()
        self._first = pl_module.position.iterations_done
        self._share = share_done(pl_module.schedule, pl_module.position.iteration)
        with self.session.surviving():
            background = background_value(pl_module.scene.background)
            self.session.present(Drawing(_renderer(pl_module), background))
            self.session.controls.tell(f"**{pl_module.name}** begins")

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Render a picture, if one is due."""
        assert isinstance(pl_module, Stage)
        scheduler = self.session.scheduler
        now = time.perf_counter()
        if scheduler is None or not scheduler.watched or now - self._last < PAUSE:
            return
        self._last = now
        controls = self.session.controls
        with self.session.surviving():
            seconds = now - self._began
            speed = (pl_module.position.iterations_done - self._first) / seconds
            share = share_done(pl_module.schedule, pl_module.position.iteration)
            pace = (share - self._share) / seconds
            line = in_one_line(outputs or {}, pl_module, speed, share, pace)
            controls.tell(f"**{pl_module.name}**: {line}")
        if self.seconds > self.share * (now - self._began):
            return
        with self.session.surviving():
            scheduler.drawing.renderer = _renderer(pl_module)
            frame = None if pl_module.phase is None else pl_module.phase.frame
            clock = pl_module.scene.clock
            controls.follow(None if frame is None else clock.times[frame])
            self.session.refresh()
            self.session.step(0.0)
        self._last = time.perf_counter()
        self.seconds += self._last - now

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Say that the stage has ended."""
        assert isinstance(pl_module, Stage)
        done = pl_module.position.iteration
        total = pl_module.schedule.total
        with self.session.surviving():
            self.session.controls.tell(
                f"**{pl_module.name}** has ended after {done} of {total} iterations. The picture "
                "stays as it is until another stage begins; `stage=view` shows a run that has "
                "ended."
            )


def _renderer(stage: Stage) -> Renderer:
    """Renders the present state of the scene; it has no views of before."""
    return Renderer(stage.current_model(), times=2, smooth=False)
