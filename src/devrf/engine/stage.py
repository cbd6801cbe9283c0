"""A stage: a part of training that follows a schedule, run by Lightning."""

from __future__ import annotations

import logging
import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import partial, reduce
from pathlib import Path
from typing import Any, ClassVar, NoReturn

import torch
from lightning import LightningDataModule, LightningModule, Trainer
from lightning.pytorch.callbacks.early_stopping import EarlyStoppingReason
from lightning.pytorch.core.optimizer import LightningOptimizer
from lightning.pytorch.trainer.states import TrainerFn
from torch import Tensor

from devrf.checkpoints.checkpoint import (
    MODEL,
    UNFIT,
    ChecksummedCheckpointIO,
    LoadedCheckpoint,
    Viewpoints,
    check_scene,
    metadata_in,
    unfit,
)
from devrf.checkpoints.progress import rng_state, set_rng_state
from devrf.data.batch import BackgroundColor
from devrf.data.datamodule import SceneDataModule
from devrf.engine.batch_size import BatchSize
from devrf.engine.ddp import average, average_gradients, broadcast, check_strategy
from devrf.engine.grid_adam import GridAdam
from devrf.engine.plan import StagePlan
from devrf.engine.position import Position
from devrf.engine.protocol import CaptureChoice
from devrf.engine.provenance import Provenance
from devrf.engine.resumed_loops import resumed_fit_loop
from devrf.engine.schedule import Phase, Schedule, entered_phase, scale_schedule
from devrf.errors import DevrfError, expect
from devrf.evaluation.held_out import HeldOutView, score
from devrf.evaluation.scoring import log_scores, log_validation
from devrf.rendering.renderable import Renderable
from devrf.rendering.renderer import Renderer
from devrf.scenes.scene import ImagesName, Scene
from devrf.system.memory import OutOfMemoryError, is_oom
from devrf.system.profiling import span

log = logging.getLogger(__name__)

# Why an EarlyStopping callback ends a stage that has learned what it can.
CONVERGED = {EarlyStoppingReason.PATIENCE_EXHAUSTED, EarlyStoppingReason.STOPPING_THRESHOLD}
# The loss () and its terms () by name, detached.
Terms = dict[str, Tensor]


