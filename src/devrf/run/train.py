"""The steps that learn: ``stage=canonical`` and ``stage=deformation``."""

from __future__ import annotations

import logging

from hydra.utils import instantiate
from lightning import Trainer

from devrf.artifacts.records import in_words
from devrf.callbacks import TrainingRecord
from devrf.errors import DevrfError
from devrf.run.context import RunContext
from devrf.stages.checkpoint import save_checkpoint
from devrf.stages.stage import ScheduledStage

log = logging.getLogger(__name__)


def canonical(run: RunContext) -> None:
    """Learn the scene at rest."""
    _fit(run, instantiate(run.config.canonical, _convert_="all"), "canonical")


def deformation(run: RunContext) -> None:
    """Learn how the scene moves, on top of a canonical checkpoint."""
    rest = run.load("canonical")
    if rest.model.deformation is not None:
        raise DevrfError(
            "ckpt: stage=deformation needs a canonical checkpoint, not a deformation's"
        )
    build = instantiate(run.config.deformation, _partial_=True, _convert_="all")
    _fit(run, build(rest=rest), "deformation")


def _fit(run: RunContext, stage: ScheduledStage, name: str) -> None:
    if run.leads:
        _ = run.scene  # what is wrong with it is said before a logger writes files
    callbacks = [*instantiate(run.config.callbacks).values(), TrainingRecord()]
    trainer: Trainer = instantiate(
        run.config.trainer, callbacks=callbacks, logger=run.logger,
        default_root_dir=str(run.folder),
    )
    trainer.fit(stage, datamodule=run.datamodule)
    if trainer.interrupted:
        raise KeyboardInterrupt
    # The checkpoint carries it to whoever scores the run, hence without its own writing.
    stage.record["wall_seconds"] = run.step_seconds
    path = run.own_checkpoint(name)
    if run.leads:
        save_checkpoint(trainer, path)
        log.info("%s: %s; written to %s", name, in_words(stage.record), path)
    trainer.strategy.barrier("the checkpoint is written")
