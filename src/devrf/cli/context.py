"""What the steps of a run share: its config and folder, and what is built from them once."""

from __future__ import annotations

import logging
import time
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from hydra.utils import instantiate
from lightning import Trainer
from lightning.pytorch.strategies import Strategy
from omegaconf import DictConfig, OmegaConf

from devrf.artifacts.tracking import Tracker, trackers
from devrf.checkpoints.checkpoint import LoadedCheckpoint, load_checkpoint
from devrf.checkpoints.checkpoint_file import digest_of
from devrf.data.datamodule import SceneDataModule
from devrf.engine.ddp import ManualDDP
from devrf.errors import DevrfError
from devrf.evaluation.suite import Evaluation
from devrf.scenes.scene import Scene

log = logging.getLogger(__name__)

# What a deformation was learned on, among the settings it was made with: the digest of the run's
# own canonical field, or of one that was given.
OWN_REST, GIVEN_REST = "checkpoints/canonical.ckpt", "ckpt"

# Stages that no checkpoint is of use to, and that begin a run of their own.
FROM_NOTHING = ("prepare", "inspect", "canonical", "pipeline", "report")


class RunContext:
    """A composed config, the run's folder, and the parts that more than one step needs.

    A part is built when it is first asked for: a step that needs no scene reads none.

    Attributes:
        config: a composed config (``conf/config.yaml``).
        folder: where the run works: ``checkpoints/canonical.ckpt`` and ``deformation.ckpt``,
            ``metrics.json``, ``frames.csv``, ``images/`` and ``videos/``, next to the composed
            config and the log that Hydra writes.
    """

    def __init__(self, config: DictConfig, folder: Path) -> None:
        self.config = config
        self.folder = folder
        self._began = time.perf_counter()
        self._stepping = False

    def begin_step(self) -> None:
        """Start the clock of a step; the first one's runs since the scene was read."""
        if self._stepping:
            self._began = time.perf_counter()
        self._stepping = True

    @property
    def step_seconds(self) -> float:
        """Wall clock since the present step began: reading, learning, scoring, writing."""
        return round(time.perf_counter() - self._began, 2)

    @cached_property
    def datamodule(self) -> SceneDataModule:
        """Serves the scene to the stages."""
        built: SceneDataModule = instantiate(self.config.data)
        return built

    @property
    def scene(self) -> Scene:
        """The scene, read when it is first needed."""
        return self.datamodule.scene

    @cached_property
    def logger(self) -> Any:
        """What logs the whole run, one for all its steps; of several processes, rank 0's.

        A tracker is told the config, which begins its run: nothing should be wrong any more.
        """
        if not self.leads:
            return False
        logger = instantiate(self.config.logger)
        for tracker in trackers([logger]):
            settings = OmegaConf.to_container(self.config, resolve=True)
            assert isinstance(settings, dict)
            tracker.log_hyperparams({str(key): value for key, value in settings.items()})
        return logger

    @property
    def trackers(self) -> list[Tracker]:
        """The logger, if it takes pictures, videos and tables."""
        return trackers([self.logger])

    def close(self, *, failed: bool) -> None:
        """End the tracking of the run, if it began."""
        if "logger" in self.__dict__:
            for tracker in self.trackers:
                tracker.close(failed=failed)

    @cached_property
    def strategy(self) -> Strategy:
        """How the configured trainer would work: on which device, in which process of how many.

        Raises:
            DevrfError: in several processes, but not as the stages need it.
        """
        trainer: Trainer = instantiate(self.config.trainer, logger=False)
        if trainer.world_size > 1 and not isinstance(trainer.strategy, ManualDDP):
            raise DevrfError(
                f"trainer.devices: {trainer.world_size} processes need trainer=ddp; give both"
            )
        return trainer.strategy

    @property
    def leads(self) -> bool:
        """Whether this process writes files and says what happens: rank 0, or the only one."""
        return bool(self.strategy.is_global_zero)

    @property
    def device(self) -> torch.device:
        """Where the configured trainer would work."""
        device: torch.device = self.strategy.root_device
        return device

    @cached_property
    def evaluation(self) -> Evaluation:
        """What is measured on held-out views."""
        chosen: Evaluation = instantiate(self.config.evaluation, _convert_="all")
        return chosen

    def own_checkpoint(self, name: str) -> Path:
        """Where this run keeps what the stage ``name`` learned."""
        return self.folder / "checkpoints" / f"{name}.ckpt"

    def checkpoint(self, *names: str) -> Path:
        """The checkpoint that was asked for, else the first of ``names`` that the run has.

        Raises:
            DevrfError: there is none.
        """
        if self.config.ckpt is not None:
            if not Path(self.config.ckpt).is_file():
                raise DevrfError(f"{self.config.ckpt}: no such checkpoint; set ckpt to a file")
            return Path(self.config.ckpt)
        found = [path for path in map(self.own_checkpoint, names) if path.exists()]
        if not found:
            raise DevrfError(
                f"{self.own_checkpoint(names[-1])}: no such checkpoint; run stage={names[-1]} "
                "first, or give ckpt=PATH"
            )
        return found[0]

    def load(self, *names: str) -> LoadedCheckpoint:
        """What a stage learned of this run's scene; ``names`` as for :meth:`checkpoint`.

        A deformation of another canonical field than the run's is passed over.
        """
        path = self.checkpoint(*names)
        stored = load_checkpoint(path, self.scene)
        own = self.own_checkpoint("canonical")
        rest = stored.metadata.training_config.get(OWN_REST)
        if self.config.ckpt is None and rest and own.is_file() and digest_of(own) != rest:
            log.info("%s: left out, it belongs to another canonical field than the run's", path)
            return load_checkpoint(own, self.scene)
        return stored
