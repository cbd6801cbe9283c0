"""The step that measures speed: ``stage=benchmark``."""

from __future__ import annotations

import copy
import logging
import time
from collections.abc import Sequence
from typing import Any

import torch
from hydra.utils import instantiate
from lightning import Callback, Trainer
from rich.console import Console
from torch import Tensor

from devrf.artifacts.records import provenance
from devrf.callbacks import GridUpscaling, LearningRateDecay, PhaseBenchmark
from devrf.checkpoints.checkpoint import LoadedCheckpoint
from devrf.cli import job
from devrf.cli.benchmark_record import Benchmark, as_data
from devrf.cli.benchmark_text import plain, tables
from devrf.cli.context import RunContext
from devrf.cli.short_schedules import middle_visits, shorter_canonical, shorter_deformation
from devrf.cli.timing import BenchmarkSettings, PictureTiming, Spread, Timing
from devrf.engine.stage import ScheduledStage
from devrf.errors import DevrfError
from devrf.evaluation.held_out import background_value
from devrf.methods.devrf.canonical_stage import CanonicalStage
from devrf.methods.devrf.deformation_stage import DeformationStage
from devrf.methods.devrf.model import SceneModel
from devrf.methods.devrf.renderer import Renderer
from devrf.ops.dispatch import Kind, passes_check, using
from devrf.scenes.scene import Views
from devrf.system.files import write_json
from devrf.system.speed import copy_speed, product_speed, wait

log = logging.getLogger(__name__)

SEARCH_NOTE = "the search is measured at its beginning, while the space is still fog"


def benchmark(run: RunContext) -> None:
    """Measure training at each resolution and rendering, with every implementation there is."""
    settings: BenchmarkSettings = instantiate(run.config.benchmark)
    stored, state = _learned(run, settings)
    views, background = run.scene.dynamic.test, background_value(run.scene.background)
    kinds, notes = _kinds(run.device)
    training: dict[str, list[Timing]] = {}
    pictures: dict[str, PictureTiming] = {}
    truth: list[Tensor] = []
    for kind in kinds:
        with using(kind):
            training[kind] = _training(run, settings, stored)
            model = copy.deepcopy(stored.model).to(run.device)
            players: dict[str, Renderer] = {kind: Renderer(model)}
            if run.device.type == "cuda":
                players[f"{kind}, colour network in half precision"] = Renderer(model, half=True)
            for name, player in players.items():
                pictures[name], colors = _pictures(player, views, settings.views, background, truth)
                truth = truth or colors
    if any(timing.phase == "search" for timing in training[kinds[0]]):
        notes.append(SEARCH_NOTE)
    found = Benchmark(
        run.scene.name,
        state,
        copy_speed(run.device),
        product_speed(run.device),
        training,
        pictures,
        tuple(notes),
    )
    _say(run, found, provenance(stored.model, run.device))


def _say(run: RunContext, found: Benchmark, ran: dict[str, Any]) -> None:
    """Write what was found, and show it."""
    origin = {
        "choices": job.choices(),
        "overrides": job.overrides(),
        "seed": run.config.seed,
        "wall_seconds": run.step_seconds,
    }
    path = run.folder / "benchmark.json"
    write_json(path, {**as_data(found), "run": {**ran, **origin}})
    console = Console()
    if console.is_terminal:
        console.print(tables(found))
    else:
        log.info("%s", plain(found))
    log.info("written to %s", path)


def _kinds(device: torch.device) -> tuple[list[Kind], list[str]]:
    """The implementations that run on a device, and why another does not."""
    if device.type != "cuda":
        return ["torch"], ["triton was not measured: it needs a CUDA device"]
    if not passes_check(device):
        return ["torch"], ["triton was not measured: it failed its check here, as the log says"]
    return ["torch", "triton"], []


