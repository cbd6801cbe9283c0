"""The stages that ``stage=…`` asks for, in their order, after all checks."""

from __future__ import annotations

import json
import logging
import time
import warnings
from collections.abc import Callable, Sequence
from functools import partial
from importlib import import_module
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from hydra.utils import instantiate
from lightning import seed_everything
from omegaconf import DictConfig

from devrf.apps.render import camera_path
from devrf.apps.settings import ViewerSettings
from devrf.apps.viewer.page import PAGE
from devrf.cli.config import (
    OF_A_CHECKPOINT,
    PIPELINE,
    SCENELESS_STAGES,
    in_sweep,
    set_at,
    stage_section,
)
from devrf.cli.config_check import check_config
from devrf.cli.context import RunContext
from devrf.cli.evaluate import check_pictures_folder, evaluate
from devrf.cli.memory import forecast
from devrf.cli.preparation import capture, fetch, inspect, prepare, report, say_next, selfcheck
from devrf.cli.processes import connected, run_in_each, starts_processes
from devrf.cli.rehearse import begin_anew, conclude
from devrf.cli.render import export, render, still, view, write_scene_page
from devrf.cli.resume import check_as_learned, done, note_done, unfinished
from devrf.cli.run_folder import archive_previous, working_in
from devrf.cli.train import learn
from devrf.engine.ddp import world_size
from devrf.errors import DevrfError, did_you_mean, expect
from devrf.evaluation.objective import check_objective, objective
from devrf.kernels import runtime
from devrf.kernels.ahead import compile_ahead
from devrf.system.files import UNREADABLE, read_record
from devrf.system.folder_lock import PLACE
from devrf.system.memory import free_cache, shortage_in_words
from devrf.system.override import to_type
from devrf.system.process import importing

log = logging.getLogger(__name__)

# Does its work; returns False if something was left out that another time may be there.
Step = Callable[[RunContext], object]
Names = tuple[str, ...]

# By the names in devrf.cli.config.STEPS.
STEPS: dict[str, Step] = {
    step.__name__: step
    for step in (
        *(prepare, inspect, evaluate, render, still, view, export),
        *(report, fetch, capture, selfcheck),
    )
}
AFTER_LEARNING: dict[str, Step] = {
    "evaluate": evaluate,
    "render": render,
    "page": write_scene_page,
}
REHEARSED_STEPS = ("evaluate", "still")
# Results in a run's folder that a person looks at first, and commands to try next.
RESULTS = ("metrics.json", "images", "videos", "checkpoints")
NEXT = ("stage=still still.time=0.35 still.height=400", "stage=view")

# Lightning's messages on accelerators and tips say nothing about this run.
for _name in ("lightning.pytorch", "lightning.fabric"):
    logging.getLogger(_name).setLevel(logging.WARNING)
_IGNORED = "LeafSpec|GPU available but not used|Experiment logs directory"
_IGNORED += "|callbacks used to create the checkpoint"  # a resumed run may be watched otherwise
warnings.filterwarnings("ignore", message=f".*({_IGNORED})")


def plan(stage: str, protocol: Sequence[str]) -> tuple[Names, Names]:
    """The protocol's stages that ``stage`` asks to learn, and the steps after them.

    All processes learn; rank 0 alone takes the other steps.

    Raises:
        DevrfError: there is no such stage.
    """
    if stage == PIPELINE:
        return tuple(protocol), tuple(AFTER_LEARNING)
    if stage in protocol:
        return (stage,), ()
    names = [PIPELINE, *protocol, *STEPS]
    meant = did_you_mean(stage, names, "stage=")
    expect(stage in STEPS, "stage", f"one of {', '.join(names)}", f"{stage!r}{meant}")
    return (), (stage,)


def run_stage(config: DictConfig, folder: Path) -> float | None:
    """Run ``stage=…`` of a composed config in the run's folder.

    Returns:
        The objective; None where nothing was scored.

    Raises:
        DevrfError: the input is wrong.
    """
    folder = folder.absolute()
    with working_in(folder, config):
        config.output_dir = str(folder)
        with importing():  # the parts that the config names
            check_config(config)
        runtime.choose(config.kernels, deterministic=config.deterministic)
        with RunContext(config, folder) as run:
            return _run_plan(run)


def _run_plan(run: RunContext) -> float | None:
    """Take the steps that ``stage=…`` asks for; return the objective, if it was scored."""
    config = run.config
    learning, steps = plan(config.stage, run.learning_stages)
    if learning and run.is_trial:
        steps = ()  # nothing of it is worth a score or a video
    elif learning and run.rehearses:
        steps = REHEARSED_STEPS
    with shortage_in_words(config.stage, run.device, None):  # of networks that are too wide
        _check(run, learning, steps)
    foreign = config.evaluation.predictions is not None
    scored = "evaluate" in steps and run.is_rank_zero and not (run.rehearses or foreign)
    if learning and starts_processes(run.strategy):
        run_in_each(run.strategy, run.folder)
        return _objective(run, ()) if scored and in_sweep() else None
    if learning:
        with connected(run.strategy):
            _learn(run, learning, steps)
    for name in steps if run.is_rank_zero or not learning else ():
        if not (learning and done(run, name)):
            _run_step(run, name, AFTER_LEARNING.get(name) or STEPS[name])
    if learning and run.rehearses and run.is_rank_zero:
        conclude(run)
    return _objective(run, steps) if scored and unfinished(run) is None else None


