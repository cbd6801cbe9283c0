"""The steps of ``stage=…``, in which order, after which checks."""

from __future__ import annotations

import json
import logging
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from hydra.utils import instantiate
from lightning import seed_everything
from omegaconf import DictConfig

from devrf.cli import job
from devrf.cli.context import RunContext
from devrf.cli.evaluate import evaluate
from devrf.cli.inspect_scene import inspect, prepare
from devrf.cli.objective import check_objective, objective
from devrf.cli.preflight import preflight, shortage_in_words
from devrf.cli.render import picture, render
from devrf.cli.report import report
from devrf.cli.resume import archive_previous
from devrf.cli.train import learn
from devrf.cli.workers import launch_workers
from devrf.errors import DevrfError
from devrf.methods.devrf.losses import GRID_TERMS, MOTION_TERMS, WeightedLoss
from devrf.ops.dispatch import using

log = logging.getLogger(__name__)

Step = Callable[[RunContext], None]

# Stages that learn nothing; the protocol's stages come beside these.
STEPS: dict[str, Step] = {
    "prepare": prepare,
    "inspect": inspect,
    "evaluate": evaluate,
    "render": render,
    "still": picture,
    "report": report,
}
PIPELINE = ("evaluate", "render")
# Steps that use no checkpoint.
FROM_NOTHING = {"prepare", "inspect", "report"}
MOVED = {"benchmark": "run python benchmarks/training.py with the other overrides"}

# Lightning's messages on accelerators, tips and data loaders say nothing about this run.
for _name in ("lightning.pytorch", "lightning.fabric"):
    logging.getLogger(_name).setLevel(logging.WARNING)
_IGNORED = "many workers|LeafSpec|GPU available but not used|Experiment logs directory"
warnings.filterwarnings("ignore", message=f".*({_IGNORED})")


@dataclass(frozen=True)
class Plan:
    """What ``stage=…`` asks for.

    Attributes:
        learning: stages of the protocol, learned by all processes.
        further: steps after them, of rank 0 alone.
    """

    learning: tuple[str, ...]
    further: tuple[str, ...]


def plan(stage: str, protocol: Sequence[str]) -> Plan:
    """The steps of ``stage``; ``protocol`` names the stages that learn.

    Raises:
        DevrfError: there is no such stage.
    """
    if stage == "pipeline":
        return Plan(tuple(protocol), PIPELINE)
    if stage in protocol:
        return Plan((stage,), ())
    if stage in STEPS:
        return Plan((), (stage,))
    if stage in MOVED:
        raise DevrfError(f"stage={stage}: moved; {MOVED[stage]}")
    known = ", ".join(["pipeline", *protocol, *STEPS])
    raise DevrfError(f"stage: expected one of {known}, not {stage!r}")


def run_stage(config: DictConfig, folder: Path) -> float | None:
    """Do what ``stage=…`` asks for, in the run's folder.

    Args:
        config: a composed config (``conf/config.yaml``).
        folder: the run's folder.

    Returns:
        The objective; None where nothing was scored.

    Raises:
        DevrfError: the input is wrong.
    """
    run = RunContext(config, folder)
    asked = plan(config.stage, run.learning_stages)
    _check(run, asked)
    needs = None
    if asked.learning and config.memory_check and run.leads:
        needs = preflight(run, asked.learning, films="render" in asked.further)
    if asked.learning and not config.resume:
        below = run.protocol[asked.learning[0]].builds_on
        archive_previous(folder, *([] if below is None else [run.own_checkpoint(below)]))
    if needs is not None:
        log.info("%s", needs)
    ended = False
    try:
        if asked.learning:
            with launch_workers(run, learn_all):
                _learn(run, asked)
        if not asked.learning or run.leads:
            for name in asked.further:
                _take(run, name, STEPS[name])
        ended = True
    finally:
        run.close(failed=not ended)
    if "evaluate" not in asked.further or not run.leads:
        return None
    return objective(config.objective, json.loads((folder / "metrics.json").read_text()))


def learn_all(config: DictConfig, folder: Path) -> None:
    """Learn the stages of ``stage=…`` in another process than rank 0; the config is checked."""
    run = RunContext(config, folder)
    with launch_workers(run, learn_all):
        _learn(run, plan(config.stage, run.learning_stages))


def _learn(run: RunContext, asked: Plan) -> None:
    for name in asked.learning:
        _take(run, name, partial(learn, name=name))


def _take(run: RunContext, name: str, step: Step) -> None:
    seed_everything(run.config.seed, verbose=False)
    run.begin_step()
    with using(run.config.kernels), shortage_in_words(name, run):
        step(run)


def _check(run: RunContext, asked: Plan) -> None:
    """Find errors in the config of every step before the first begins."""
    config = run.config
    begins = asked.learning and run.protocol[asked.learning[0]].builds_on is None
    if config.ckpt is not None and (begins or not FROM_NOTHING.isdisjoint(asked.further)):
        raise DevrfError(
            f"ckpt: stage={config.stage} starts from nothing; with ckpt=PATH give a stage that "
            "builds on another, stage=evaluate, stage=render or stage=still"
        )
    if "report" in asked.further:
        return
    _ = run.datamodule
    for name in run.learning_stages:
        run.stage_builder(name)
    if "deformation" in config:
        weights = {k: v for k, v in config.deformation.loss.items() if k not in GRID_TERMS}
        WeightedLoss(MOTION_TERMS, weights)
    run.evaluation.check()
    check_objective(config.objective, run.evaluation.metrics)
    if job.in_search() and "evaluate" not in asked.further:
        raise DevrfError(
            f"stage: a search needs the objective, which stage={config.stage} does not score"
        )
    instantiate(config.video)
    instantiate(config.still)
