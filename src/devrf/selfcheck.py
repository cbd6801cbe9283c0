"""Checks of the machine: whether promises hold on its device.

``stage=selfcheck`` makes them one after another, ``pytest -m gpu`` makes the same ones. A check is
a function that returns its figures in a few words, and raises what went wrong.
"""

from __future__ import annotations

import copy
import logging
import math
import os
import signal
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import torch
from lightning import Callback, Trainer, seed_everything
from lightning.pytorch.callbacks import LambdaCallback

from devrf.callbacks import GridUpscaling, LearningRateDecay, PeriodicCheckpoint, StopOnSignal
from devrf.checkpoints.checkpoint import LoadedCheckpoint
from devrf.checkpoints.progress import progress_files
from devrf.data.rendered import ProceduralDataModule
from devrf.engine.stage import Stage
from devrf.errors import DevrfError
from devrf.methods.devrf.architecture import Architecture
from devrf.methods.devrf.canonical_schedule import CanonicalSchedule
from devrf.methods.devrf.canonical_stage import CanonicalStage
from devrf.methods.devrf.deformation_schedule import PAPER_LEVELS, DeformationSchedule, Level
from devrf.methods.devrf.deformation_stage import DeformationStage
from devrf.methods.devrf.extensions.tracks import StartAlongFlow
from devrf.methods.devrf.model import DeVRFModel
from devrf.methods.devrf.settings import Sampling, VisitSettings
from devrf.rendering.renderer import Renderer
from devrf.scenes.scene import background_value

log = logging.getLogger(__name__)


class CheckSkippedError(Exception):
    """The device cannot do the check; the text says why."""


@dataclass
class SmallScene:
    """A device, and the embedded robot in small images for it.

    Attributes:
        device: where stages learn.
        data: serves the robot at rest, and seen moving by three cameras.
        at_rest: the canonical stage's schedule.
        deformation: the deformation stage's schedule.
        architecture: of the canonical field.
        sampling: how rays are sampled.
        seed: of everything that is drawn.
    """

    device: torch.device
    data: ProceduralDataModule
    at_rest: CanonicalSchedule
    deformation: DeformationSchedule
    architecture: Architecture
    sampling: Sampling
    seed: int = 0

    @cached_property
    def canonical(self) -> LoadedCheckpoint:
        """The robot at rest, learned in PyTorch."""
        stage = self.stage("canonical")
        assert isinstance(stage, CanonicalStage)
        self.learn(stage)
        return stage.result()

    def stage(self, name: str) -> Stage:
        """The canonical or the deformation stage."""
        if name == "canonical":
            return CanonicalStage(
                self.at_rest,
                self.architecture,
                sampling=self.sampling,
                iterations_per_step=5,
            )
        settings = VisitSettings(5e-3, unit="box", store="host")
        return DeformationStage(
            copy.deepcopy(self.canonical),
            self.deformation,
            settings,
            iterations_per_step=5,
            flow_mean="rays",
            extensions={"tracks": StartAlongFlow("flow")},
        )

    def learn(
        self,
        stage: Stage,
        *callbacks: Callback,
        exact: bool = False,
        resumed_from: str | None = None,
    ) -> None:
        """Learn all of ``stage``, from the same random state each time.

        ``exact`` is what deterministic=true runs.
        """
        seed_everything(self.seed, verbose=False)
        gpu = self.device.type == "cuda"
        trainer = Trainer(
            accelerator="gpu" if gpu else "cpu",
            devices=[self.device.index or 0] if gpu else 1,
            deterministic=exact,
            max_epochs=1,
            callbacks=[GridUpscaling(), LearningRateDecay(), *callbacks],
            logger=False,
            enable_checkpointing=False,
            enable_progress_bar=False,
            enable_model_summary=False,
        )
        try:
            trainer.fit(stage, datamodule=self.data, ckpt_path=resumed_from)
        finally:
            torch.use_deterministic_algorithms(False)