def _prepare_to_learn(run: RunContext, requested: Names, steps: Names) -> None:
    """Check scene, memory and the results of earlier commands, before anything is learned."""
    learning = run.learnable(requested)
    if learning != requested:
        stages = ", ".join(learning + steps)
        log.info("%s is at rest: %s; no motion is learned", run.config.scene, stages)
    below = run.protocol[learning[0]].builds_on
    if below is not None:
        check_as_learned(run, learning[0])
    if run.rehearses:
        begin_anew(run, learning)
        return
    resume = run.config.resume
    names = [name for name in learning if not (resume and run.own_checkpoint(name).is_file())]
    looks = names and run.config.memory_check
    needed, shortage = forecast(run, names) if looks else (None, None)
    if shortage is not None:
        raise DevrfError(f"{shortage}, or try all the same with memory_check=false")
    if not resume and not run.is_trial:
        archive_previous(run.folder, *([] if below is None else [run.own_checkpoint(below)]))
    if needed is not None:
        log.info("%s", needed)


def _objective(run: RunContext, steps: Names) -> float | None:
    """The objective; a pipeline ends with its results, and commands to try next."""
    scores = run.folder / "metrics.json"
    try:
        metrics = json.loads(read_record(scores))
        best = objective(run.config.objective, metrics)
    except UNREADABLE:
        raise DevrfError(f"{scores}: damaged; remove it, and the run is scored again") from None
    if steps == tuple(AFTER_LEARNING) and not in_sweep():
        results = ", ".join(name for name in RESULTS if (run.folder / name).exists())
        log.info("results: %s (%s)", run.place, results)
        if (run.folder / "export" / PAGE).exists():
            log.info("the scene, for any browser: %s", run.place / "export" / PAGE)
        further = [[to_type("hydra.run.dir", run.place), *words.split()] for words in NEXT]
        if metrics.get("at_rest"):
            further[0].remove("still.time=0.35")
        where, elsewhere = run.config.outputs, []
        if Path(where).absolute() not in run.folder.parents:
            elsewhere = [to_type("report.runs", run.place.parent)]
        elif where != "outputs":
            elsewhere = [to_type("outputs", where)]
        say_next(*further, ["stage=report", *elsewhere])
    return best


def _learn(run: RunContext, learning: Names, steps: Names) -> None:
    """Learn stages, together with the other processes where there are any."""
    strategy = run.strategy
    plans = map(run.plan_to_learn, run.learning_stages)
    kernels = dict.fromkeys(kernel for plan in plans for kernel in plan.kernels)
    compiling = compile_ahead([*kernels], run.device)  # while the scene is read
    if run.is_rank_zero:
        _prepare_to_learn(run, learning, steps)
        if world_size() > 1:
            _ = run.scene  # whose estimated flow is stored then
    strategy.barrier("the scene is read")
    if run.config.schedule.seconds is not None:  # which are of learning alone
        compiling.join()
    # Rank 0 has made it. Checkpoints that a later stage or a resumed one needs are read by all.
    there = (run.folder / PLACE).is_dir()
    if not strategy.reduce_boolean_decision(there):
        shared = "give hydra.run.dir=FOLDER in a file system that all nodes share"
        raise DevrfError(f"{run.folder}: not there on every node; {shared}")
    for name in run.learnable(learning):
        _run_step(run, name, partial(learn, name=name))


def _run_step(run: RunContext, name: str, step: Step) -> None:
    seed_everything(run.config.seed, verbose=False)
    learns = name in run.learning_stages
    rays = set_at(run.config, (stage_section(run.config, name), "schedule", "rays"))
    with shortage_in_words(name, run.device, rays if learns else None):
        whole = step(run)
    # Leftovers of a step, as a trainer held in circles, would count as the next step's memory.
    free_cache(run.device)
    if whole is not False:
        note_done(run, name)
    run.step_began = time.perf_counter()


def _check(run: RunContext, learning: Names, steps: Names) -> None:
    """Find errors in the config of every step before the first begins."""
    config = run.config
    begins = learning and run.protocol[learning[0]].builds_on is None
    if config.ckpt is not None and (begins or not {*steps} <= {*OF_A_CHECKPOINT}):
        instead = f"a stage that builds on another, stage={', '.join(OF_A_CHECKPOINT)}"
        raise DevrfError(f"ckpt: stage={config.stage} starts from nothing; give {instead}")
    if not learning and not set(SCENELESS_STAGES).isdisjoint(steps):
        return
    scores_pictures = "evaluate" in steps and config.evaluation.predictions is not None
    if not scores_pictures and not {*OF_A_CHECKPOINT}.isdisjoint(() if learning else steps):
        check_as_learned(run)
    _ = run.datamodule
    instantiate(config.get("logger"), _convert_="all")  # which writes nothing
    for name in run.learning_stages:
        run.plan(name)
    if learning or not {"evaluate", "inspect"}.isdisjoint(steps):
        run.evaluation.check()
        check_objective(config.objective, run.evaluation.metrics)
    if scores_pictures:
        if learning:
            raise DevrfError(
                f"evaluation.predictions: stage={config.stage} scores what it learns; score "
                "pictures by stage=evaluate"
            )
        check_pictures_folder(run.folder)
    # A sweeper with a direction optimises, and so needs the objective of each job.
    if in_sweep() and "direction" in HydraConfig.get().sweeper and "evaluate" not in steps:
        lacks = f"which stage={config.stage} does not score"
        raise DevrfError(f"stage: a search needs the objective, {lacks}")
    if learning or "render" in steps:
        camera_path(instantiate(config.video))
    instantiate(config.still)
    instantiate(config.export)
    viewer: ViewerSettings = instantiate(config.viewer)
    if run.is_rank_zero and ("view" in steps or (viewer.training and learning)):
        viewer.check_free()
    if viewer.training and learning:
        import_module("viser")  # an extra: without it nothing is begun
