"""A stage: a part of training that follows a schedule, run by Lightning.

What is learned in each phase is defined by a subclass (:mod:`devrf.engine.learner`); how an
iteration is carried out is in :mod:`devrf.engine.loop`.
"""

from __future__ import annotations

import math
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lightning.pytorch.core.optimizer import LightningOptimizer
from torch import Tensor

from devrf.checkpoints.checkpoint import (
    MODEL,
    CheckpointMetadata,
    LoadedCheckpoint,
    TrainingFigures,
    Viewpoints,
    check_scene,
    metadata_in,
)
from devrf.checkpoints.progress import rng_state, set_rng_state
from devrf.checkpoints.stored_class import class_path
from devrf.data.batch import background_color
from devrf.engine.ddp import assert_replicas_equal, broadcast, check_strategy
from devrf.engine.learner import Learner
from devrf.engine.loop import Loop
from devrf.errors import DevrfError
from devrf.evaluation.held_out import score
from devrf.ops.adam import GridAdam
from devrf.rendering.renderer import Renderer
from devrf.system.memory import OutOfMemoryError

# Attributes of a stage that a progress file holds by name: where it is in its schedule.
POSITION = ("iteration", "skipped", "seed", "num_rollbacks", "lr_scale")


class ScheduledStage(Learner):
    """A stage whose schedule says what each iteration learns.

    One Lightning step runs several optimiser iterations, so that Lightning's overhead is
    negligible. The callback ``GridUpscaling`` calls :meth:`enter` at the beginning of each phase;
    ``LearningRateDecay`` sets the learning rates before each optimiser step.

    Attributes:
        iteration: position in the schedule: optimiser iterations done or skipped.
        skipped: iterations left out because a phase had converged, or for want of time; below 0
            where a time budget has them done more than once.
        stride: how far an optimiser iteration goes in the schedule; other than 1 under a
            ``TimeBudget``.
        time_share: the part of the whole method's seconds that is this stage's.
        began: when the stage was set up, by ``time.perf_counter``.
        record: what training took, once a ``TrainingRecord`` callback has measured it.
        earlier_records: the same for the stages that this one builds on, by name.
        seed: of the generator, whose state at the beginning of a Lightning step follows from the
            seed, the process, the iteration and the number of rollbacks.
        training_config: the settings that decide what is learned, by config key; empty for a
            stage that was not built from a config.
        earlier_configs: the same of the stages that this one builds on, by name.
        command: what the command chose and set that learns, as its checkpoints hold it.
        protocol: the name of the protocol that the stage is a part of, if any.
        num_rollbacks: how often training diverged and was rolled back.
        lr_scale: factor of the scheduled learning rates; below 1 after a rollback.
        has_scheduled_rates: whether a ``LearningRateDecay`` sets the learning rates.
        abort_reason: why the stage ended before its schedule; None while it has not.
        loop: carries the iterations out.
    """

    def __init__(self, iterations_per_step: int) -> None:
        super().__init__()
        self.automatic_optimization = False
        self.loop = Loop()
        self.iterations_per_step = iterations_per_step
        self.iteration = self.skipped = self.seed = self.num_rollbacks = 0
        self.stride, self.time_share, self.began = 1.0, 1.0, 0.0
        self.phase = None
        self.record: TrainingFigures = {}
        self.earlier_records: dict[str, TrainingFigures] = {}
        self.generator = torch.Generator()
        self.training_config: dict[str, Any] = {}
        self.earlier_configs: dict[str, dict[str, Any]] = {}
        self.command: dict[str, Any] = {}
        self.protocol: str | None = None
        self.lr_scale = 1.0
        self.has_scheduled_rates = False
        self.abort_reason: str | None = None
        # How far the last iteration went, and what it went less than its stride.
        self._advance, self._owed = 1, 0.0
        self._plain_background: Tensor | None = None
        self._progress: dict[str, Any] | None = None
        self._finished: dict[str, Any] | None = None

    def background(self, image: Tensor) -> Tensor:
        """What is behind the pixels of ``image`` (R,): (3,), always the same tensor, if plain.

        Else (R, 3), drawn with ``generator``.
        """
        plain = self._plain_background
        if plain is None or plain.device != image.device:
            name = self.scene.background
            if name == "random":
                return background_color(name, len(image), self.generator)
            plain = background_color(name, 0, self.generator).to(image.device)
            self._plain_background = plain
        return plain

    @property
    def iterations_done(self) -> int:
        """Optimiser iterations that were carried out."""
        return self.iteration - self.skipped

    @property
    def position(self) -> float:
        """Where a time budget has the stage in its schedule; ``iteration`` follows by phases."""
        return self.iteration + self._owed

    @property
    def turn(self) -> int:
        """Counts iterations for what takes turns in them; under a time budget those done."""
        return self.iteration if self.stride == 1 else self.iterations_done

    def passes(self, every: int, start: int) -> bool:
        """Whether this iteration is the first at or beyond a multiple of ``every`` after ``start``.

        A multiple that a time budget leaves out counts, and one at which it stays counts once.
        """
        since = self.iteration - start
        return since // every > max(since - self._advance, 0) // every

    def metadata(self) -> CheckpointMetadata:
        """The metadata of a checkpoint of this stage."""
        model = self.scene_model
        return CheckpointMetadata(
            scene=self.scene.name,
            fingerprint=self.scene.fingerprint,
            stage=self.name,
            model={"class": class_path(type(model)), **model.config()},
            protocol=self.protocol,
            records={**self.earlier_records, self.name: self.record},
            training_config=self.training_config,
            earlier_configs=self.earlier_configs,
            command=self.command,
            complete=self.iteration >= self.total_iterations,
            moves=self.scene.moves,
        )

    def result(self) -> LoadedCheckpoint:
        """What a stage that builds on this one takes."""
        return LoadedCheckpoint(self.metadata(), self.scene_model)

    def abort(self, why: str) -> None:
        """End the stage after the present step; the fit then raises an error that says ``why``."""
        self.abort_reason = f"{self.name} stage: {why}"
        self.trainer.should_stop = True

    def rollback(self, iteration: int, skipped: int, lr_scale: float) -> None:
        """Continue from an earlier iteration of the present phase, whose tensors are back in place.

        Adam's state starts afresh, and other pixels are drawn than the first time.

        Args:
            iteration: where to continue.
            skipped: iterations that had been left out there.
            lr_scale: further factor of all learning rates from now on.
        """
        self.iteration, self.skipped, self._owed = iteration, skipped, 0.0
        self.num_rollbacks += 1
        self.lr_scale *= lr_scale
        self.optimizer.forget()
        self._reseed()
        self.trainer.should_stop = False

    # Lightning's hooks, in the order in which they are called.

    def setup(self, stage: str) -> None:
        """Check the trainer and make the generator.

        Raises:
            DevrfError: the precision is not 32 bit, or several processes run with a strategy that
                does not support growing grids.
        """
        if self.trainer.precision != "32-true":
            raise DevrfError(
                f"trainer.precision: expected 32-true, not {self.trainer.precision}: positions "
                "need all their digits; decoder_precision=bfloat16 takes fewer for colours alone"
            )
        check_strategy(self.trainer)
        self.began = time.perf_counter()
        self.seed = torch.initial_seed()
        # Lightning moves the stage to this device later.
        self.generator = torch.Generator(self.trainer.strategy.root_device)

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Restore the position in the schedule and the tensors' shapes; tensors are loaded next.

        What else a progress file holds is restored once they are: ``phase_state`` when the
        optimiser is configured, ``random`` when training starts.

        Raises:
            DevrfError: the checkpoint is of another scene, stage or schedule.
        """
        path = Path(str(self.trainer.ckpt_path))
        check_scene(path, metadata_in(path, checkpoint), self.scene)
        self.resize_to(checkpoint["state_dict"])
        self._progress = progress = checkpoint.get("progress")
        if progress is None:
            return
        if (progress["stage"], progress["total"]) != (self.name, self.total_iterations):
            raise DevrfError(
                f"{path}: left by the {progress['stage']} stage on a schedule of "
                f"{progress['total']} iterations, this is the {self.name} stage on one of "
                f"{self.total_iterations}; give it its own schedule"
            )
        for name in POSITION:
            setattr(self, name, progress[name])
        # A schedule is one epoch of a loader that never ends: what ended it there (max_time,
        # limit_train_batches, fast_dev_run) has not ended it here.
        fit = checkpoint["loops"]["fit_loop"]
        for epochs in ("total", "current"):
            fit["epoch_progress"][epochs].update(processed=0, completed=0)
        fit["epoch_loop.batch_progress"]["is_last_batch"] = False
        self.loop.micro_batching.count = progress["micro_batches"]
        self.phase = None if progress["phase"] is None else self.phase_at(progress["phase"])

    def configure_optimizers(self) -> GridAdam:
        """The optimiser; in a resumed run with the parameters of the phase that was left."""
        if self._progress is not None and self.phase is not None:
            self.restore(self.phase, self._progress["phase_state"])
        return self.optimizer

    def on_fit_start(self) -> None:
        """Give every process the same tensors."""
        self._finished = None
        broadcast([*self.parameters(), *self.buffers()])

    def on_train_start(self) -> None:
        """Restore the random state last, when nothing but iterations draws from it any more."""
        if self._progress is not None:
            set_rng_state(self._progress["random"], self.device)
            self._progress = None
        self._reseed()

    def training_step(self, views: Any, batch_idx: int) -> dict[str, Tensor]:
        """Run up to ``iterations_per_step`` iterations, all of the present phase.

        Returns:
            Means () of the loss and of its terms by name, over these iterations;
            empty if memory ran out in the first.
        """
        if self.phase != self.phase_at(self.iteration):
            raise DevrfError(
                f"{type(self).__name__}: the phase of iteration {self.iteration} was not "
                "entered: add devrf.callbacks.GridUpscaling to the trainer's callbacks"
            )
        if not self.has_scheduled_rates:
            raise DevrfError(
                f"{type(self).__name__}: the learning rates of its schedule are not set: add "
                "devrf.callbacks.LearningRateDecay to the trainer's callbacks"
            )
        assert self.phase is not None
        before, stop = self.iterations_done, min(self.phase.stop, self.total_iterations)
        self._iterate(views, stop)
        means: dict[str, Tensor] = {}
        if done := self.iterations_done - before:
            means = self.loop.metrics.take(done, self.loop.processes)
            if self.iteration < stop and self.converged(means["loss"]):
                self.skipped += stop - self.iteration
                self.iteration = stop
        self._reseed()
        if self.iteration >= self.total_iterations:
            self.trainer.should_stop = True
        return means

    def _iterate(self, views: Any, stop: int) -> None:
        """Run a step's iterations, up to ``stop``; abort if memory runs out."""
        optimizer = self.optimizers()
        assert isinstance(optimizer, LightningOptimizer)
        count = self.iterations_per_step
        if self.trainer.max_steps > 0:
            count = min(count, self.trainer.max_steps - self.trainer.global_step)
        for _ in range(count):
            if self.iteration >= stop:
                return
            self.prepare()
            try:
                self.loop.step(self, views, optimizer)
            except OutOfMemoryError as shortage:
                lower = " or ".join(self.memory_keys)
                self.abort(
                    f"{shortage} at {self.describe(self.iteration)}; the same command goes on "
                    "where there is more memory; with less, begin afresh (resume=false) with "
                    f"{f'lower {lower}, or ' if lower else ''}higher data.downscale"
                )
                return
            self._go_on(stop)

    def _go_on(self, stop: int) -> None:
        """Advance by the stride, to ``stop`` at most; the next phase is owed what is missing."""
        position = self.position + self.stride
        self._advance = min(math.floor(position), stop) - self.iteration
        self.iteration += self._advance
        self.skipped += self._advance - 1
        self._owed = min(position - self.iteration, max(self.stride, 1.0))

    def _reseed(self) -> None:
        """Seed the generator for the next step, differently in each process."""
        mixed = np.random.SeedSequence([self.seed, self.global_rank, self.turn, self.num_rollbacks])
        self.generator.manual_seed(int(mixed.generate_state(1, np.uint64)[0]))

    def on_train_end(self) -> None:
        """Pack what was learned while it is on its GPU: Lightning moves the stage to the host."""
        if (
            self.device.type == "cuda"
            and self.iteration >= self.total_iterations
            and self.global_rank == 0
        ):
            self._finished = self.current_model().stored_state()

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add the state that is not in tensors.

        Without the optimiser's state a checkpoint is for rendering, not for resuming.
        """
        checkpoint["devrf"] = asdict(self.metadata())
        checkpoint["viewpoints"] = asdict(Viewpoints.of(self.scene))
        if "optimizer_states" in checkpoint:
            checkpoint["progress"] = {
                "stage": self.name,
                "total": self.total_iterations,
                **{name: getattr(self, name) for name in POSITION},
                "phase": None if self.phase is None else self.phase.start,
                "phase_state": {} if self.phase is None else self.phase_state(),
                "random": rng_state(self.device),
                "micro_batches": self.loop.micro_batching.count,
            }
        elif self.iteration >= self.total_iterations:
            compact = self._finished or self.current_model().stored_state()
            checkpoint["state_dict"] = {f"{MODEL}{k}": v for k, v in compact.items()}

    def on_fit_end(self) -> None:
        """Check the result.

        Raises:
            DevrfError: the stage was aborted, or the processes hold different tensors.
        """
        if self.abort_reason is not None:
            raise DevrfError(self.abort_reason)
        if self.iteration >= self.total_iterations:
            state = self.state_dict().items()
            assert_replicas_equal({name: t for name, t in state if isinstance(t, Tensor)})

    def test_step(self, index: int, batch_idx: int) -> dict[str, Any]:
        """Render and score one held-out image; the means over all images are logged.

        Returns:
            ``view``: the :class:`~devrf.evaluation.held_out.HeldOutView`, for callbacks.
        """
        views = self.scene.capture(self.scored_capture).test
        renderer = Renderer(self.current_model())
        view = score(renderer, views, index, self.scene.background)
        scores = {"psnr": view.psnr, "ssim": view.ssim, "rest_pose_psnr": view.rest_pose_psnr}
        means = {f"test/{self.scored_capture}/{k}": v for k, v in scores.items()}
        self.log_dict(means, batch_size=1, sync_dist=True)
        return {"view": view}
