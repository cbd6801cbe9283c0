"""Notices when learning goes wrong, goes back once, then ends the stage."""

from __future__ import annotations

import logging
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
# Iterations between copies of what is trained, in a phase without end.
COPIED_EVERY = 1000
# Fewer iterations than these say nothing of what is seen.
TELLING = 20


class DivergenceGuard(Callback):
    """Looks every so often whether losses and fields are finite and anything is to be seen.

    Where they are not, what is trained is put back as it was when it was last well (at the
    latest when the phase began: for the deformation, when the frame was), and the stage goes on
    from there with lower learning rates and other pixels. If that happens again the stage
    ends, as it last was well. Of a frame whose loss stands out from its neighbours' it only
    tells. Frames that are visited together are looked at together, by their mean loss.

    Between looks nothing is read from the device.
    """

    def __init__(self, every_iterations: int = 100, rate_factor: float = 0.5) -> None:
        """Say how often to look, and how to go on.

        Args:
            every_iterations: between looks; one is also taken where a phase ends and before a
                progress file is written.
            rate_factor: what learning rates are multiplied by from a back-off on.
        """
        if every_iterations < 1 or not 0 < rate_factor <= 1:
            raise DevrfError(
                "callbacks.health: expected every_iterations of 1 or more and a rate_factor above "
                f"0, at most 1, not {every_iterations} and {rate_factor}"
            )
        self.every_iterations = every_iterations
        self.rate_factor = rate_factor
        self._forget()

    def _forget(self) -> None:
        self._steps: list[tuple[int, dict[str, Tensor]]] = []
        self._good: Snapshot | None = None
        self._checked = 0
        self._kind = ""
        self._range = [1.0, 0.0]
        self._visited: list[float] = []
        self._told = False

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Begin with another stage."""
        self._forget()

    def state_dict(self) -> dict[str, Any]:
        """What was seen so far, to compare with."""
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
        """Keep what is trained where a phase begins."""
        assert isinstance(pl_module, ScheduledStage)
        phase = pl_module.phase
        if phase is None or (self._good is not None and self._good.phase == phase):
            return
        self._good = None  # gone before the next is made
        self._good = Snapshot.of(pl_module)
        if phase.kind != self._kind:
            self._kind = phase.kind
            if phase.frames:
                self._visited = []  # losses differ from level to level
            else:
                self._range = [1.0, 0.0]  # a new field begins as fog

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Note what the step came to; look, when it is time."""
        assert isinstance(pl_module, ScheduledStage) and pl_module.phase is not None
        if outputs:
            self._steps.append((pl_module.iteration, outputs))
        done = pl_module.iteration
        ends = done >= min(pl_module.phase.stop, pl_module.total_iterations)
        if ends or done - self._checked >= self.every_iterations:
            self.check(pl_module)

    def check(self, stage: ScheduledStage) -> None:
        """See whether all is well; go back if not, or give up.

        Nothing is done where nothing was learned since the last look.
        """
        if not self._steps:
            return
        *steps, fields = read(stage, [means for _, means in self._steps])
        iterations = [iteration for iteration, _ in self._steps]
        since, self._checked = stage.iteration - self._checked, stage.iteration
        self._steps = []
        wrong = self._not_finite(stage, iterations, steps, fields)
        if wrong is None:
            wrong = self._collapsed(stage, steps, since)
        if wrong is not None:
            self._rollback(stage, wrong)
            return
        assert self._good is not None and stage.phase is not None
        if stage.iteration >= stage.phase.stop:
            # What holds the motion together differs widely from frame to frame.
            self._compare(stage, steps[-1].get("render", steps[-1]["loss"]))
        elif stage.iteration - self._good.iteration >= COPIED_EVERY:
            self._good = None
            self._good = Snapshot.of(stage)

    def _not_finite(
        self,
        stage: ScheduledStage,
        iterations: list[int],
        steps: list[dict[str, float]],
        fields: dict[str, float],
    ) -> str | None:
        """What is not finite, and where that was first seen, in words."""
        for iteration, means in zip(iterations, steps, strict=True):
            name = not_finite(means)
            if name is not None:
                kind = "the loss" if name == "loss" else f"the loss term {name}"
                return f"{kind} is {means[name]} by {stage.describe(iteration)}"
        name = not_finite(fields)
        return (
            None
            if name is None
            else (f"values of {name} are not finite by {stage.describe(stage.iteration)}")
        )

    def _collapsed(
        self, stage: ScheduledStage, steps: list[dict[str, float]], since: int
    ) -> str | None:
        """In words, that nothing is seen any more where something should be, or matter alone."""
        late = steps[len(steps) // 2 :]  # what went wrong since the last look is seen at this one
        seen = sum(means["opacity"] for means in late) / len(late)
        mattes = "coverage" in late[0]
        covered = sum(means["coverage"] for means in late) / len(late) if mattes else None
        least, most = self._range
        where = stage.describe(stage.iteration)
        if since >= TELLING:
            self._range = [min(least, seen), max(most, seen)]
            # Without mattes a scene may fill every picture, and what moves may leave it.
            if covered is not None and filled(seen, least, covered):
                return f"everything has become opaque by {where} ({BACKGROUND})"
            if emptied(seen, most, most if covered is None else covered):
                words = f"everything has become empty by {where} ({BACKGROUND})"
                if covered is not None or stage.name == "canonical":
                    return words
                self._tell(stage, words)
        if stage.iteration >= stage.total_iterations and seen < GONE * (covered or THERE):
            self._tell(stage, f"nothing is to be seen at the end ({BACKGROUND})")
        return None

    def _tell(self, stage: ScheduledStage, words: str) -> None:
        """Say something once in a stage."""
        if not self._told:
            log.warning("%s: %s", stage.name, words)
        self._told = True

    def _rollback(self, stage: ScheduledStage, wrong: str) -> None:
        """Put back what was well; the second time, end there."""
        assert self._good is not None
        again = stage.num_rollbacks > 0
        cautious = stage.lr_scale
        self._good.put_back(stage, self.rate_factor)
        self._checked = stage.iteration
        if not again:
            log.warning(
                "%s: %s: back to iteration %d, learning rates at %g of the schedule's",
                stage.name,
                wrong,
                stage.iteration,
                stage.lr_scale,
            )
            return
        stage.abort(
            f"{wrong}, again after learning rates were cut to {cautious:g}; what it was at "
            f"iteration {stage.iteration} is kept; lower {stage.rate_keys}, and begin afresh "
            "with resume=false"
        )

    def _compare(self, stage: ScheduledStage, loss: float) -> None:
        """Tell of a frame that ends with a loss out of its neighbours' range."""
        if stage.phase is None or not stage.phase.frames:
            return
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