class Stage(LightningModule, ABC):
    """Learns by a schedule of phases; a subclass says what an iteration is (:meth:`iterate`).

    One Lightning step runs several iterations, so that Lightning's overhead is negligible. The
    callback ``GridUpscaling`` calls :meth:`enter` at the beginning of each phase;
    ``LearningRateDecay`` sets the learning rates before each optimiser step.

    Attributes:
        name: the stage's name in files, messages and protocols.
        capture: the part of the scene that is learned from.
        images: the training views that a batch is drawn from, by name.
        rate_keys: the config keys of what to lower when training diverges.
        keeps_batches: whether a budget of time leaves out iterations before it makes batches
            smaller.
        useful_share: the smallest share of a batch that is worth drawing: less saves no time.
        plan: class of the plan, by which needs are forecast before the stage is built.
        iterations_per_step: iterations of a Lightning step at most.
        datamodule: the trainer's, which serves the views; once the stage is set up, as ``scene``.
        scene: the scene that is learned from, on the host.
        scene_model: the scene that is learned.
        schedule: of the iterations, for the scene; once the stage is set up.
        configured_schedule: the one before it was scaled (``schedule.seconds``); None until then.
        optimizer: steps over everything that is learned; the same object throughout.
        phase: the phase that grids and optimiser are ready for; None before the first.
        position: the place in the schedule.
        batch_size: the share of the schedule's batches that is drawn.
        background: the colours behind the images' pixels.
        provenance: settings, records and earlier stages, for checkpoints.
        generator: draws pixels, on the stage's device. Its state at the beginning of a Lightning
            step follows from the seed, the process, the iterations done and the rollbacks.
        has_scheduled_rates: whether a ``LearningRateDecay`` sets the learning rates.
        began: when the stage was set up, by ``time.perf_counter``.
        has_begun: whether it learns: a progress file has been restored, if there is one.
        time_share: the part of the whole method's seconds that is this stage's.
        abort_reason: why the stage ended before its schedule; None while it has not.
        events: number of events since the stage was set up in this process, by name.
    """

    name: str
    capture: CaptureChoice
    images: tuple[ImagesName, ...]
    rate_keys: ClassVar[str] = "the learning rates"
    keeps_batches: bool = False
    useful_share: float = 0.0
    plan: ClassVar[type[StagePlan]] = StagePlan
    datamodule: SceneDataModule
    scene: Scene
    scene_model: Renderable
    schedule: Schedule
    optimizer: GridAdam
    phase: Phase | None

    def __init__(self, iterations_per_step: int) -> None:
        super().__init__()
        self.automatic_optimization = False
        self.iterations_per_step = iterations_per_step
        self.phase = None
        self.position = Position()
        self.batch_size = BatchSize()
        self.background = BackgroundColor("white")
        self.provenance = Provenance()
        self.generator = torch.Generator()
        self.configured_schedule: Schedule | None = None
        self.has_scheduled_rates = False
        self.began = 0.0
        self.has_begun = False
        self.time_share = 1.0
        self.abort_reason: str | None = None
        self.events: Counter[str] = Counter()
        self._progress: dict[str, Any] | None = None
        self._finished: dict[str, Any] | None = None

    # What a subclass says.

    @abstractmethod
    def iterate(self, views: Any) -> Terms:
        """One iteration on training ``views``, from drawing pixels to the optimiser's step.

        Returns:
            ``loss``; ``opacity``, the mean opacity of the rays, which ``DivergenceGuard`` reads,
            and ``coverage``, what it should be, where alpha masks tell; ``render``, a mean squared
            error, from which the PSNR follows; further terms. The names are the same throughout a
            phase.
        """

    @abstractmethod
    def enter(self, phase: Any) -> None:
        """Make grids and optimiser ready for ``phase``."""

    def restore(self, phase: Any, state: dict[str, Any]) -> None:
        """Go on in ``phase`` with what :meth:`phase_state` gave; the model's tensors are loaded."""
        self.enter(phase)

    def phase_state(self) -> dict[str, Any]:
        """State of the present phase that does not follow from schedule and model: plain data."""
        return {}

    def prepare(self) -> None:
        """Renew what follows from the iteration's number, before it; may wait for the device."""

    def remember(self) -> Callable[[], None]:
        """Keep what iterations change beside the optimiser's parameters, such as the occupancy.

        Returns:
            restores it; called once the parameters are again what they are now.
        """
        return lambda: None

    def current_model(self) -> Renderable:
        """The model, with everything learned so far written back to it."""
        return self.scene_model

    # The loop.

    def training_step(self, views: Any, batch_idx: int) -> Terms:
        """Run up to ``iterations_per_step`` iterations, all of the present phase.

        Returns:
            Means () of the loss and of its terms by name, over these iterations;
            empty if memory ran out in the first. ``psnr`` () is that of the batches in dB.
        """
        position = self.position
        stop = min(entered_phase(self).stop, self.schedule.total)
        count = self.iterations_per_step
        if self.trainer.max_steps > 0:
            count = min(count, self.trainer.max_steps - self.trainer.global_step)
        losses: list[Terms] = []
        iterate = partial(self.iterate, views)
        while len(losses) < count and position.iteration < stop:
            self.prepare()
            try:
                losses.append(self.batch_size.attempt(iterate, self.optimizer, self.device))
            except OutOfMemoryError as shortage:
                self.abort(f"{shortage}; it was at {place_of(self, position.iteration)}")
                break
            position.advance()
        means = mean_terms(losses, self.batch_size.processes)
        self.seed_random()
        if self.is_complete:
            self.trainer.should_stop = True
        if "render" in means:
            means["psnr"] = -10 * means["render"].clamp_min(1e-12).log10()
        if means:
            curves = {f"{self.capture}/{name}": mean for name, mean in means.items()}
            by_iterations = {"step": float(position.iterations_done)}
            self.log_dict({**curves, **by_iterations}, on_step=True, on_epoch=False, batch_size=1)
        return means

    def optimise(self, loss: Tensor) -> None:
        """Go back from a loss () to the gradients, and take the optimiser's step.

        Just before the step, LearningRateDecay sets the learning rates.
        """
        if loss.requires_grad:  # it has no gradient where no ray meets anything
            with span("backward"):
                self.manual_backward(loss)
        if self.batch_size.processes > 1:
            groups = self.optimizer.param_groups
            average_gradients(p for group in groups for p in group["params"])
        optimizer = self.optimizers()
        assert isinstance(optimizer, LightningOptimizer)
        self.batch_size.is_final = True
        with span("optimiser"):
            optimizer.step()
        self.batch_size.is_final = False

    def seed_random(self) -> None:
        """Have the next Lightning step's random numbers follow from its place in the schedule.

        Of several processes those that a method draws itself, too: a progress file has the random
        state of one.
        """
        self.position.seed_generator(self.generator, self.global_rank)
        if self.batch_size.processes > 1:
            torch.manual_seed(self.generator.initial_seed() ^ 1)

    def abort(self, why: str) -> None:
        """End the stage after the present step; the fit then raises an error that says ``why``."""
        self.abort_reason = f"{self.name} stage: {why}"
        self.trainer.should_stop = True

    # What a subclass, callbacks and commands ask.

    @property
    def is_complete(self) -> bool:
        """Whether the stage has gone through its whole schedule, or was to end before."""
        return self.position.ended_early or self.position.iteration >= self.schedule.total

    def result(self) -> LoadedCheckpoint:
        """The learned scene, for a stage that builds on this one."""
        metadata = self.provenance.metadata(
            self.name, self.scene_model, self.scene, complete=self.is_complete
        )
        return LoadedCheckpoint(metadata, self.scene_model)

    # Lightning's other hooks, in the order in which they are called.

    def setup(self, stage: str) -> None:
        """Check the trainer, make the generator, and have checkpoints in devrf's format.

        Raises:
            DevrfError: there is no datamodule, the precision is not 32 bit, Lightning is to go on
                beyond the schedule, or several processes run with a strategy that does not support
                growing grids.
        """
        if self.trainer.precision != "32-true":
            raise DevrfError(
                f"trainer.precision: expected 32-true, not {self.trainer.precision}: positions "
                "need all their digits"
            )
        for key in ("min_steps", "min_epochs"):
            value = getattr(self.trainer, key)
            expect(not value, f"trainer.{key}", "none: the schedule says how long it takes", value)
        check_strategy(self.trainer)
        datamodule = getattr(self.trainer, "datamodule", None)
        if datamodule is None:
            raise DevrfError(
                f"{type(self).__name__}: it learns from the scene of a datamodule; give "
                "datamodule=… to the trainer"
            )
        # Before Lightning reads the one to resume from.
        self.trainer.strategy.checkpoint_io = ChecksummedCheckpointIO()
        self.datamodule = datamodule
        self.scene = datamodule.scene
        self.began = time.perf_counter()
        self.position.seed = torch.initial_seed()
        self.batch_size.processes = self.trainer.world_size
        # Lightning moves the stage to this device later.
        self.generator = torch.Generator(self.trainer.strategy.root_device)
        self.background = BackgroundColor(self.scene.background)
        self.images = ("static", "dynamic") if self.capture == "both" else (self.capture,)

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Restore the position in the schedule; tensors are loaded next.

        What else a progress file holds is restored once they are: ``phase_state`` when the
        optimiser is configured, ``random`` when training starts.

        Raises:
            DevrfError: the checkpoint is of another scene, stage, schedule or version.
        """
        path = Path(str(self.trainer.ckpt_path))
        check_scene(path, metadata_in(path, checkpoint), self.scene)
        self._progress = progress = checkpoint.get("progress")
        if progress is None:
            return
        if progress["schedule_scale"] != 1:
            scale_schedule(self, progress["schedule_scale"])
        total = self.schedule.total
        if (progress["stage"], progress["total"]) != (self.name, total):
            raise DevrfError(
                f"{path}: left by the {progress['stage']} stage on a schedule of "
                f"{progress['total']} iterations, this is the {self.name} stage on one of "
                f"{total}; give it its own schedule"
            )
        self.position.load(progress)
        self.batch_size.load(progress)
        checkpoint["loops"]["fit_loop"] = resumed_fit_loop(
            checkpoint["loops"]["fit_loop"], self.trainer
        )
        first = progress["phase"]
        self.phase = None if first is None else self.schedule.phase(first)

    def configure_optimizers(self) -> GridAdam:
        """The optimiser; in a resumed run with the parameters of the phase that was left."""
        if self._progress is not None and self.phase is not None:
            self.restore(self.phase, self._progress["phase_state"])
        return self.optimizer

    def on_train_start(self) -> None:
        """Give every process the same tensors; restore the random state last.

        Nothing but iterations draws from it any more.
        """
        self._finished = None
        broadcast([*self.parameters(), *self.buffers()])
        if self._progress is not None:
            set_rng_state(self._progress["random"], self.device)
            self._progress = None
        self.seed_random()
        self.has_begun = True

    def on_train_end(self) -> None:
        """Pack on a GPU what is complete: Lightning moves the stage to the host next.

        That needs the occupancy of each frame, 1.2 s at 160³ on two CPU cores.
        """
        if self.device.type == "cuda" and self.is_complete and self.global_rank == 0:
            self._finished = self.current_model().stored_state()

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add the state that is not in tensors.

        Without the optimiser's state a checkpoint is for rendering, not for resuming.
        """
        checkpoint["devrf"] = asdict(self.result().metadata)
        checkpoint["viewpoints"] = asdict(Viewpoints.of(self.scene))
        if "optimizer_states" in checkpoint:
            checkpoint["progress"] = {
                "stage": self.name,
                "total": self.schedule.total,
                **self.position.state(),
                **self.batch_size.state(),
                "phase": None if self.phase is None else self.phase.start,
                "phase_state": {} if self.phase is None else self.phase_state(),
                # Once training is over, the stage itself is on the host.
                "random": rng_state(self.trainer.strategy.root_device),
            }
        elif self.is_complete:
            compact = self._finished or self.current_model().stored_state()
            checkpoint["state_dict"] = {f"{MODEL}{k}": v for k, v in compact.items()}

    def on_fit_end(self) -> None:
        """Refuse the result of a stage that was aborted.

        Raises:
            DevrfError: it was.
        """
        if self.abort_reason is not None:
            raise DevrfError(self.abort_reason)

    def validation_step(self, index: int, batch_idx: int) -> dict[str, HeldOutView]:
        """Render and score one validation view; the means over all are logged.

        Returns:
            ``view``, for callbacks.
        """
        views = self.datamodule.validation_views
        view = score(Renderer(self.current_model()), views, index, self.scene.background)
        log_validation(self, view, self.capture, self.position.iterations_done)
        return {"view": view}

    def on_validation_end(self) -> None:
        """Count the stage as complete where an ``EarlyStopping`` callback ends it.

        Only in the last kind of phase, and because its metric no longer improves: else the stage
        is aborted, and can go on.
        """
        if self.trainer.state.fn != TrainerFn.FITTING or self.phase is None:
            return
        reasons = {stopping.stopping_reason for stopping in self.trainer.early_stopping_callbacks}
        reasons.discard(EarlyStoppingReason.NOT_STOPPED)
        if not reasons:
            return
        where = place_of(self, self.position.iteration)
        last = self.schedule.phase(self.schedule.total).kind
        if not reasons <= CONVERGED:
            self.abort(f"EarlyStopping has ended it at {where}, as its metric went wrong")
        elif self.phase.kind != last:
            self.abort(f"EarlyStopping has ended it at {where}, before {last}; more patience")
        else:
            self.position.ended_early = True
            log.info("%s: EarlyStopping has ended it at %s", self.name, where)

    def test_step(self, index: int, batch_idx: int) -> dict[str, HeldOutView]:
        """Render and score one held-out view; the means over all are logged.

        Returns:
            ``view``, for callbacks.
        """
        views = self.datamodule.test_views
        view = score(Renderer(self.current_model()), views, index, self.scene.background)
        log_scores(self, self.datamodule.scored_capture, view)
        return {"view": view}

    @classmethod
    def load_from_checkpoint(cls, *_: Any, **__: Any) -> NoReturn:
        """Refuse: a checkpoint holds the learned scene, not the arguments of a stage.

        Raises:
            DevrfError: always; it names the function that loads a checkpoint.
        """
        raise DevrfError(
            f"{cls.__name__}.load_from_checkpoint: a checkpoint holds a learned scene, not a "
            "stage's arguments; use devrf.checkpoints.checkpoint.load_checkpoint(path).model, or "
            "give trainer.fit(ckpt_path=path) a progress file"
        )


