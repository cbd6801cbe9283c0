"""The stages that ``stage=…`` asks for, in their order, after all checks."""

from __future__ import annotations

import gc
import json
import logging
import os
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from hydra.utils import instantiate
from lightning import seed_everything
from omegaconf import DictConfig

from devrf.apps.keyframes import read_path
from devrf.apps.settings import ViewerSettings
from devrf.apps.video import VideoSettings
from devrf.cli.config import OF_A_CHECKPOINT, in_search, in_sweep, meant_stage
from devrf.cli.context import RunContext
from devrf.cli.evaluate import TRAINING, evaluate
from devrf.cli.memory import check_memory, shortage_in_words
from devrf.cli.preparation import capture, fetch, inspect, prepare, say_next, selfcheck
from devrf.cli.render import PRESETS, export, picture, render, view
from devrf.cli.resume import beginning, done, note_done
from devrf.cli.run_folder import archive_previous
from devrf.cli.sweep import report
from devrf.cli.train import learn
from devrf.cli.workers import launch_workers
from devrf.engine.ddp import ManualDDP
from devrf.errors import DevrfError, did_you_mean
from devrf.ops.dispatch import using

log = logging.getLogger(__name__)

# Does its work; returns the files it wrote, where these need not be made again.
Step = Callable[[RunContext], Sequence[Path] | None]

# What devrf.cli.config.STEPS names.
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
# What a run's folder may hold that a person looks at first, and what to try next.
RESULTS = ("metrics.json", "images", "videos/orbit.mp4", "videos/spiral.mp4", "checkpoints")
NEXT = ("stage=still still.time=0.35 still.height=400", "stage=render video.frames=120")

# Numbers of both sections of metrics.json, and of the dynamic one. Their second names are those of
# DeVRF's stages.
OF_BOTH = ("psnr", "ssim", *TRAINING, "checkpoint_mb")
OF_MOTION = ("rest_pose_psnr",)
STATIC, DYNAMIC = ("static", "canonical"), ("dynamic", "deformation")

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
    several = isinstance(run.strategy, ManualDDP)
    if not several and _all_done(run, asked):
        return _ended(run, asked)
    if asked.learning and run.leads:
        asked = _begin(run, asked)
    ended = False
    try:
        if asked.learning:
            with launch_workers(run, learn_all) if several else nullcontext():
                _learn(run, asked)
        if not asked.learning or run.leads:
            for name in asked.further:
                if not (asked.learning and _is_done(run, name)):
                    _take(run, name, STEPS[name])
        ended = True
    finally:
        run.close(failed=not ended)
    return _ended(run, asked) if "evaluate" in asked.further and run.leads else None


def _begin(run: RunContext, asked: Plan) -> Plan:
    """Look at scene, memory and what earlier commands left, before anything is learned.

    Returns:
        The plan without stages that learn motion, for a scene at rest.
    """
    left = replace(asked, learning=run.learnable(asked.learning))
    if left != asked:
        steps = ", ".join(left.learning + left.further)
        log.info("%s is at rest: %s; no motion is learned", run.scene.name, steps)
    resume = run.config.resume
    names = [name for name in left.learning if not (resume and run.own_checkpoint(name).is_file())]
    needed = check_memory(run, names) if names and run.config.memory_check else None
    if not resume:
        below = run.protocol[left.learning[0]].builds_on
        archive_previous(run.folder, *([] if below is None else [run.own_checkpoint(below)]))
    if needed is not None:
        log.info("%s", needed)
    return left


def _is_done(run: RunContext, name: str) -> bool:
    """Whether a step has been done with the same checkpoint and settings; says so."""
    files = done(run, name)
    if files:
        log.info("%s: done already (%s); stage=%s does it again", name, ", ".join(files), name)
    return bool(files)


def _all_done(run: RunContext, asked: Plan) -> bool:
    """Whether nothing of a pipeline is left to do, so that its scene need not be read; says so."""
    if asked.further != PIPELINE or not run.config.resume:
        return False
    learned = all(run.own_checkpoint(name).is_file() for name in asked.learning)
    if not (learned and all(done(run, name) for name in PIPELINE)):
        return False
    # Refuses other settings than those that it was learned with.
    if not all(beginning(run, name).finished for name in asked.learning):
        return False
    return all(_is_done(run, name) for name in PIPELINE)


def _ended(run: RunContext, asked: Plan) -> float | None:
    """The objective; a pipeline ends with its results, and what to try next."""
    folder = run.folder
    if asked.further == PIPELINE and not in_sweep():
        results = ", ".join(name for name in RESULTS if (folder / name).exists())
        place = Path(os.path.relpath(folder)) if folder.is_relative_to(Path.cwd()) else folder
        log.info("results: %s (%s)", place, results)
        further = [[f"hydra.run.dir={place}", *words.split()] for words in NEXT]
        say_next(*further, ["stage=report"])
    return objective(run.config.objective, json.loads((folder / "metrics.json").read_text()))


def learn_all(config: DictConfig, folder: Path) -> None:
    """Learn the stages of ``stage=…`` in another process than rank 0; the config is checked."""
    run = RunContext(config, folder)
    with launch_workers(run, learn_all):
        _learn(run, plan(config.stage, run.learning_stages))


def _learn(run: RunContext, asked: Plan) -> None:
    for name in run.learnable(asked.learning):
        _take(run, name, partial(learn, name=name))
        # What a stage's trainer holds in circles would count as the next stage's memory.
        gc.collect()
        if run.device.type == "cuda":
            torch.cuda.empty_cache()


def _take(run: RunContext, name: str, step: Step) -> None:
    seed_everything(run.config.seed, verbose=False)
    run.begin_step()
    with using(run.config.kernels), shortage_in_words(name, run):
        files = step(run)
    note_done(run, name, files or ())


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
    if in_search() and "evaluate" not in asked.further:
        raise DevrfError(
            f"stage: a search needs the objective, which stage={config.stage} does not score"
        )
    film: VideoSettings = instantiate(config.video)
    if film.path not in (None, *PRESETS):
        _ = read_path(Path(str(film.path))).frames
    instantiate(config.still)
    instantiate(config.export)
    viewer: ViewerSettings = instantiate(config.viewer)
    if run.leads and ("view" in asked.further or (viewer.training and asked.learning)):
        viewer.check_free()


def check_objective(key: str, metrics: Sequence[str]) -> None:
    """Check that metrics.json will have ``key``.

    Args:
        key: ``SECTION.NAME``, such as ``dynamic.psnr``.
        metrics: ``evaluation.metrics``.

    Raises:
        DevrfError: it will not.
    """
    section, _, name = key.partition(".")
    if section not in (*STATIC, *DYNAMIC):
        raise DevrfError(f"objective: expected static.NAME or dynamic.NAME, not {key!r}")
    known = [*OF_BOTH, *metrics, *(OF_MOTION if section in DYNAMIC else ())]
    if name not in known:
        raise DevrfError(
            f"objective: {section} has no {name!r}; choose from {', '.join(known)}"
            f"{did_you_mean(name, known, f'objective={section}.')}"
        )


def objective(key: str, found: Mapping[str, Any]) -> float | None:
    """The number ``key`` of metrics.json; None where it could not be measured.

    The static section stands in for a missing dynamic one.
    """
    section, _, name = key.partition(".")
    section = "static" if section in STATIC else "dynamic"
    value: float | None = found.get(section, found["static"]).get(name)
    return value
