"""A stage: a part of training that follows a schedule, run by Lightning."""

from __future__ import annotations

import logging
import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import reduce
from pathlib import Path
from typing import Any, ClassVar, Literal, Protocol

import numpy as np
import torch
from lightning import LightningDataModule, LightningModule, Trainer
from lightning.pytorch.core.optimizer import LightningOptimizer
from torch import Tensor
from warp import Kernel

from devrf.checkpoints.checkpoint import (
    MODEL,
    UNFIT,
    CheckpointMetadata,
    LoadedCheckpoint,
    TrainingFigures,
    Viewpoints,
    check_scene,
    metadata_in,
    unfit,
)
from devrf.checkpoints.progress import rng_state, set_rng_state
from devrf.checkpoints.stored_class import class_path
from devrf.data.batch import Pixels, background_color
from devrf.engine.ddp import (
    assert_replicas_equal,
    average,
    average_gradients,
    broadcast,
    check_strategy,
)
from devrf.engine.grid_adam import GridAdam
from devrf.engine.phase import Phase
from devrf.errors import DevrfError
from devrf.evaluation.held_out import score
from devrf.rendering.renderer import Renderer
from devrf.rendering.view import Viewable
from devrf.scenes.scene import CaptureName, ImagesName, Scene, Views
from devrf.system.memory import free_cache, is_oom, numbers
from devrf.system.plain_data import Count, built
from devrf.system.profiling import span

log = logging.getLogger(__name__)

# Attributes of a stage that a progress file holds by name (:class:`Progress`): where it is in its
# schedule, and how it goes on.
POSITION: tuple[str, ...] = ("iteration", "iterations_done", "seed", "num_rollbacks", "lr_scale")
POSITION += ("batch_share", "largest_share")


class LearnedModel(Viewable, Protocol):
    """What a stage learns: a :class:`~devrf.methods.base.Renderable`."""

    def config(self) -> dict[str, Any]:
        """Plain data to build it from."""
        ...

    def stored_state(self) -> dict[str, Any]:
        """The state for a finished checkpoint."""
        ...


