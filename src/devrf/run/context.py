"""What the steps of a run share: its config and folder, and what is built from them once."""

from __future__ import annotations

import logging
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from hydra.utils import instantiate
from lightning import Trainer
from omegaconf import DictConfig

from devrf.data.datamodule import SceneDataModule
from devrf.errors import DevrfError
from devrf.scenes.scene import Scene
from devrf.stages.checkpoint import Stored, load_checkpoint
from devrf.stages.evaluation import Evaluation
from devrf.stages.sealed_file import digest_of

log = logging.getLogger(__name__)

# What a deformation was learned on, among the settings it was made with: the digest of the run's
# own canonical field, or of one that was given.
OWN_REST, GIVEN_REST = "checkpoints/canonical.ckpt", "ckpt"


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
        """The tracker of the whole run, one for both stages."""
        return instantiate(self.config.logger)

    @cached_property
    def device(self) -> torch.device:
        """Where the configured trainer would work."""
        trainer: Trainer = instantiate(self.config.trainer, logger=False)
        device: torch.device = trainer.strategy.root_device
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

    def load(self, *names: str) -> Stored:
        """What a stage learned of this run's scene; ``names`` as for :meth:`checkpoint`.

        A deformation of another canonical field than the run's is passed over.
        """
        path = self.checkpoint(*names)
        stored = load_checkpoint(path, self.scene)
        own = self.own_checkpoint("canonical")
        rest = stored.passport.made_with.get(OWN_REST)
        if self.config.ckpt is None and rest and own.is_file() and digest_of(own) != rest:
            log.info("%s: left out, it belongs to another canonical field than the run's", path)
            return load_checkpoint(own, self.scene)
        return stored
