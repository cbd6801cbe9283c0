"""What both stages share: a loop that follows a schedule, and held-out views that are scored."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from lightning import LightningModule
from lightning.pytorch.core.optimizer import LightningOptimizer
from torch import Tensor

from devrf.checkpoints.checkpoint import CheckpointMetadata, check_scene, metadata_in
from devrf.checkpoints.progress import rng_state, set_rng_state
from devrf.data.batch import Pixels
from devrf.engine.ddp import (
    ManualDDP,
    assert_replicas_equal,
    broadcast,
    rank,
)
from devrf.engine.graphs import Graphs
from devrf.engine.loop import Loop
from devrf.engine.parallel_batch import ParallelBatch
from devrf.errors import DevrfError
from devrf.evaluation.held_out import score
from devrf.geometry.rays import Rays
from devrf.methods.devrf.compact_state import compact_state
from devrf.methods.devrf.grid_warp import GridWarp
from devrf.methods.devrf.model import SceneModel
from devrf.methods.devrf.renderer import Renderer
from devrf.methods.devrf.schedules import CanonicalPhase, DeformationPhase
from devrf.methods.devrf.settings import Precision
from devrf.methods.devrf.static_shape import render_in_lists
from devrf.methods.devrf.volume_rendering import RenderOutput, render
from devrf.ops.adam import GridAdam
from devrf.rendering.occupancy import Occupancy
from devrf.rendering.sample_capacity import SampleCapacity
from devrf.scenes.scene import CaptureName, Scene, Views
from devrf.system.machine import multiplies_bfloat16
from devrf.system.out_of_memory import OutOfMemoryError

Phase = CanonicalPhase | DeformationPhase


class ScheduledStage(LightningModule, ABC):
    """A stage whose schedule says what each iteration learns.

    One Lightning step covers several optimiser iterations, so that the framework's own work
    does not show. The stage never changes its grids by itself: the callback ``GridUpscaling``
    calls :meth:`enter` where a phase begins, ``LearningRateDecay`` scales the learning rates
    before every step.

    What an iteration is, and how it is carried out, is the loop's business
    (:class:`~devrf.engine.loop.Loop`). Callbacks see the same steps and the same rates whatever
    runs it; what is asked before a step is asked before the whole iteration if that is steady.

    A checkpoint with the optimiser's state in it (any of Lightning's that is not ``weights_only``)
    holds all that it takes to go on: ``Trainer.fit(ckpt_path=…)`` continues as if the run had
    never stopped. ``stages.progress`` says how.

    Attributes:
        name: what the stage is called in files and messages.
        capture: the part of the scene that is learned from.
        iteration: where the stage is in its schedule: optimiser iterations done or left out.
        skipped: how many were left out, since a phase had nothing left to gain.
        phase: the stretch of the schedule that the grids are ready for; None before the first.
        record: what training took, once a ``TrainingRecord`` callback has measured it.
        generator: what pixels are drawn with, on the stage's device. At the beginning of each
            Lightning step it depends on the seed, the process and the iteration alone.
        training_config: the settings that decide what is learned, by config key, if somebody told.
        num_rollbacks: how often learning went wrong and was taken back.
        lr_scale: what the scheduled learning rates are multiplied by; below 1 after a back-off.
        abort_reason: why the stage ended before its schedule; None while it has not.
        decoder_precision: what the colour network computes in while it learns.
        loop: carries the iterations out.
    """

    name: ClassVar[str]
    capture: ClassVar[CaptureName]

    def __init__(
        self,
        iterations_per_step: int,
        graphs: Graphs = "auto",
        decoder_precision: Precision = "auto",
    ) -> None:
        super().__init__()
        self.automatic_optimization = False
        self.decoder_precision = decoder_precision
        self.loop = Loop(graphs)
        self.iterations_per_step = iterations_per_step
        self.iteration = 0
        self.skipped = 0
        self.phase: Phase | None = None
        self.record: dict[str, float | None] = {}
        self.generator = torch.Generator()
        self._seed = 0
        self.training_config: dict[str, Any] = {}
        self.num_rollbacks = 0
        self.lr_scale = 1.0
        self.abort_reason: str | None = None
        self._left_off: dict[str, Any] | None = None

    @property
    def scene(self) -> Scene:
        """The scene of the trainer's datamodule."""
        scene: Scene = self.trainer.datamodule.scene  # type: ignore[attr-defined]
        return scene

    @property
    @abstractmethod
    def memory_keys(self) -> tuple[str, ...]:
        """The config keys that its memory depends on most."""

    @property
    @abstractmethod
    def total_iterations(self) -> int:
        """Iterations of the whole schedule."""

    @property
    @abstractmethod
    def resolution(self) -> tuple[int, int, int]:
        """Present shape of the grid that is learned."""

    @property
    @abstractmethod
    def model(self) -> SceneModel:
        """What has been learned so far, ready to render."""

    @property
    @abstractmethod
    def model_now(self) -> SceneModel:
        """The model that is being learned, in which what is at hand may not have its place yet."""

    @abstractmethod
    def phase_at(self, iteration: int) -> Phase:
        """The phase of the schedule that ``iteration`` belongs to."""

    @abstractmethod
    def learning_rate_factor(self, iteration: int) -> float:
        """What the base learning rates are multiplied by at ``iteration``."""

    @abstractmethod
    def enter(self, phase: Phase) -> None:
        """Make grids and optimiser ready for ``phase``."""

    def prepare(self) -> None:
        """What an iteration needs beside what is learned in it; it may wait for the device."""

    @abstractmethod
    def draw(self, lane: ParallelBatch) -> Pixels:
        """The pixels of a lane's coming iteration, drawn with ``generator``."""

    @abstractmethod
    def loss(
        self, lane: ParallelBatch, views: Views, pixels: Pixels
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """The weighted loss of a lane's pixels of ``views``, and its terms by name."""

    def settled(self, losses: Tensor) -> bool:
        """Whether the present phase has nothing left to gain, so that its rest is left out.

        Args:
            losses: (lanes,) mean of each lane's over the Lightning step that is done.
        """
        return False

    def see(
        self,
        rays: Rays,
        occupancy: Occupancy,
        background: Tensor,
        room: SampleCapacity | None,
        warp: GridWarp | None = None,
    ) -> RenderOutput:
        """Render rays to learn from them: in a lane's lists of fixed length if it has ``room``."""
        model, precision = self.model_now, self._precision
        if room is None:
            return render(
                rays, model.canonical, occupancy, model.settings, background, warp, precision
            )
        return render_in_lists(
            rays, model.canonical, occupancy, model.settings, background, warp, room, precision
        )

    @property
    def _precision(self) -> torch.dtype:
        """What the colour network computes in on the stage's device."""
        chosen = self.decoder_precision
        reduced = multiplies_bfloat16(self.device) if chosen == "auto" else chosen == "bfloat16"
        return torch.bfloat16 if reduced else torch.float32

    def renew(self, rays: int, lanes: Sequence[Sequence[Tensor]]) -> None:
        """Get ready for iterations on other tensors than before.

        Whoever enters a phase calls it once the phase's tensors are there and the optimiser has
        them.

        Args:
            rays: of a batch, in all processes together.
            lanes: what is learned from each of the batches of an iteration.
        """
        density = self.model_now.canonical.density.values
        self.loop.renew(rays, lanes, density, self.optimizer)

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
        self._seed = torch.initial_seed()
        # Lightning moves the stage there later.
        self.generator = torch.Generator(self.trainer.strategy.root_device)

    def on_fit_start(self) -> None:
        """Begin with the same fields in every process."""
        broadcast([*self.parameters(), *self.buffers()])

    def on_fit_end(self) -> None:
        """See that every process has come to the same fields.

        Raises:
            DevrfError: they have not, or the stage gave up.
        """
        if self.abort_reason is not None:
            raise DevrfError(self.abort_reason)
        if self.iteration >= self.total_iterations:
            state = self.state_dict().items()
            assert_replicas_equal({name: t for name, t in state if isinstance(t, Tensor)})

    def teardown(self, stage: str) -> None:
        """Let go of what only iterations need."""
        self.loop.let_go()

    def _draw_anew(self) -> None:
        """Seed the generator for the coming iterations, in each process differently."""
        mixed = np.random.SeedSequence([self._seed, rank(), self.iteration, self.num_rollbacks])
        self.generator.manual_seed(int(mixed.generate_state(1, np.uint64)[0]))

    def where(self, iteration: int) -> str:
        """An iteration of the present phase, its frames and its resolution, in words."""
        visit = f"{self.phase.in_words}, " if isinstance(self.phase, DeformationPhase) else ""
        shape = "x".join(str(n) for n in self.resolution)
        return f"iteration {iteration} of {self.total_iterations} ({visit}{shape})"

    def abort(self, why: str) -> None:
        """End the stage after the present step, with a progress file if somebody writes one.

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
        self._draw_anew()
        self.trainer.should_stop = False

    def training_step(self, views: Views, batch_idx: int) -> dict[str, Tensor]:
        """Run iterations up to ``iterations_per_step``, never beyond the present phase.

        Returns:
            The means of the loss and of its terms over these iterations and all lanes, by name;
            empty if memory ran out before the first.
        """
        if self.phase != self.phase_at(self.iteration):
            raise DevrfError(
                f"{type(self).__name__}: nobody prepared the phase of iteration "
                f"{self.iteration}: add devrf.callbacks.GridUpscaling to the trainer's callbacks"
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
                self.loop.once(self, views, optimizer)
            except OutOfMemoryError as shortage:
                self.abort(f"{shortage} at {self.where(self.iteration)}; {self.remedy}")
                break
            self.iteration += 1
        done = self.iteration - first
        self.loop.look()
        if not done:
            self._draw_anew()
            return {}
        means, losses = self.loop.sums.take(done)
        if self.iteration < stop and self.settled(losses):
            self.skipped += stop - self.iteration
            self.iteration = stop
        self._draw_anew()
        named = {f"{self.capture}/{k}": value for k, value in means.items()}
        # On the host, where it is wanted: Lightning would put a number on the device, and wait.
        self.log_dict({**named, "step": torch.tensor(float(self.iteration))})
        if self.iteration >= self.total_iterations:
            self.trainer.should_stop = True
        return means

    @property
    def remedy(self) -> str:
        """What to do when memory is short, in words."""
        return (
            "the same command goes on where there is more memory; with less, begin afresh "
            f"(resume=false) with lower {' or '.join(self.memory_keys)}, or higher data.downscale"
        )

    def test_step(self, index: int, batch_idx: int) -> dict[str, Any]:
        """Render and score one held-out image; the means are logged.

        Returns:
            ``view``: the :class:`~devrf.evaluation.held_out.HeldOutView`, for callbacks.
        """
        scene = self.scene
        views = scene.capture(self.capture).test
        view = score(Renderer(self.model), views, index, scene.background)
        scores = {"psnr": view.psnr, "ssim": view.ssim, "rest_pose_psnr": view.rest_pose_psnr}
        means = {f"test/{self.capture}/{k}": v for k, v in scores.items()}
        self.log_dict(means, batch_size=1, sync_dist=True)
        return {"view": view}

    def configure_optimizers(self) -> GridAdam:
        """The optimiser that :meth:`enter` hands parameters to."""
        if self._left_off is not None and self.phase is not None:
            self.restore_phase(self.phase, self._left_off["phase_state"])
        return self.optimizer

    @property
    @abstractmethod
    def optimizer(self) -> GridAdam:
        """The stage's optimiser, the same object throughout."""

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add what the tensors do not tell."""
        checkpoint["devrf"] = asdict(self.metadata())
        # Without the optimiser's state it is there to be rendered, not to be gone on from.
        if "optimizer_states" not in checkpoint:
            if self.iteration >= self.total_iterations:
                small = compact_state(self.model)
                checkpoint["state_dict"] = {f"scene_model.{k}": v for k, v in small.items()}
        else:
            checkpoint["progress"] = {
                "stage": self.name,
                "iteration": self.iteration,
                "skipped": self.skipped,
                "total": self.total_iterations,
                "phase": None if self.phase is None else self.phase.start,
                "phase_state": {} if self.phase is None else self.phase_state(),
                "seed": self._seed,
                "random": rng_state(self.device),
                "parts": self.loop.parts.count,
                "num_rollbacks": self.num_rollbacks,
                "lr_scale": self.lr_scale,
            }

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Make room for the tensors, which come next, and note where the run was left.

        Raises:
            DevrfError: the checkpoint is of another scene, stage or schedule.
        """
        path = Path(str(self.trainer.ckpt_path))
        check_scene(path, metadata_in(path, checkpoint), self.scene)
        self.resize_to(checkpoint["state_dict"])
        kept = checkpoint.get("progress")
        if kept is None:
            return
        course, ours = (kept["stage"], kept["total"]), (self.name, self.total_iterations)
        if course != ours:
            raise DevrfError(
                f"{path}: left by the {course[0]} stage on a schedule of {course[1]} iterations, "
                f"this is the {ours[0]} stage on one of {ours[1]}; give it its own schedule"
            )
        self.iteration, self._seed = kept["iteration"], kept["seed"]
        self.skipped = kept["skipped"]
        self.loop.parts.count = kept["parts"]
        self.num_rollbacks, self.lr_scale = kept["num_rollbacks"], kept["lr_scale"]
        self.phase = None if kept["phase"] is None else self.phase_at(kept["phase"])
        self._left_off = kept

    def on_train_start(self) -> None:
        """Draw random numbers from where the run was left: all else is in place by now."""
        if self._left_off is not None:
            set_rng_state(self._left_off["random"], self.device)
            self._left_off = None
        self._draw_anew()

    @abstractmethod
    def phase_state(self) -> dict[str, Any]:
        """What the present phase works with that its schedule does not tell, as plain data."""

    @abstractmethod
    def restore_phase(self, phase: Phase, kept: dict[str, Any]) -> None:
        """Go on with ``phase``, where :meth:`phase_state` gave ``kept``; the fields are loaded."""

    def resize_to(self, state: dict[str, Tensor]) -> None:
        """Make modules for the stored ``state``, where the present ones would not take it."""

    @abstractmethod
    def metadata(self) -> CheckpointMetadata:
        """What the checkpoint is and how to build its model."""
