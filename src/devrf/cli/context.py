"""A run's config and folder, and the parts that its steps share."""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from contextlib import ExitStack
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra.utils import instantiate
from lightning import Trainer
from lightning.pytorch.loggers import Logger
from lightning.pytorch.strategies import Strategy
from omegaconf import DictConfig, OmegaConf

import devrf
from devrf.apps.records import git_revision
from devrf.apps.rehearsal import LONGEST, RehearsedStage, for_rehearsal
from devrf.checkpoints.checkpoint import (
    LoadedCheckpoint,
    Viewpoints,
    learned_with,
    load_checkpoint,
    metadata_of,
)
from devrf.checkpoints.file_metadata import OWN_REST, digest_of
from devrf.checkpoints.progress import progress_files
from devrf.cli.config import PIPELINE, choices, overrides, scene_name, stage_section
from devrf.cli.restore_config import present_command
from devrf.data.datamodule import SceneDataModule
from devrf.engine.ddp import check_strategy
from devrf.engine.needs import SIZE
from devrf.engine.plan import StagePlan
from devrf.engine.protocol import Protocol
from devrf.engine.stage import Stage
from devrf.errors import DevrfError, expect
from devrf.evaluation.objective import VALIDATION
from devrf.evaluation.suite import Evaluation
from devrf.loggers.trackers import Tracker, trackers
from devrf.scenes.scene import Scene

if TYPE_CHECKING:
    from devrf.apps.viewer.session import Session

log = logging.getLogger(__name__)

# Keys of Lightning's trainer that have no effect here, and what has one.
OF_THE_RUN = {
    "logger": "a run sets it itself; logger=NAME chooses it",
    "callbacks": "a run sets them itself; +callbacks.NAME._target_=CLASS adds one",
    "default_root_dir": "a run sets it itself; hydra.run.dir=FOLDER is its folder",
    "enable_checkpointing": "a run sets it itself; a ModelCheckpoint among callbacks turns it on",
    "accumulate_grad_batches": "stages take optimiser steps of their own; schedule.canonical.rays, "
    "schedule.deformation.rays or ray_stage.schedule.rays sizes batches",
    "gradient_clip_val": "stages take optimiser steps of their own; callbacks.divergence_guard "
    "lowers the learning rates",
}


