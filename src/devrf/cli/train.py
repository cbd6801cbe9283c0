"""The stages that learn."""

from __future__ import annotations

import logging
import math
import signal
import traceback
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from hydra.utils import instantiate
from lightning import Callback, Trainer
from lightning.fabric.utilities.exceptions import MisconfigurationException
from lightning.pytorch.callbacks import ModelCheckpoint
from omegaconf import OmegaConf

from devrf.apps.records import in_words
from devrf.apps.rehearsal import RehearsedStage
from devrf.callbacks import (
    GridUpscaling,
    LearningRateDecay,
    PeriodicCheckpoint,
    StopOnSignal,
    TrainingRecord,
)
from devrf.cli.context import RunContext
from devrf.cli.resume import ResumePoint, beginning, remove_progress
from devrf.engine.stage import Stage, fit
from devrf.errors import DevrfError, expect
from devrf.loggers.csv_logger import ResumableCSVLogger
from devrf.system.files import atomic_write
from devrf.system.process import Interrupted

log = logging.getLogger(__name__)

# Keys of the trainer that may end learning before its schedule, and their values that do not.
LIMITS: dict[str, Any] = {"max_epochs": 1, "max_steps": -1}
LIMITS |= dict.fromkeys(("max_time", "limit_train_batches", "overfit_batches"))


def learn(run: RunContext, name: str) -> None:
    """Learn a stage of the protocol, or the rest of it."""
    begin: ResumePoint | None = ResumePoint({})  # of a trial
    if not run.is_trial:
        begin = run.strategy.broadcast(beginning(run, name) if run.is_rank_zero else None)
    if begin is None:
        return
    build = run.plan_to_learn(name).build
    below = run.protocol[name].builds_on
    if below is None:
        stage = build()
    else:
        rest = run.tried.get(below) or run.load(below, run.scene)
        before = rest.metadata
        if before.stage != below:
            needed = f"stage={name} needs a checkpoint of the {below} stage"
            raise DevrfError(f"ckpt: {needed}, not of the {before.stage} stage")
        stage = build(earlier=rest)
        stage.provenance.earlier_configs = {**before.earlier_configs, below: before.training_config}
    stage.provenance.protocol = run.protocol.name
    stage.time_share = run.protocol.time_share(name, run.stages_with_images)
    stage.provenance.command = run.command
    _fit(run, stage, begin)


def _fit(run: RunContext, stage: Stage, begin: ResumePoint) -> None:
    if run.is_rank_zero:
        _ = run.scene  # errors in it come before a logger writes files
    stage.provenance.training_config = begin.training_config
    # The clock stops before curves are drawn.
    configured: dict[str, Callback | None] = (
        instantiate(run.config.callbacks, _convert_="all")
        if "callbacks" in run.config
        else {"grid_upscaling": GridUpscaling(), "learning_rate_decay": LearningRateDecay()}
    )
    for key, callback in configured.items():
        is_one = callback is None or isinstance(callback, Callback)
        expect(is_one, f"callbacks.{key}", "one of Lightning's callbacks", repr(callback))
    callbacks = [TrainingRecord(), *filter(None, configured.values())]
    saving = next((hook for hook in callbacks if isinstance(hook, PeriodicCheckpoint)), None)
    if saving is None:  # no periodic files, but still one at a signal
        saving = PeriodicCheckpoint(run.folder / "checkpoints", every_seconds=math.inf)
        callbacks.append(saving)
    if run.config.viewer.training and run.is_rank_zero:
        from devrf.apps.viewer.live_view import LiveView  # an extra

        callbacks.append(LiveView(run.page, run.config.viewer.share))
    with StopOnSignal(saving) as stop:
        trainer: Trainer = instantiate(
            run.config.trainer,
            _convert_="all",
            callbacks=[*callbacks, stop],
            logger=run.loggers,
            default_root_dir=str(run.folder),
            enable_checkpointing=any(isinstance(hook, ModelCheckpoint) for hook in callbacks),
        )
        for logger in run.loggers:
            if isinstance(logger, ResumableCSVLogger):
                logger.drop_rows_beyond(stage.capture, begin.iterations_done)
        with _named(configured):
            fit(trainer, stage, run.datamodule, begin.progress)
        strategy = trainer.strategy
        stopping = strategy.reduce_boolean_decision(stop.number is not None, all=False)
        finished = stage.is_complete
        if run.is_rank_zero and finished and not run.is_trial:
            _save_final(run, trainer, stage)
        strategy.barrier("the checkpoint is written")
    if run.rehearses:
        run.rehearsed[stage.name] = RehearsedStage(
            capture=stage.capture,
            iterations=stage.position.iterations_done,
            whole=run.plan(stage.name).iterations(run.scene),
            events={name: count for name, count in stage.events.items() if count},
            planned=dict(stage.schedule.planned_events),
        )
    where = saving.left_at(stage)
    if stopping:
        again = "run the same command again to go on"
        raise Interrupted(stop.number or signal.SIGTERM, f"interrupted at {where}; {again}")
    if run.is_trial:
        run.tried[stage.name] = stage.result()
        if run.is_rank_zero:
            tried = stage.position.iteration
            total = stage.schedule.total
            log.info("%s: a trial, %d of %d iterations; nothing is kept", stage.name, tried, total)
    elif not finished:
        asked = run.config.trainer
        limits = [f"trainer.{k}={asked[k]}" for k, v in LIMITS.items() if asked.get(k, v) != v]
        again = "goes on" if limits else "goes on, or asks for resume=false"
        ended = f"learning has ended at {where}; the same command without it {again}"
        raise DevrfError(f"{', '.join(limits) or 'callbacks'}: {ended}")


@contextmanager
def _named(callbacks: Mapping[str, Callback | None]) -> Iterator[None]:
    """Say it if an error comes from a callback that is not devrf's; run.log has its traceback.

    Raises:
        DevrfError: naming the callback's key, its method and the error; or a setting of the trainer
            that Lightning refuses.
    """
    own = {
        id(callback): f"callbacks.{name}: {type(callback).__qualname__}"
        for name, callback in callbacks.items()
        if not type(callback).__module__.startswith("devrf.")
    }
    try:
        yield
    except DevrfError:
        raise
    except Exception as error:
        for frame, _ in traceback.walk_tb(error.__traceback__):
            if callback := own.get(id(frame.f_locals.get("self"))):
                log.error("a callback failed", exc_info=error)
                said = f"{type(error).__name__}: {error}"
                raise DevrfError(f"{callback}.{frame.f_code.co_name} failed ({said})") from error
        if isinstance(error, MisconfigurationException):
            raise DevrfError(f"trainer: {error}") from error
        raise


def _save_final(run: RunContext, trainer: Trainer, stage: Stage) -> None:
    """Write the stage's checkpoint, and the config that it was learned with."""
    path = run.own_checkpoint(stage.name)
    # Goes into the checkpoint, so without the time of writing it.
    stage.provenance.record["wall_seconds"] = run.step_seconds
    try:
        trainer.save_checkpoint(path, weights_only=True)
        with atomic_write(path.with_name("config.yaml")) as partial:
            OmegaConf.save(run.config, partial, resolve=True)
    except OSError as error:
        again = "make it possible to write there, and run the same command again"
        raise DevrfError(f"{error.filename or path}: {error.strerror}; {again}") from error
    remove_progress(path.parent, stage.name)
    log.info("%s: %s; written to %s", stage.name, in_words(stage.provenance.record), path)