class Stage(LightningModule, ABC):
    """Learns by a schedule of phases; a subclass says what is drawn and what the loss is.

    One iteration draws pixels (:meth:`draw`), renders their rays and weighs the loss terms
    (:meth:`loss`), goes back to the gradients (:meth:`find_gradients`), and steps
    (:meth:`training_step`). One Lightning step runs several iterations, so that Lightning's
    overhead is negligible. The callback ``GridUpscaling`` calls :meth:`enter` at the beginning of
    each phase; ``LearningRateDecay`` sets the learning rates before each optimiser step.

    Attributes:
        name: what files, messages and protocols call the stage.
        capture: the part of the scene that is learned from.
        memory_keys: the config keys of what to lower when memory runs out.
        rate_keys: the config keys of what to lower when training diverges.
        keeps_batches: whether whole batches learn more in a time than more, smaller ones.
        useful_share: the part of a batch than which a smaller one takes as long.
        scene_model: what is learned.
        optimizer: steps over everything that is learned; the same object throughout.
        phase: the phase that grids and optimiser are ready for; None before the first.
        iteration: position in the schedule. A phase that has converged is left for the next; a
            time budget moves it further, or less far, than the iterations that are carried out.
        previous_iteration: the position of the iteration before.
        iterations_done: optimiser iterations that were carried out.
        batch_share: the part of the schedule's batches that is drawn: less than 1 after memory
            has run out, or for want of time.
        largest_share: the most of them for which there is memory: less than 1 after it has run out.
        smallest_share: the least to which they are halved where memory runs out.
        generator: draws pixels, on the stage's device. Its state at the beginning of a Lightning
            step follows from the seed, the process, the iterations done and the rollbacks.
        seed: of the whole run.
        num_rollbacks: how often training diverged and was rolled back.
        lr_scale: factor of the scheduled learning rates; below 1 after a rollback.
        has_scheduled_rates: whether a ``LearningRateDecay`` sets the learning rates.
        abort_reason: why the stage ended before its schedule; None while it has not.
        time_share: the part of the whole method's seconds that is this stage's.
        began: when the stage was set up, by ``time.perf_counter``.
        has_begun: whether it learns: a progress file has been restored, if there is one.
        record: what training took, once a ``TrainingRecord`` callback has measured it.
        earlier_records: the same for the stages that this one builds on, by name.
        training_config: the settings that decide what is learned, by config key; empty for a
            stage that was not built from a config.
        earlier_configs: the same of the stages that this one builds on, by name.
        command: what the command chose and set that learns, as its checkpoints hold it.
        protocol: the name of the protocol that the stage is a part of, if any.
        events: what has happened since the stage was set up in this process, and how often.
    """

    name: str
    capture: CaptureName | Literal["both"]
    memory_keys: tuple[str, ...] = ()
    rate_keys: ClassVar[str] = "the learning rates"
    keeps_batches: bool = False
    useful_share: float = 0.0
    scene_model: LearnedModel
    optimizer: GridAdam
    phase: Phase | None

    def __init__(self, iterations_per_step: int) -> None:
        super().__init__()
        self.automatic_optimization = False
        self.iterations_per_step = iterations_per_step
        self.phase = None
        self.iteration = 0
        self.previous_iteration = -1
        self.iterations_done = 0
        self.batch_share = 1.0
        self.largest_share = 1.0
        self.smallest_share = 0.5
        self.generator = torch.Generator()
        self.seed = 0
        self.num_rollbacks = 0
        self.lr_scale = 1.0
        self.has_scheduled_rates = False
        self.abort_reason: str | None = None
        self.time_share = 1.0
        self.began = 0.0
        self.has_begun = False
        self.record: TrainingFigures = {}
        self.earlier_records: dict[str, TrainingFigures] = {}
        self.training_config: dict[str, Any] = {}
        self.earlier_configs: dict[str, dict[str, Any]] = {}
        self.command: dict[str, Any] = {}
        self.protocol: str | None = None
        self.events: Counter[str] = Counter()
        self._plain_background: Tensor | None = None
        self._progress: dict[str, Any] | None = None
        self._finished: dict[str, Any] | None = None

    # An iteration.

    def training_step(self, views: Any, batch_idx: int) -> dict[str, Tensor]:
        """Run up to ``iterations_per_step`` iterations, all of the present phase.

        Returns:
            Means () of the loss and of its terms by name, over these iterations;
            empty if memory ran out in the first.
        """
        stop = min(self._entered_phase().stop, self.total_iterations)
        optimizer = self.optimizers()
        assert isinstance(optimizer, LightningOptimizer)
        count = self.iterations_per_step
        if self.trainer.max_steps > 0:
            count = min(count, self.trainer.max_steps - self.trainer.global_step)
        losses: list[dict[str, Tensor]] = []
        while len(losses) < count and self.iteration < stop:
            present = self.iteration
            self.prepare()
            terms = self.find_gradients(views)
            if terms is None:
                break
            losses.append(terms)
            # Just before it steps, LearningRateDecay sets the learning rates, and a TimeBudget
            # moves the iteration.
            with span("optimiser"):
                optimizer.step()
            self.previous_iteration = present
            self.iteration += 1
            self.iterations_done += 1
        means = mean_terms(losses, self.processes)
        if losses and self.iteration < stop and self.converged(means["loss"]):
            self.iteration = stop
        self._reseed()
        if self.iteration >= self.total_iterations:
            self.trainer.should_stop = True
        return means

    def find_gradients(self, views: Any) -> dict[str, Tensor] | None:
        """Draw pixels of ``views``, render them, weigh the loss terms, and go back to gradients.

        Returns:
            The loss () and its terms () by name, detached; None where memory has run out even for
            the smallest batch, and the stage is to end. No parameter has changed.
        """
        try:
            self.optimizer.make_gradients()  # Lightning drops them where a run is resumed
            pixels = self.draw()
            loss, terms = self.loss(views, pixels)
            if loss.requires_grad:  # it has no gradient where no ray meets anything
                with span("backward"):
                    self.manual_backward(loss)
            if self.processes > 1:
                groups = self.optimizer.param_groups
                average_gradients(p for group in groups for p in group["params"])
            return {"loss": loss.detach(), **terms}
        except (RuntimeError, MemoryError) as error:
            if not is_oom(error):
                raise
            shortage = f"out of memory ({numbers(str(error), self.device)})"
        # Outside the handler, where the error's traceback no longer holds the batch.
        self.optimizer.zero_grad()
        free_cache(self.device)
        return self.find_gradients(views) if self._halve_batches(shortage) else None

    def _halve_batches(self, shortage: str) -> bool:
        """Draw half of the rays from now on; end the stage if that is less than the smallest share.

        Raises:
            DevrfError: there are several processes: the others already wait for this one.
        """
        if self.processes > 1:
            raise DevrfError(
                f"schedule: one of {self.processes} processes is {shortage}; fewer rays, smaller "
                "grids or more processes"
            )
        if self.batch_share / 2 < self.smallest_share:
            lower = " or ".join(self.memory_keys)
            self.abort(
                f"{shortage} at {self.describe(self.iteration)}; the same command goes on where "
                "there is more memory; with less, begin afresh (resume=false) with "
                f"{f'lower {lower}, or ' if lower else ''}higher data.downscale"
            )
            return False
        self.batch_share /= 2
        self.largest_share = self.batch_share
        log.warning("%s: batches have half of their rays from now on", shortage)
        return True

    def _entered_phase(self) -> Phase:
        """The present phase, for whose iterations grids and learning rates are ready.

        Raises:
            DevrfError: the callback that makes them so is missing.
        """
        if self.phase is None or self.phase != self.phase_at(self.iteration):
            raise DevrfError(
                f"{type(self).__name__}: the phase of iteration {self.iteration} was not "
                "entered: add devrf.callbacks.GridUpscaling to the trainer's callbacks"
            )
        if not self.has_scheduled_rates:
            raise DevrfError(
                f"{type(self).__name__}: the learning rates of its schedule are not set: add "
                "devrf.callbacks.LearningRateDecay to the trainer's callbacks"
            )
        return self.phase

    def _reseed(self) -> None:
        """Seed the generator for the next step, differently in each process."""
        place = [self.seed, self.global_rank, self.iterations_done, self.num_rollbacks]
        mixed = np.random.SeedSequence(place)
        self.generator.manual_seed(int(mixed.generate_state(1, np.uint64)[0]))

    # What a subclass says.

    @property
    @abstractmethod
    def total_iterations(self) -> int:
        """Iterations of the whole schedule."""

    @property
    @abstractmethod
    def resolution(self) -> tuple[int, ...]:
        """Present shape of the grid that is learned; empty where there is none."""

    @abstractmethod
    def phase_at(self, iteration: int) -> Phase:
        """The phase that contains ``iteration``."""

    @abstractmethod
    def learning_rate_factor(self, iteration: int) -> float:
        """Factor of the base learning rates at ``iteration``."""

    @abstractmethod
    def enter(self, phase: Any) -> None:
        """Make grids and optimiser ready for ``phase``."""

    def prepare(self) -> None:
        """Called before each iteration; may wait for the device."""

    @abstractmethod
    def draw(self) -> Pixels:
        """The pixels of the next iteration, drawn with ``generator``."""

    @abstractmethod
    def loss(self, views: Any, pixels: Pixels) -> tuple[Tensor, dict[str, Tensor]]:
        """The weighted loss () of pixels of ``views``, and its terms () by name."""

    def converged(self, loss: Tensor) -> bool:
        """Whether the rest of the present phase can be skipped.

        Args:
            loss: () mean over the last Lightning step.
        """
        return False

    def phase_state(self) -> dict[str, Any]:
        """State of the present phase that does not follow from schedule and model: plain data."""
        return {}

    @abstractmethod
    def restore(self, phase: Any, state: dict[str, Any]) -> None:
        """Continue ``phase`` with what :meth:`phase_state` gave; the model's tensors are loaded."""

    def resize_to(self, state: dict[str, Tensor]) -> None:
        """Give modules the shapes of a stored ``state`` that is about to be loaded."""

    def current_model(self) -> LearnedModel:
        """The model, with everything learned so far written back to it."""
        return self.scene_model

    @property
    def planned_events(self) -> Mapping[str, int]:
        """What the whole schedule brings about, and how often, by the names of :attr:`events`."""
        return {}

    @classmethod
    def kernels(cls, settings: Mapping[str, Any]) -> Sequence[Kernel]:
        """What a stage with these arguments launches, to be compiled before it learns."""
        return ()

    @classmethod
    def iterations_of(cls, settings: Mapping[str, Any], scene: Scene) -> int:
        """Iterations, for a scene, of the stage with these arguments, which is not built."""
        raise NotImplementedError

    @classmethod
    def rehearsed(cls, settings: Mapping[str, Any]) -> dict[str, Any]:
        """The arguments of the stage, made to fit into seconds on a CPU.

        The schedule is scaled, so that all that happens still does; batches, grids and networks
        are smaller. All else is as it was.
        """
        return {**settings}

    @classmethod
    def check_settings(cls, **settings: Any) -> None:
        """Find errors in the arguments of the stage before what it builds on has been learned.

        Raises:
            DevrfError: one is wrong.
        """

    # What a subclass asks.

    def rays_to_draw(self, rays: int, most: int | None = None) -> int:
        """How many rays of a batch this process draws.

        Args:
            rays: of the schedule's batches.
            most: rays of a batch at most, if there is a limit.
        """
        whole = rays if most is None else min(rays, most)
        return max(1, round(whole * self.share))

    @property
    def share(self) -> float:
        """The part of the schedule's batches that this process draws."""
        return self.batch_share / self.processes

    @property
    def processes(self) -> int:
        """How many processes learn together."""
        return self.trainer.world_size

    @property
    def background_name(self) -> str:
        """What it learns before: ``white``, ``black`` or ``random``."""
        return self.scene.background

    def background(self, image: Tensor) -> Tensor:
        """What is behind the pixels of ``image`` (R,): (3,), always the same tensor, if plain.

        Else (R, 3), drawn with ``generator``.
        """
        plain = self._plain_background
        if plain is None or plain.device != image.device:
            name = self.background_name
            if name == "random":
                return background_color(name, len(image), self.generator)
            plain = background_color(name, 0, self.generator).to(image.device)
            self._plain_background = plain
        return plain

    def is_due(self, every: int, start: int) -> bool:
        """Whether a multiple of ``every`` iterations after ``start`` has just been reached.

        One that a time budget leaves out counts, and one at which it stays counts once.
        """
        before = max(self.previous_iteration - start, 0)
        return (self.iteration - start) // every > before // every

    @property
    def scene(self) -> Scene:
        """The scene of the trainer's datamodule."""
        scene: Scene = self.trainer.datamodule.scene  # type: ignore[attr-defined]
        return scene

    def training_views(self, images: ImagesName) -> Views:
        """The training views called so, on the stage's device."""
        views: Views = self.trainer.datamodule.training_views(  # type: ignore[attr-defined]
            images, self.device
        )
        return views

    @property
    def images(self) -> tuple[ImagesName, ...]:
        """What is learned from: the training views of these names."""
        return ("static", "dynamic") if self.capture == "both" else (self.capture,)

    @property
    def scored_capture(self) -> CaptureName:
        """The capture whose held-out views measure what was learned."""
        return "dynamic" if self.capture == "both" else self.capture

    # What callbacks and commands ask.

    def cost(self, first: int, last: int) -> float:
        """How long iterations ``first`` to ``last`` take, in the unit of the phases' costs."""
        cost = 0.0
        while first < last:
            phase = self.phase_at(first)
            stop = min(phase.stop, last)
            cost += (stop - first) * phase.cost
            first = stop
        return cost

    def describe(self, iteration: int) -> str:
        """An iteration of the present phase, with its frame and resolution, for messages."""
        number = None if self.phase is None else self.phase.frame
        frame = "" if number is None else f"frame {number}"
        shape = "x".join(str(n) for n in self.resolution)
        place = ", ".join(part for part in (frame, shape) if part)
        return f"iteration {iteration} of {self.total_iterations}{place and f' ({place})'}"

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

    def rollback(self, iteration: int, iterations_done: int, lr_scale: float) -> None:
        """Continue from an earlier iteration of the present phase, whose tensors are back in place.

        Adam's state starts afresh, and other pixels are drawn than the first time.

        Args:
            iteration: where to continue.
            iterations_done: iterations that had been carried out there.
            lr_scale: further factor of all learning rates from now on.
        """
        self.iteration = iteration
        self.previous_iteration = iteration - 1
        self.iterations_done = iterations_done
        self.num_rollbacks += 1
        self.lr_scale *= lr_scale
        self.optimizer.forget()
        self._reseed()
        self.trainer.should_stop = False

    # Lightning's other hooks, in the order in which they are called.

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
            DevrfError: the checkpoint is of another scene, stage, schedule or version.
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
        self.previous_iteration = self.iteration - 1
        # A schedule is one epoch of a loader that never ends: what ended it there (max_time,
        # limit_train_batches, fast_dev_run) has not ended it here.
        fit = _counts(checkpoint["loops"]["fit_loop"], like=self.trainer.fit_loop.state_dict())
        checkpoint["loops"]["fit_loop"] = fit
        for epochs in ("total", "current"):
            fit["epoch_progress"][epochs].update(processed=0, completed=0)
        fit["epoch_loop.batch_progress"]["is_last_batch"] = False
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
        self.has_begun = True

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


def fit(
    trainer: Trainer, stage: Stage, datamodule: LightningDataModule, progress: Path | None = None
) -> None:
    """Learn a stage, from a ``progress`` file on if one is given.

    Raises:
        DevrfError: what that file holds contradicts itself.
    """
    try:
        trainer.fit(stage, datamodule=datamodule, ckpt_path=progress and str(progress))
    except UNFIT as error:
        other = stage.has_begun or isinstance(error, DevrfError) or is_oom(error)
        if progress is None or other:
            raise
        raise unfit(progress, error) from error


def _counts(stored: Any, like: Any) -> Any:
    """The counts that a loop stored, in those places where a new one has some."""
    if isinstance(like, dict):
        return {key: _counts(stored[key], value) for key, value in like.items()}
    return built(Count if type(like) is int else type(like), stored)


def mean_terms(iterations: Sequence[Mapping[str, Tensor]], processes: int) -> dict[str, Tensor]:
    """The means () of terms () by name, over iterations that have the same, and ``processes``."""
    if not iterations:
        return {}
    total = reduce(torch.add, (torch.stack(list(terms.values())) for terms in iterations))
    if processes > 1:
        total = average(total)
    return dict(zip(iterations[0], (total / len(iterations)).unbind(), strict=True))
