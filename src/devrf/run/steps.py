"""What each stage of a run does: which steps, in which order, after which checks."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Callable
from pathlib import Path

from hydra.utils import instantiate
from lightning import seed_everything
from omegaconf import DictConfig

from devrf.errors import DevrfError
from devrf.losses.composer import WeightedLoss
from devrf.losses.motion import MOTION_TERMS
from devrf.run.context import RunContext
from devrf.run.film import render
from devrf.run.look import inspect, prepare
from devrf.run.resume import set_aside
from devrf.run.score import evaluate
from devrf.run.train import canonical, deformation

STEPS: dict[str, tuple[Callable[[RunContext], None], ...]] = {
    "prepare": (prepare,),
    "inspect": (inspect,),
    "canonical": (canonical,),
    "deformation": (deformation,),
    "evaluate": (evaluate,),
    "render": (render,),
    "pipeline": (canonical, deformation, evaluate, render),
}

# Stages that no checkpoint is of use to.
FROM_NOTHING = ("prepare", "inspect", "canonical", "pipeline")

# What Lightning says of every run (accelerators it looked for, tips, how many workers a loader
# might have) is of no use to someone who watches a scene being learned.
for _name in ("lightning.pytorch", "lightning.fabric"):
    logging.getLogger(_name).setLevel(logging.WARNING)
for _words in (
    "does not have many workers", "LeafSpec", "GPU available but not used",
    "Experiment logs directory",
):
    warnings.filterwarnings("ignore", message=f".*{_words}.*")


def run_stage(config: DictConfig, folder: Path) -> None:
    """Do what ``stage=…`` asks for, in the run's folder.

    Args:
        config: a composed config (``conf/config.yaml``).
        folder: where to work.

    Raises:
        DevrfError: an unknown stage, or whatever is wrong with the input.
    """
    stage = config.stage
    if stage not in STEPS:
        raise DevrfError(f"stage: expected one of {', '.join(STEPS)}, not {stage!r}")
    run = RunContext(config, folder)
    _check(run, stage)
    if not config.resume and not {canonical, deformation}.isdisjoint(STEPS[stage]):
        needed = () if canonical in STEPS[stage] else (run.own_checkpoint("canonical"),)
        set_aside(folder, *needed)
    for step in STEPS[stage]:
        seed_everything(config.seed, verbose=False)
        step(run)


def _check(run: RunContext, stage: str) -> None:
    """Find what can be found wrong before the first step has cost any time.

    A mistake in the deformation's config would else show when the canonical stage is done.
    """
    config = run.config
    if config.ckpt is not None and stage in FROM_NOTHING:
        raise DevrfError(
            f"ckpt: stage={stage} starts from nothing; with ckpt=PATH give stage=deformation, "
            "stage=evaluate or stage=render"
        )
    _ = run.datamodule
    instantiate(config.canonical, _convert_="all")
    instantiate(config.deformation, _partial_=True, _convert_="all")
    weights = {k: v for k, v in config.deformation.loss.items() if k != "tv"}
    WeightedLoss(MOTION_TERMS, weights)
    run.evaluation.check()
    instantiate(config.video)
