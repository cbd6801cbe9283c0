"""The steps of ``stage=…``, in which order, after which checks."""

from __future__ import annotations

import gc
import json
import logging
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import torch
from hydra.utils import instantiate
from lightning import seed_everything
from omegaconf import DictConfig

from devrf.apps.settings import ViewerSettings
from devrf.cli import job
from devrf.cli.capture import capture
from devrf.cli.closing import say_what_next
from devrf.cli.context import RunContext
from devrf.cli.done import done, noting, say_done
from devrf.cli.evaluate import evaluate
from devrf.cli.export import export
from devrf.cli.fetch import fetch
from devrf.cli.inspect_scene import inspect, prepare
from devrf.cli.objective import check_objective, objective
from devrf.cli.preflight import preflight, shortage_in_words
from devrf.cli.render import check_path, render
from devrf.cli.report import report
from devrf.cli.resume import archive_previous, beginning
from devrf.cli.scene_stages import learnable
from devrf.cli.selfcheck import selfcheck
from devrf.cli.stages import OF_A_CHECKPOINT, meant_stage
from devrf.cli.still import picture
from devrf.cli.train import learn
from devrf.cli.view import view
from devrf.cli.workers import launch_workers
from devrf.engine.ddp import ManualDDP
from devrf.errors import DevrfError
from devrf.ops.dispatch import using

log = logging.getLogger(__name__)

Step = Callable[[RunContext], None]

# What devrf.cli.stages.STEPS names.
STEPS: dict[str, Step] = {
    "prepare": prepare,
    "inspect": inspect,
    "evaluate": evaluate,
    "render": render,
    "still": picture,
    "view": view,
    "export": export,
    "report": report,
    "fetch": fetch,
    "capture": capture,
    "selfcheck": selfcheck,
}
PIPELINE = ("evaluate", "render")
# Steps for which the run's scene and stages need not be right.
APART = {"report", "fetch", "capture", "selfcheck"}
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
    raise DevrfError(f"stage: expected one of {known}, not {stage!r}{meant_stage(stage)}")


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
    if _all_done(run, asked):
        return _ended(run, asked)
    if asked.learning and run.leads:
        asked = _for_the_scene(run, asked)
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
                if asked.learning and (files := done(run, name)):
                    say_done(name, files)
                else:
                    _take(run, name, STEPS[name])
        ended = True
    finally:
        run.close(failed=not ended)
    if "evaluate" not in asked.further or not run.leads:
        return None
    return _ended(run, asked)


def _all_done(run: RunContext, asked: Plan) -> bool:
    """Whether nothing of a pipeline is left to do, so that its scene need not be read; says so."""
    config = run.config
    if asked.further != PIPELINE or not config.resume or isinstance(run.strategy, ManualDDP):
        return False
    made = {name: done(run, name) for name in asked.further}
    learned = all(run.own_checkpoint(name).is_file() for name in asked.learning)
    if not (learned and all(made.values())):
        return False
    # Refuses other settings than those that it was learned with.
    if not all(beginning(run, name).finished for name in asked.learning):
        return False
    for name, files in made.items():
        say_done(name, files)
    return True


def _ended(run: RunContext, asked: Plan) -> float | None:
    """The objective; a pipeline ends with what to try next."""
    if asked.further == PIPELINE and not job.in_sweep():
        say_what_next(run.folder)
    found = json.loads((run.folder / "metrics.json").read_text())
    return objective(run.config.objective, found)


def learn_all(config: DictConfig, folder: Path) -> None:
    """Learn the stages of ``stage=…`` in another process than rank 0; the config is checked."""
    run = RunContext(config, folder)
    with launch_workers(run, learn_all):
        _learn(run, plan(config.stage, run.learning_stages))


def _for_the_scene(run: RunContext, asked: Plan) -> Plan:
    """The plan without stages that learn motion, for a scene at rest."""
    left = replace(asked, learning=learnable(run, asked.learning))
    if left != asked:
        steps = ", ".join(left.learning + left.further)
        log.info("%s is at rest: %s; no motion is learned", run.scene.name, steps)
    return left


def _learn(run: RunContext, asked: Plan) -> None:
    for name in learnable(run, asked.learning):
        _take(run, name, partial(learn, name=name))
        _release(run.device)


def _release(device: torch.device) -> None:
    """Free what a stage's trainer holds in circles: it would count as the next stage's memory."""
    gc.collect()
    if device.type == "cuda":
        torch.cuda.empty_cache()


def _take(run: RunContext, name: str, step: Step) -> None:
    seed_everything(run.config.seed, verbose=False)
    run.begin_step()
    with using(run.config.kernels), shortage_in_words(name, run), noting(run, name):
        step(run)


def _check(run: RunContext, asked: Plan) -> None:
    """Find errors in the config of every step before the first begins."""
    config = run.config
    begins = asked.learning and run.protocol[asked.learning[0]].builds_on is None
    if config.ckpt is not None and (begins or not {*asked.further} <= {*OF_A_CHECKPOINT}):
        raise DevrfError(
            f"ckpt: stage={config.stage} starts from nothing; with ckpt=PATH give a stage that "
            "builds on another, stage=evaluate, render, still, view or export"
        )
    if not asked.learning and not APART.isdisjoint(asked.further):
        return
    _ = run.datamodule
    for name in run.learning_stages:
        run.stage_builder(name)
    run.evaluation.check()
    check_objective(config.objective, run.evaluation.metrics)
    if job.in_search() and "evaluate" not in asked.further:
        raise DevrfError(
            f"stage: a search needs the objective, which stage={config.stage} does not score"
        )
    check_path(instantiate(config.video))
    instantiate(config.still)
    instantiate(config.export)
    viewer: ViewerSettings = instantiate(config.viewer)
    if run.leads and ("view" in asked.further or (viewer.training and asked.learning)):
        viewer.check_free()