class RunContext(ExitStack):
    """A composed config, the run's folder, and parts that are built when first used.

    As a context manager it ends the viewer's page, and the tracking of the run, if they began.

    Attributes:
        config: a composed config (``conf/config.yaml``).
        folder: gets ``checkpoints/<stage>.ckpt``, ``metrics.json``, ``frames.csv``, ``images/`` and
            ``videos/``, next to Hydra's config and log.
        place: the folder as a command names it: relative, where it is below the working folder.
        command: options and values that this run is learned with, as composed.
        protocol: the stages, their data, and the parts of the method that they train.
        learning_stages: names of the protocol's stages, in their order.
        evaluation: the metrics on held-out views.
        strategy: the configured trainer's: its device, rank and number of processes.
        is_rank_zero: whether this process writes files and logs: rank 0, or the only one.
        device: the trainer's.
        rehearses: whether ``rehearse=true`` asks for all that the run does, in minutes.
        rehearsed: what the stages of a rehearsal came to, by name.
        whole_scene: in a rehearsal, the scene with images of their own size, until what the run
            itself needs has been estimated.
        is_trial: whether ``trainer.fast_dev_run`` asks for a step of each stage, with nothing kept.
        tried: the results of a trial's stages, by name.
        left_out: checkpoints of the folder that build on others than the run's.
        chooses_size: whether the images' size is left to this run.
        step_began: the end of the step before; of the first step, the start of the run.
    """

    def __init__(self, config: DictConfig, folder: Path) -> None:
        super().__init__()
        self.command = present_command(config)
        config.scene = scene_name(config)
        self.config = config
        self.folder = folder
        self.place = folder.relative_to(Path.cwd()) if Path.cwd() in folder.parents else folder
        self.protocol: Protocol = instantiate(config.protocol, _convert_="all")
        self.learning_stages = tuple(self.protocol.stages)
        self.evaluation: Evaluation = instantiate(config.evaluation, _convert_="all")
        self.strategy = _strategy(config)
        self.is_rank_zero = bool(self.strategy.is_global_zero)
        self.device = self.strategy.root_device
        self.rehearses = bool(config.rehearse)
        self.rehearsed: dict[str, RehearsedStage] = {}
        self.whole_scene: Scene | None = None
        if self.rehearses:  # its schedules are short enough, its pictures small
            config.schedule.seconds = None
            config.still.height = config.still.height or LONGEST
        self.is_trial = bool(config.trainer.get("fast_dev_run"))
        self.tried: dict[str, LoadedCheckpoint] = {}
        self.left_out: set[Path] = set()
        self.chooses_size = False
        self.step_began = time.perf_counter()

    @property
    def step_seconds(self) -> float:
        """Wall clock since the step before ended; of the first step, since the run began."""
        return round(time.perf_counter() - self.step_began, 2)

    @cached_property
    def datamodule(self) -> SceneDataModule:
        """Serves the scene to the stages, its images of the size that is learned already."""
        data = self.config.data
        if data.get("downscale") == "auto":
            anew = self.config.stage == PIPELINE and not self.config.resume
            settings = {} if anew else learned_with(self.folder, self.config.ckpt)
            data.downscale = settings.get(SIZE, "gpu" if self.device.type == "cuda" else "cpu")
            self.chooses_size = SIZE not in settings
        built: SceneDataModule = instantiate(data)
        built.priors = self.config.priors
        built.validation = self.config.objective.startswith(f"{VALIDATION}.")
        if self.rehearses:
            built.change = self._rehearsed_scene
        return built

    def _rehearsed_scene(self, scene: Scene) -> Scene:
        self.whole_scene = scene
        return for_rehearsal(scene)

    @property
    def scene(self) -> Scene:
        """The scene; the config then has the factor by which its images were made smaller."""
        scene = self.datamodule.scene
        if self.chooses_size:
            self.config.data.downscale = self.datamodule.downscale
        return scene

    @property
    def stages_with_images(self) -> tuple[str, ...]:
        """The protocol's stages; of a scene at rest those that learn from the static set alone."""
        order = self.protocol.order
        return tuple(stage.name for stage in order if stage.capture == "static" or self.moves)

    @property
    def moves(self) -> bool:
        """Whether the scene moves; the scene is read, unless a checkpoint says so."""
        for path in map(self.own_checkpoint, self.learning_stages if self.config.resume else ()):
            moves = metadata_of(path).moves if path.is_file() else None
            if moves is not None:
                return moves
        return self.scene.moves

    def learnable(self, names: Sequence[str]) -> tuple[str, ...]:
        """Those of the stages ``names`` that the scene has images for.

        Raises:
            DevrfError: there is none.
        """
        if learnable := tuple(name for name in names if name in self.stages_with_images):
            return learnable
        at_rest = f"{self.config.scene} is at rest: all its images show one moment"
        if self.stages_with_images:
            raise DevrfError(f"stage={names[0]}: learns motion, but {at_rest}; use stage=pipeline")
        what = f"protocol={self.protocol.name}: learns from images in motion"
        raise DevrfError(f"{what}, but {at_rest}; use protocol=two_stage")

    def plan(self, name: str) -> StagePlan:
        """The plan of a stage of the protocol.

        Raises:
            DevrfError: the method has no such stage, or cannot learn by the protocol.
        """
        section = stage_section(self.config, name)
        if section not in self.config:
            does = f"method={self.config.method} does not learn by protocol={self.protocol.name}"
            raise DevrfError(f"protocol: {does}; it has no stage {name!r}")
        stage: partial[Stage] = instantiate(self.config[section], _partial_=True, _convert_="all")
        kind: type[StagePlan] = stage.func.plan  # type: ignore[attr-defined]
        plan = kind(stage.func, stage.keywords, self.protocol, name)
        plan.check()
        return plan

    def plan_to_learn(self, name: str) -> StagePlan:
        """The plan of a stage as this run learns it: of a rehearsal small.

        Each call makes parts anew: networks draw their first weights as they are made.
        """
        plan = self.plan(name)
        return plan.rehearsed() if self.rehearses else plan

    @cached_property
    def loggers(self) -> list[Logger]:
        """The loggers of all steps; none in a trial, in a rehearsal, in processes but rank 0.

        Giving a tracker the config begins its run: use them once the config has been checked.
        """
        if not self.is_rank_zero or self.is_trial or self.rehearses:
            return []
        built = instantiate(self.config.get("logger"), _convert_="all") or {}
        for key, logger in built.items():
            is_one = logger is None or isinstance(logger, Logger)
            expect(is_one, f"logger.{key}", "one of Lightning's loggers", repr(logger))
        loggers: list[Logger] = [*filter(None, built.values())]
        for tracker in trackers(loggers):
            self.push(lambda error, *_, ends=tracker: ends.close(failed=error is not None))
        settings: Any = OmegaConf.to_container(self.config, resolve=True)
        settings |= {"choices": choices(), "overrides": overrides()}
        settings |= {"devrf": devrf.__version__, "git": git_revision()}
        for logger in loggers:
            logger.log_hyperparams(settings)
        return loggers

    @property
    def trackers(self) -> list[Tracker]:
        """The loggers that take images, videos and tables."""
        return trackers(self.loggers)

    @cached_property
    def page(self) -> Session:
        """The page that shows the scene while it is learned; opened when first used."""
        from devrf.apps.viewer.session import Session  # an extra

        settings = instantiate(self.config.viewer)
        session = Session(settings, Viewpoints.of(self.scene), self.scene, self.folder)
        self.callback(session.close)
        log.info("the scene is at %s while it is learned", settings.address)
        return session

    def own_checkpoint(self, name: str) -> Path:
        """The run's checkpoint of the stage ``name``, whether it exists or not."""
        return self.folder / "checkpoints" / f"{name}.ckpt"

    def checkpoint(self, name: str | None = None) -> Path:
        """The checkpoint ``ckpt``, else the run's own of a stage.

        By default of the last stage, which may be a progress file. A file that builds on another
        checkpoint than the run's is passed over.

        Raises:
            DevrfError: there is none.
        """
        if (given := self.config.ckpt) is not None:
            if not Path(given).is_file():
                raise DevrfError(f"{given}: no such checkpoint; set ckpt to a file")
            return Path(given)
        for stage in self.learning_stages[::-1] if name is None else (name,):
            path = self.own_checkpoint(stage)
            unfinished = progress_files(path.parent, stage) if name is None else []
            for file in [path, *unfinished]:
                if file.exists() and not self._is_of_another(file, stage):
                    return file
        raise DevrfError(f"{path}: no such checkpoint; run stage={stage} first, or give ckpt=PATH")

    def _is_of_another(self, file: Path, stage: str) -> bool:
        """Whether a stage's file builds on another checkpoint than the run's; says so once."""
        below = self.protocol[stage].builds_on
        if below is None or not (base := self.own_checkpoint(below)).is_file():
            return False
        rest = metadata_of(file).training_config.get(OWN_REST)
        if not rest or digest_of(base) == rest:
            return False
        if file not in self.left_out:
            self.left_out.add(file)
            log.info("%s: left out, it belongs to another %s.ckpt than the run's", file, below)
        return True

    def load(self, name: str | None = None, scene: Scene | None = None) -> LoadedCheckpoint:
        """Load :meth:`checkpoint`, which has to be of the ``scene``; None takes any."""
        return load_checkpoint(self.checkpoint(name), scene, self.device)


def _strategy(config: DictConfig) -> Strategy:
    """The configured trainer's strategy.

    Raises:
        DevrfError: several processes without ``trainer=ddp``, or a key that has no effect.
    """
    for key, instead in OF_THE_RUN.items():
        if key in config.trainer:
            raise DevrfError(f"trainer.{key}: {instead}; leave it out")
    trainer: Trainer = instantiate(config.trainer, logger=False, _convert_="all")
    check_strategy(trainer)
    return trainer.strategy