def short(schedule: CanonicalSchedule, iterations: int) -> CanonicalSchedule:
    """Few iterations, at all resolutions of ``schedule``, from the visual hull on."""
    growths = len(schedule.upsample_at)
    return replace(
        schedule,
        visual_hull_init=True,
        min_views=1,
        iterations=iterations,
        upsample_at=[iterations * k // (growths + 1) for k in range(1, growths + 1)],
        decay_iterations=iterations,
    )


def small_scene(device: torch.device, seed: int = 0) -> SmallScene:
    """The scene for a device: a GPU learns what ``experiment=paper`` does, for a moment.

    Grids, batches, networks and levels are the paper's; images are small, iterations are few, and
    coarse geometry begins with the visual hull, because it has no time to be found. On a CPU all
    is tiny.
    """
    robot = partial(ProceduralDataModule, static_test_views=1, train_views=3, supersample=1)
    if device.type != "cuda":
        data = robot(width=24, height=18, static_views=8, frames=3)
        tiny = CanonicalSchedule(0, search_side=12, side=16, upsample_at=[10], rays=192)
        deformation = DeformationSchedule([Level(4, 5), Level(6, 2)], rays=192)
        return SmallScene(
            device,
            data,
            at_rest=short(tiny, 20),
            deformation=deformation,
            architecture=Architecture(width=16),
            sampling=Sampling(alpha_threshold=3e-3),
            seed=seed,
        )
    data = robot(width=96, height=72, static_views=24, frames=9)
    levels = [replace(level, iterations=20) for level in PAPER_LEVELS]
    at_rest = replace(short(CanonicalSchedule(), 250), search_iterations=20)
    # Fog that twenty iterations of the search can clear.
    architecture = Architecture(search_alpha_init=1e-2)
    return SmallScene(
        device,
        data,
        at_rest=at_rest,
        deformation=DeformationSchedule(levels),
        architecture=architecture,
        sampling=Sampling(),
        seed=seed,
    )


def require(condition: bool, message: str) -> None:
    """Fail the check unless ``condition`` holds."""
    if not condition:
        raise DevrfError(message)


def require_gpu(scene: SmallScene, reason: str) -> None:
    """Skip the check unless the device is a GPU."""
    if scene.device.type != "cuda":
        raise CheckSkippedError(f"needs a GPU: {reason}")


def resume(scene: SmallScene, name: str) -> str:
    """Whether a stage that SIGTERM stops goes on to equal bits with ``deterministic=true``."""
    uninterrupted, first, second = (scene.stage(name) for _ in range(3))
    scene.learn(uninterrupted, exact=True)

    def interrupt(*_: Any) -> None:
        if 0 <= first.position.iteration - first.schedule.total // 2 < first.iterations_per_step:
            os.kill(os.getpid(), signal.SIGTERM)

    with tempfile.TemporaryDirectory() as folder:
        saving = PeriodicCheckpoint(folder, every_seconds=math.inf)
        with StopOnSignal(saving) as stop:
            sender = LambdaCallback(on_train_batch_start=interrupt)
            scene.learn(first, saving, stop, sender, exact=True)
        files = progress_files(Path(folder), name)
        done, total = first.position.iteration, first.schedule.total
        stopped = f"stopped at iteration {done} of {total}"
        interrupted = stop.number is not None and 0 < done < total
        require(interrupted and bool(files), f"{stopped}, {len(files)} progress files")
        scene.learn(second, exact=True, resumed_from=str(files[0]))
    ended = second.position.iteration
    require(ended == uninterrupted.position.iteration, f"ended at iteration {ended}")
    pairs = zip(uninterrupted.state_dict().values(), second.state_dict().values(), strict=True)
    same = all(torch.equal(a, b) for a, b in pairs if isinstance(a, torch.Tensor))
    require(same, f"{stopped}, came to other fields")
    return f"{stopped}, equal bits"


# Grey levels by which a GPU's picture may be off a CPU's in the mean: a sample at a threshold may
# be kept by one alone.
PICTURE_LIMIT = 1e-3


def rendering(scene: SmallScene) -> str:
    """Whether the device shows what a CPU shows."""
    require_gpu(scene, "it is compared with a CPU")
    stage = scene.stage("deformation")
    scene.learn(stage)
    model = stage.current_model()
    assert isinstance(model, DeVRFModel)
    views = scene.data.scene.dynamic.test
    background = background_value(scene.data.scene.background)
    last = len(views) - 1

    def picture(device: torch.device) -> torch.Tensor:
        renderer = Renderer(copy.deepcopy(model).to(device))
        image = renderer.view(views.cameras, last, float(views.times[last]), background)
        return image.color.cpu()

    off = float((picture(scene.device) - picture(torch.device("cpu"))).abs().mean())
    require(off <= PICTURE_LIMIT, f"{off:.2g} off the CPU's picture")
    return f"{off:.2g} off the CPU's picture"


CHECKS: dict[str, Callable[[SmallScene], str]] = {
    "resume canonical": partial(resume, name="canonical"),
    "resume deformation": partial(resume, name="deformation"),
    "rendering": rendering,
}


def run_checks(device: torch.device, seed: int) -> Iterator[tuple[str, str, str]]:
    """Name, verdict (passed, skipped or failed), and figures or reason of each check.

    Args:
        device: what is checked.
        seed: of what is learned.
    """
    scene = small_scene(device, seed)
    for name, check in CHECKS.items():
        try:
            yield name, "passed", check(scene)
        except CheckSkippedError as reason:
            yield name, "skipped", str(reason)
        except Exception as error:
            log.debug("%s", name, exc_info=True)
            yield name, "failed", " ".join(f"{type(error).__name__}: {error}".split())