def _learned(run: RunContext, settings: BenchmarkSettings) -> tuple[LoadedCheckpoint, str]:
    """A scene that has been learned, on the host, and in words how far."""
    names = ("deformation", "canonical")
    share, taught = settings.training, []
    if run.config.ckpt is not None or any(run.own_checkpoint(name).exists() for name in names):
        stored, state = run.load(*names), f"from {run.checkpoint(*names)}"
    else:
        log.info("no checkpoint: %.0f %% of the schedule is learned first", 100 * share)
        rest: CanonicalStage = instantiate(run.config.canonical, _convert_="all")
        rest.schedule = shorter_canonical(rest.schedule, share)
        _fit(run, rest)
        stored, state = rest.result(), ""
        taught.append("canonical")
    stored.model.cpu()
    if stored.model.deformation is None:
        moving = _moving(run, stored)
        moving.schedule = shorter_deformation(moving.schedule, share)
        _fit(run, moving)
        stored = LoadedCheckpoint(stored.metadata, moving.model.cpu())
        taught.append("deformation")
    if taught:
        learned = f"{' and '.join(taught)} learned in {100 * share:.3g} % of the schedule"
        state = f"{state}, {learned}" if state else learned
    return stored, state


def _moving(run: RunContext, stored: LoadedCheckpoint) -> DeformationStage:
    """A deformation stage on a copy of a rest state."""
    build = instantiate(run.config.deformation, _partial_=True, _convert_="all")
    stage: DeformationStage = build(rest=copy.deepcopy(stored))
    return stage


def _training(
    run: RunContext, settings: BenchmarkSettings, stored: LoadedCheckpoint
) -> list[Timing]:
    """What an iteration takes at each resolution of both stages, coarse to fine."""
    rest: CanonicalStage = instantiate(run.config.canonical, _convert_="all")
    phases = rest.schedule.phases
    fine = [phase.start for phase in reversed(phases) if phase.kind == "fine"]
    found = _timed(run, settings, rest, fine, stored.model)
    if phases[0].kind == "search":
        search: CanonicalStage = instantiate(run.config.canonical, _convert_="all")
        found = _timed(run, settings, search, [0], None) + found
    moving = _moving(run, stored)
    visits = middle_visits(moving.schedule, len(run.scene.clock))
    return found + _timed(run, settings, moving, visits[::-1], stored.model)


def _timed(
    run: RunContext,
    settings: BenchmarkSettings,
    stage: ScheduledStage,
    iterations: Sequence[int],
    learned: SceneModel | None,
) -> list[Timing]:
    """A stage's timings in the phases of some iterations; the last one's comes first."""
    excerpts = PhaseBenchmark(iterations, settings.warmup, settings.repeats, learned)
    _fit(run, stage, excerpts)
    return excerpts.timings[::-1]


def _fit(run: RunContext, stage: ScheduledStage, guide: Callback | None = None) -> None:
    """Train a stage with what its schedule needs, and nothing that watches."""
    callbacks = [guide or GridUpscaling(), LearningRateDecay()]
    trainer: Trainer = instantiate(
        run.config.trainer, callbacks=callbacks, logger=False, default_root_dir=str(run.folder)
    )
    if trainer.world_size > 1:
        raise DevrfError("trainer: stage=benchmark measures one process; leave out trainer=ddp")
    trainer.fit(stage, datamodule=run.datamodule)
    if trainer.interrupted:
        raise KeyboardInterrupt


def _pictures(
    player: Renderer, views: Views, count: int, background: float, truth: Sequence[Tensor]
) -> tuple[PictureTiming, list[Tensor]]:
    """What pictures of some held-out views take, and their colours.

    Args:
        player: shows what was learned.
        views: held-out views, of which some are chosen from first to last.
        count: how many.
        background: grey level.
        truth: colours to compare with; none for the first way of rendering.
    """
    count = min(count, len(views))
    chosen = [round(k * (len(views) - 1) / max(count - 1, 1)) for k in range(count)]
    colors: list[Tensor] = []
    new: list[float] = []
    again: list[float] = []
    player.view(views.cameras, chosen[0], float(views.times[chosen[0]]), background)
    for index in chosen:
        player.ready.cache_clear()
        for spent in (new, again):
            wait(player.device)
            start = time.perf_counter()
            seen = player.view(views.cameras, index, float(views.times[index]), background)
            wait(player.device)
            spent.append(time.perf_counter() - start)
        colors.append(seen.color.cpu())
    apart = [float((a - b).abs().max()) for a, b in zip(colors, truth or colors, strict=True)]
    timing = PictureTiming(
        views.width, views.height, count, Spread.of(new), Spread.of(again), max(apart)
    )
    return timing, colors
