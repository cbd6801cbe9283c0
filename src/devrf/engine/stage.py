"""What all stages share: a loop that follows a schedule, and held-out views that are scored."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar, Literal, Protocol

import numpy as np
import torch
from lightning import LightningModule
from lightning.pytorch.core.optimizer import LightningOptimizer
from torch import Tensor

from devrf.checkpoints.checkpoint import CheckpointMetadata
from devrf.checkpoints.progress import set_rng_state
from devrf.data.batch import Pixels
from devrf.engine import resume
from devrf.engine.ddp import ManualDDP, assert_replicas_equal, broadcast, rank
from devrf.engine.graphs import Graphs
from devrf.engine.loop import Loop
from devrf.engine.parallel_batch import ParallelBatch
from devrf.engine.phase import Phase, in_words
from devrf.errors import DevrfError
from devrf.evaluation.held_out import score
from devrf.ops.adam import GridAdam
from devrf.rendering.renderer import Renderer
from devrf.rendering.view import Viewable
from devrf.scenes.scene import CaptureName, Scene
from devrf.system.out_of_memory import OutOfMemoryError


class LearnedModel(Viewable, Protocol):
    """What a stage learns: a :class:`~devrf.methods.base.DynamicModel`."""

    def config(self) -> dict[str, Any]:
        """Plain data to build it from."""
        ...

    def stored_state(self) -> dict[str, Any]:
        """The state for a finished checkpoint."""
        ...


class ScheduledStage(LightningModule, ABC):
    """A stage whose schedule says what each iteration learns.

    One Lightning step covers several optimiser iterations, so that the framework's own work
    does not show. The stage never changes its grids by itself: the callback ``GridUpscaling``
    calls :meth:`enter` where a phase begins, ``LearningRateDecay`` scales the learning rates
    before every step.

    What an iteration is, and how it is carried out, is the business of
    :class:`~devrf.engine.loop.Loop`. Callbacks see the same steps and the same rates however an
    iteration is run.

    A checkpoint with the optimiser's state in it (any of Lightning's that is not ``weights_only``)
    holds all that it takes to go on: ``Trainer.fit(ckpt_path=…)`` continues as if the run had
    never stopped (:mod:`devrf.engine.resume`).

    Attributes:
        name: what the stage is called in files, messages and protocols.
        capture: the part of the scene that is learned from.
        scene_model: what is learned.
        iteration: where the stage is in its schedule: optimiser iterations done or left out.
        skipped: how many were left out, since a phase had converged.
        phase: the stretch of the schedule that the grids are ready for; None before the first.
        record: what training took, once a ``TrainingRecord`` callback has measured it.
        earlier_records: the same of the stages that this one builds on, by name.
        generator: what pixels are drawn with, on the stage's device. At the beginning of each
            Lightning step it depends on the seed, the process and the iteration alone.
        seed: of the generator.
        training_config: the settings that decide what is learned, by config key; empty for a
            stage that was not built from a config.
        protocol: the name of the protocol that the stage is a part of, if any.
        num_rollbacks: how often learning went wrong and was rolled back.
        lr_scale: what the scheduled learning rates are multiplied by; below 1 after a rollback.
        abort_reason: why the stage ended before its schedule; None while it has not.
        loop: carries the iterations out.
    """

    name: str
    capture: CaptureName | Literal["both"]
    # Config keys: what memory depends on most, and what to lower when learning goes wrong.
    memory_keys: tuple[str, ...] = ()
    rate_keys: ClassVar[str] = "the learning rates"
    scene_model: LearnedModel

    def __init__(self, iterations_per_step: int, graphs: Graphs = "auto") -> None:
        super().__init__()
        self.automatic_optimization = False
        self.loop = Loop(graphs)
        self.iterations_per_step = iterations_per_step
        self.iteration = 0
        self.skipped = 0
        self.phase: Phase | None = None
        self.record: dict[str, float | None] = {}
        self.earlier_records: dict[str, dict[str, float | None]] = {}
        self.generator = torch.Generator()
        self.seed = 0
        self.training_config: dict[str, Any] = {}
        self.protocol: str | None = None
        self.num_rollbacks = 0
        self.lr_scale = 1.0
        self.abort_reason: str | None = None
        self._progress: dict[str, Any] | None = None

    @property
    def scene(self) -> Scene:
        """The scene of the trainer's datamodule."""
        scene: Scene = self.trainer.datamodule.scene  # type: ignore[attr-defined]
        return scene

    @property
    def scored_capture(self) -> CaptureName:
        """The capture whose held-out views tell how well the stage learns."""
        return "dynamic" if self.capture == "both" else self.capture

    # What a stage says about learning.

    @property
    @abstractmethod
    def total_iterations(self) -> int:
        """Iterations of the whole schedule."""

    @property
    @abstractmethod
    def resolution(self) -> tuple[int, ...]:
        """Present shape of the grid that is learned; empty where there is none."""

    @property
    @abstractmethod
    def optimizer(self) -> GridAdam:
        """The stage's optimiser, the same object throughout."""

    @abstractmethod
    def phase_at(self, iteration: int) -> Phase:
        """The phase of the schedule that ``iteration`` belongs to."""

    @abstractmethod
    def learning_rate_factor(self, iteration: int) -> float:
        """What the base learning rates are multiplied by at ``iteration``."""

    @abstractmethod
    def enter(self, phase: Phase) -> None:
        """Make grids and optimiser ready for ``phase``."""

    @abstractmethod
    def draw(self, batch: ParallelBatch) -> Pixels:
        """The pixels of a batch's coming iteration, drawn with ``generator``."""

    @abstractmethod
    def loss(
        self, batch: ParallelBatch, views: Any, pixels: Pixels
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """The weighted loss of a batch's pixels of ``views``, and its terms by name."""

    def prepare(self) -> None:
        """What an iteration needs beside what is learned in it; it may wait for the device."""

    def converged(self, losses: Tensor) -> bool:
        """Whether the present phase has nothing left to gain, so that its rest is left out.

        Args:
            losses: (batches,) mean loss of each batch over the Lightning step that is done.
        """
        return False

    def current_model(self) -> LearnedModel:
        """The model with all that has been learned so far in its place."""
        return self.scene_model

    # What a checkpoint holds beside the tensors.

    @abstractmethod
    def phase_state(self) -> dict[str, Any]:
        """What the present phase works with that its schedule does not tell, as plain data."""

    @abstractmethod
    def restore(self, phase: Phase, kept: dict[str, Any]) -> None:
        """Go on with ``phase``, where :meth:`phase_state` gave ``kept``; the fields are loaded."""

    def resize_to(self, state: dict[str, Tensor]) -> None:
        """Make modules for the stored ``state``, where the present ones would not take it."""

    def metadata(self) -> CheckpointMetadata:
        """What a checkpoint of the stage says of itself."""
        return resume.metadata(self)

    # Lightning's hooks.

    def setup(self, stage: str) -> None:
        """Make the generator.

        Raises:
            DevrfError: several processes, and a strategy that cannot follow growing grids; or a
                precision in which points would not find their voxels.
        """
        if self.trainer.precision != "32-true":
            raise DevrfError(
                f"trainer.precision: expected 32-true, not {self.trainer.precision}: positions "
                "need all their digits; decoder_precision=bfloat16 takes fewer for colours alone"
            )
        if self.trainer.world_size > 1 and not isinstance(self.trainer.strategy, ManualDDP):
            raise DevrfError(
                f"trainer: {self.trainer.world_size} processes need trainer=ddp (the strategy "
                "devrf.engine.ddp.ManualDDP)"
            )
        self.seed = torch.initial_seed()
        # Lightning moves the stage there later.
        self.generator = torch.Generator(self.trainer.strategy.root_device)

    def configure_optimizers(self) -> GridAdam:
        """The optimiser that :meth:`enter` hands parameters to."""
        if self._progress is not None and self.phase is not None:
            self.restore(self.phase, self._progress["phase_state"])
        return self.optimizer

    def on_fit_start(self) -> None:
        """Begin with the same fields in every process."""
        broadcast([*self.parameters(), *self.buffers()])

    def on_train_start(self) -> None:
        """Draw random numbers from where the run was left: all else is in place by now."""
        if self._progress is not None:
            set_rng_state(self._progress["random"], self.device)
            self._progress = None
        self._reseed()

    def training_step(self, views: Any, batch_idx: int) -> dict[str, Tensor]:
        """Run iterations up to ``iterations_per_step``, never beyond the present phase.

        Returns:
            The means of the loss and of its terms over these iterations and all batches, by name;
            empty if memory ran out before the first.
        """
        if self.phase != self.phase_at(self.iteration):
            raise DevrfError(
                f"{type(self).__name__}: the phase of iteration {self.iteration} was not "
                "entered: add devrf.callbacks.GridUpscaling to the trainer's callbacks"
            )
        assert self.phase is not None
        optimizer = self.optimizers()
        assert isinstance(optimizer, LightningOptimizer)
        stop = min(self.phase.stop, self.total_iterations)
        count = min(self.iterations_per_step, stop - self.iteration)
        if self.trainer.max_steps > 0:
            count = min(count, self.trainer.max_steps - self.trainer.global_step)
        first = self.iteration
        for _ in range(count):
            self.prepare()
            try:
                self.loop.step(self, views, optimizer)
            except OutOfMemoryError as shortage:
                self.abort(f"{shortage} at {self.describe(self.iteration)}; {self.oom_hint}")
                break
            self.iteration += 1
        done = self.iteration - first
        self.loop.poll()
        if not done:
            self._reseed()
            return {}
        means, losses = self.loop.metrics.take(done)
        if self.iteration < stop and self.converged(losses):
            self.skipped += stop - self.iteration
            self.iteration = stop
        self._reseed()
        named = {f"{self.capture}/{k}": value for k, value in means.items()}
        # On the host, where it is wanted: Lightning would put a number on the device, and wait.
        self.log_dict({**named, "step": torch.tensor(float(self.iteration))})
        if self.iteration >= self.total_iterations:
            self.trainer.should_stop = True
        return means

    def test_step(self, index: int, batch_idx: int) -> dict[str, Any]:
        """Render and score one held-out image; the means are logged.

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

    def on_fit_end(self) -> None:
        """See that every process has come to the same fields.

        Raises:
            DevrfError: they have not, or the stage was aborted.
        """
        if self.abort_reason is not None:
            raise DevrfError(self.abort_reason)
        if self.iteration >= self.total_iterations:
            state = self.state_dict().items()
            assert_replicas_equal({name: t for name, t in state if isinstance(t, Tensor)})

    def teardown(self, stage: str) -> None:
        """Release what only iterations need."""
        self.loop.release()

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add what the tensors do not tell."""
        resume.save(self, checkpoint)

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Go where the run was left, and make room for the tensors, which come next."""
        self._progress = resume.load(self, checkpoint, Path(str(self.trainer.ckpt_path)))

    # When something goes wrong.

    def describe(self, iteration: int) -> str:
        """An iteration of the present phase, its frames and its resolution, in words."""
        frames = self.phase.frames if self.phase is not None else ()
        shape = "x".join(str(n) for n in self.resolution)
        where = ", ".join([*([in_words(frames)] if frames else []), *([shape] if shape else [])])
        place = f" ({where})" if where else ""
        return f"iteration {iteration} of {self.total_iterations}{place}"

    def abort(self, why: str) -> None:
        """End the stage after the present step.

        Args:
            why: the line that the fit ends with.
        """
        self.abort_reason = f"{self.name} stage: {why}"
        self.trainer.should_stop = True

    def rollback(self, iteration: int, lr_scale: float) -> None:
        """Go on from an earlier iteration of the present phase, whose fields have been put back.

        With fresh moments and other random numbers than the first time.

        Args:
            iteration: where to go on.
            lr_scale: what all learning rates are multiplied by from now on.
        """
        self.iteration = iteration
        self.num_rollbacks += 1
        self.lr_scale *= lr_scale
        for group in range(len(self.optimizer.param_groups)):
            self.optimizer.forget(group)
        self._reseed()
        self.trainer.should_stop = False

    @property
    def oom_hint(self) -> str:
        """What to do when memory is short, in words."""
        lower = f" with lower {' or '.join(self.memory_keys)}," if self.memory_keys else " with"
        return (
            "the same command goes on where there is more memory; with less, begin afresh "
            f"(resume=false){lower} or higher data.downscale"
        )

    def _reseed(self) -> None:
        """Seed the generator for the coming iterations, in each process differently."""
        mixed = np.random.SeedSequence([self.seed, rank(), self.iteration, self.num_rollbacks])
        self.generator.manual_seed(int(mixed.generate_state(1, np.uint64)[0]))

    def bind(
        self, rays: int, parameters: Sequence[Sequence[Tensor]], *, static_shape: bool = False
    ) -> None:
        """Get the loop ready for iterations on other tensors than before.

        :meth:`enter` calls it once the phase's tensors are there and the optimiser has them.

        Args:
            rays: of a batch, in all processes together.
            parameters: what is learned from each of the batches of an iteration.
            static_shape: whether no shape of an iteration may depend on data.
        """
        self.loop.bind(rays, parameters, self.optimizer, static_shape=static_shape)
