"""Notices divergence, rolls back once, then ends the stage."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from statistics import mean
from typing import Any

from lightning import Callback, LightningModule, Trainer
from torch import Tensor

from devrf.callbacks.divergence import (
    GONE,
    THERE,
    Snapshot,
    emptied,
    filled,
    not_finite,
    read,
    stands_out,
)
from devrf.engine.stage import ScheduledStage
from devrf.errors import DevrfError

log = logging.getLogger(__name__)

BACKGROUND = "is data.background that of the images, data.box around what they show?"
# Iterations between snapshots in a long phase.
SNAPSHOT_EVERY = 1000
# The fewest iterations between checks that allow a judgement of opacity.
TELLING = 20


class DivergenceGuard(Callback):
    """Checks every so often that losses and fields are finite and that something can be seen.

    If not, the stage returns to its last good snapshot (at the latest of the phase's start; for
    the deformation, of the frame's) and goes on with lower learning rates and other pixels. The
    second time the stage ends in that state. A frame whose loss is an outlier is only logged.
    Parallel frames are judged by their mean loss.

    Nothing is read from the device between checks.
    """

    def __init__(self, every_iterations: int = 100, rate_factor: float = 0.5) -> None:
        """Say how often to check, and how to go on.

        Args:
            every_iterations: between checks; there is also one where a phase ends and before a
                progress file is written.
            rate_factor: what learning rates are multiplied by after a rollback.
        """
        if every_iterations < 1 or not 0 < rate_factor <= 1:
            raise DevrfError(
                "callbacks.health: expected every_iterations of 1 or more and a rate_factor above "
                f"0, at most 1, not {every_iterations} and {rate_factor}"
            )
        self.every_iterations = every_iterations
        self.rate_factor = rate_factor
        self._reset()

    def _reset(self) -> None:
        self._steps: list[tuple[int, dict[str, Tensor]]] = []
        self._good: Snapshot | None = None
        self._checked = 0
        self._kind = ""
        self._range = [1.0, 0.0]
        self._visited: list[float] = []
        self._told = False

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Forget the stage before."""
        self._reset()

    def state_dict(self) -> dict[str, Any]:
        """What later checks compare with."""
        return {
            "kind": self._kind,
            "range": list(self._range),
            "visited": list(self._visited),
            "told": self._told,
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Compare with what :meth:`state_dict` gave."""
        self._kind, self._range = state_dict["kind"], list(state_dict["range"])
        self._visited, self._told = list(state_dict["visited"]), state_dict["told"]

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Count from here."""
        assert isinstance(pl_module, ScheduledStage)
        self._checked = pl_module.iteration

    def on_train_batch_start(
        self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int
    ) -> None:
        """Take a snapshot where a phase begins."""
        assert isinstance(pl_module, ScheduledStage)
        phase = pl_module.phase
        if phase is None or (self._good is not None and self._good.phase == phase):
            return
        self._snapshot(pl_module)
        if phase.kind != self._kind:
            self._kind = phase.kind
            if phase.frames:
                self._visited = []  # losses differ from level to level
            else:
                self._range = [1.0, 0.0]  # a new field begins as fog

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Keep the step's losses; check, if it is due."""
        assert isinstance(pl_module, ScheduledStage) and pl_module.phase is not None
        done = pl_module.iteration
        if outputs:
            self._steps.append((done, outputs))
        ends = done >= min(pl_module.phase.stop, pl_module.total_iterations)
        if ends or done - self._checked >= self.every_iterations:
            self.check(pl_module)

    def check(self, stage: ScheduledStage) -> None:
        """Roll the stage back, or end it, if it has diverged since the last check."""
        if not self._steps:
            return
        *steps, fields = read(stage, [means for _, means in self._steps])
        iterations = [iteration for iteration, _ in self._steps]
        since, self._checked = stage.iteration - self._checked, stage.iteration
        self._steps = []
        wrong = self._not_finite(stage, iterations, steps, fields)
        wrong = wrong or self._collapsed(stage, steps, since)
        if wrong is not None:
            self._rollback(stage, wrong)
            return
        assert self._good is not None and stage.phase is not None
        if stage.iteration >= stage.phase.stop:
            if stage.phase.frames:
                # Regularisers differ widely from frame to frame; the rendering loss does not.
                self._compare(stage, steps[-1].get("render", steps[-1]["loss"]))
        elif stage.iteration - self._good.iteration >= SNAPSHOT_EVERY:
            self._snapshot(stage)

    def _snapshot(self, stage: ScheduledStage) -> None:
        self._good = None  # its memory is free before the next takes as much
        self._good = Snapshot.of(stage)

    def _not_finite(
        self,
        stage: ScheduledStage,
        iterations: Sequence[int],
        steps: Sequence[dict[str, float]],
        fields: dict[str, float],
    ) -> str | None:
        """What is not finite, and where that was first seen, in words."""
        for iteration, means in zip(iterations, steps, strict=True):
            if name := not_finite(means):
                kind = "the loss" if name == "loss" else f"the loss term {name}"
                return f"{kind} is {means[name]} by {stage.describe(iteration)}"
        if name := not_finite(fields):
            return f"values of {name} are not finite by {stage.describe(stage.iteration)}"
        return None

    def _collapsed(
        self, stage: ScheduledStage, steps: Sequence[dict[str, float]], since: int
    ) -> str | None:
        """In words, that everything has become empty or opaque."""
        late = steps[len(steps) // 2 :]
        seen = mean(means["opacity"] for means in late)
        # Only alpha masks say what should be seen.
        covered = mean(means["coverage"] for means in late) if "coverage" in late[0] else None
        least, most = self._range
        where = f"{stage.describe(stage.iteration)} ({BACKGROUND})"
        if since >= TELLING:
            self._range = [min(least, seen), max(most, seen)]
            if covered is not None and filled(seen, least, covered):
                return f"everything has become opaque by {where}"
            if emptied(seen, most, most if covered is None else covered):
                words = f"everything has become empty by {where}"
                if covered is not None or stage.name == "canonical":
                    return words
                self._warn_once(stage, words)  # what moves may have left the picture
        if stage.iteration >= stage.total_iterations and seen < GONE * (covered or THERE):
            self._warn_once(stage, f"nothing is to be seen at the end ({BACKGROUND})")
        return None

    def _warn_once(self, stage: ScheduledStage, words: str) -> None:
        if not self._told:
            log.warning("%s: %s", stage.name, words)
        self._told = True

    def _rollback(self, stage: ScheduledStage, wrong: str) -> None:
        """Restore the last good state; the second time, end there."""
        assert self._good is not None
        again, scale = stage.num_rollbacks > 0, stage.lr_scale
        self._good.restore(stage, self.rate_factor)
        self._checked = stage.iteration
        if again:
            stage.abort(
                f"{wrong}, again after learning rates were cut to {scale:g}; what it was at "
                f"iteration {stage.iteration} is kept; lower {stage.rate_keys}, and begin afresh "
                "with resume=false"
            )
            return
        log.warning(
            "%s: %s: back to iteration %d, learning rates at %g of the schedule's",
            stage.name,
            wrong,
            stage.iteration,
            stage.lr_scale,
        )

    def _compare(self, stage: ScheduledStage, loss: float) -> None:
        """Log a frame that ends with an outlying loss."""
        factor = stands_out(loss, self._visited)
        if factor is not None:
            log.warning(
                "%s: the rendering loss is %.3g by %s, %.1f times that of the frames before; are "
                "its images and its flow as they should be?",
                stage.name,
                loss,
                stage.describe(stage.iteration),
                factor,
            )
        self._visited.append(loss)