def fit(
    trainer: Trainer, stage: Stage, datamodule: LightningDataModule, progress: Path | None = None
) -> None:
    """Learn a stage, from a ``progress`` file on if one is given.

    Raises:
        DevrfError: that file contradicts itself.
    """
    try:
        trainer.fit(stage, datamodule=datamodule, ckpt_path=progress and str(progress))
    except UNFIT as error:
        other = stage.has_begun or isinstance(error, DevrfError) or is_oom(error)
        if progress is None or other:
            raise
        raise unfit(progress, error) from error


def place_of(stage: Stage, iteration: int) -> str:
    """An iteration of the present phase, with its frame and its grid's shape, for messages."""
    number = None if stage.phase is None else stage.phase.frame
    frame = "" if number is None else f"frame {number}"
    shape = "x".join(str(n) for n in stage.scene_model.resolution)
    place = ", ".join(part for part in (frame, shape) if part)
    return f"iteration {iteration} of {stage.schedule.total}{place and f' ({place})'}"


def mean_terms(iterations: Sequence[Terms], processes: int) -> Terms:
    """The means () of terms () by name, over iterations that have the same, and ``processes``."""
    if not iterations:
        return {}
    total = reduce(torch.add, (torch.stack(list(terms.values())) for terms in iterations))
    if processes > 1:
        total = average(total)
    return dict(zip(iterations[0], (total / len(iterations)).unbind(), strict=True))
