"""What each stage of a run does: which steps, in which order, after which checks."""

from __future__ import annotations

import json
import logging
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path

from hydra.utils import instantiate
from lightning import seed_everything
from omegaconf import DictConfig

from devrf.cli import job
from devrf.cli.benchmark import benchmark
from devrf.cli.context import FROM_NOTHING, RunContext
from devrf.cli.evaluate import evaluate
from devrf.cli.inspect_scene import inspect, prepare
from devrf.cli.objective import check_objective, objective
from devrf.cli.preflight import preflight, shortage_in_words
from devrf.cli.render import picture, render
from devrf.cli.report import report
from devrf.cli.resume import archive_previous
from devrf.cli.train import canonical, deformation
from devrf.cli.workers import launch_workers
from devrf.errors import DevrfError
from devrf.methods.devrf.motion_losses import MOTION_TERMS
from devrf.methods.weighted_loss import WeightedLoss
from devrf.ops.choice import using

log = logging.getLogger(__name__)

STEPS: dict[str, tuple[Callable[[RunContext], None], ...]] = {
    "prepare": (prepare,),
    "inspect": (inspect,),
    "canonical": (canonical,),
    "deformation": (deformation,),
    "evaluate": (evaluate,),
    "render": (render,),
    "still": (picture,),
    "pipeline": (canonical, deformation, evaluate, render),
    "benchmark": (benchmark,),
    "report": (report,),
}

# Steps that several processes take together; what follows them is for one.
LEARNING = (canonical, deformation)
# Stages that look at runs, not at a scene.
OF_NO_SCENE = ("report",)

# What Lightning says of every run (accelerators it looked for, tips, how many workers a loader
# might have) is of no use to someone who watches a scene being learned.
for _name in ("lightning.pytorch", "lightning.fabric"):
    logging.getLogger(_name).setLevel(logging.WARNING)
for _words in (
    "does not have many workers",
    "LeafSpec",
    "GPU available but not used",
    "Experiment logs directory",
):
    warnings.filterwarnings("ignore", message=f".*{_words}.*")


def run_stage(config: DictConfig, folder: Path) -> float | None:
    """Do what ``stage=…`` asks for, in the run's folder.

    Args:
        config: a composed config (``conf/config.yaml``).
        folder: where to work.

    Returns:
        What ``objective`` names; None where nothing was scored.

    Raises:
        DevrfError: an unknown stage, or whatever is wrong with the input.
    """
    stage = config.stage
    if stage not in STEPS:
        raise DevrfError(f"stage: expected one of {', '.join(STEPS)}, not {stage!r}")
    run = RunContext(config, folder)
    _check(run, stage)
    learns = [step.__name__ for step in STEPS[stage] if step in LEARNING]
    needs = None
    if learns and config.memory_check and run.leads:
        needs = preflight(run, learns, films=render in STEPS[stage])
    if not config.resume and not {canonical, deformation}.isdisjoint(STEPS[stage]):
        needed = () if canonical in STEPS[stage] else (run.own_checkpoint("canonical"),)
        archive_previous(folder, *needed)
    if needs is not None:
        log.info("%s", needs)
    learning = [step for step in STEPS[stage] if step in LEARNING]
    others = [step for step in STEPS[stage] if step not in LEARNING]
    ended = False
    try:
        if learning:
            with launch_workers(run, learn):
                _take(learning, run)
        if not learning or run.leads:
            _take(others, run)
        ended = True
    finally:
        run.close(failed=not ended)
    if evaluate not in others or not run.leads:
        return None
    return objective(config.objective, json.loads((folder / "metrics.json").read_text()))


def learn(config: DictConfig, folder: Path) -> None:
    """Take the steps of ``stage=…`` that learn, as one of several processes.

    Args:
        config: a composed config that has been checked.
        folder: the run's folder; rank 0 writes into it.
    """
    run = RunContext(config, folder)
    with launch_workers(run, learn):
        _take([step for step in STEPS[config.stage] if step in LEARNING], run)


def _take(steps: Sequence[Callable[[RunContext], None]], run: RunContext) -> None:
    for step in steps:
        seed_everything(run.config.seed, verbose=False)
        run.begin_step()
        with using(run.config.kernels), shortage_in_words(step.__name__, run):
            step(run)


def _check(run: RunContext, stage: str) -> None:
    """Find what can be found wrong before the first step has cost any time.

    A mistake in the deformation's config would else show when the canonical stage is done.
    """
    config = run.config
    if config.ckpt is not None and stage in FROM_NOTHING:
        raise DevrfError(
            f"ckpt: stage={stage} starts from nothing; with ckpt=PATH give stage=deformation, "
            "stage=evaluate, stage=render, stage=still or stage=benchmark"
        )
    if stage in OF_NO_SCENE:
        return
    _ = run.datamodule
    instantiate(config.canonical, _convert_="all")
    instantiate(config.deformation, _partial_=True, _convert_="all")
    weights = {k: v for k, v in config.deformation.loss.items() if k != "tv"}
    WeightedLoss(MOTION_TERMS, weights)
    run.evaluation.check()
    check_objective(config.objective, run.evaluation.metrics)
    if job.in_search() and evaluate not in STEPS[stage]:
        raise DevrfError(f"stage: a search needs the objective, which stage={stage} does not score")
    instantiate(config.video)
    instantiate(config.still)
    instantiate(config.benchmark)
