"""Whether memory and disk suffice for a run, before it begins."""

from __future__ import annotations

import logging
from collections.abc import Sequence

import torch
from omegaconf import OmegaConf

from devrf.apps.forecast import Forecast, free_bytes, needed_bytes, needs_table
from devrf.apps.inspection.advice import Advice
from devrf.cli.context import RunContext
from devrf.engine.needs import SIZE, StageNeeds
from devrf.scenes.scene import Scene

log = logging.getLogger(__name__)

# The most of a batch that is drawn within a budget of seconds.
LARGEST_BATCH = "callbacks.time_budget.largest_batch"


def table_of_needs(run: RunContext, scene: Scene) -> list[tuple[str, str]]:
    """What the run's stages need of a scene, for people: names and amounts."""
    # A scene at rest that the protocol has no stage for can be looked at all the same.
    names = run.stages_with_images or run.learning_stages
    return needs_table(scene, _needs(run, scene, names))


def forecast(run: RunContext, names: Sequence[str]) -> tuple[str, Advice | None]:
    """Needs of the stages ``names`` in words, and a remedy if something lacks.

    If the images' size was left to the run, it is changed at once.
    """
    scene = run.scene
    stages = _needs(run, scene, names).values()
    processes = int(getattr(run.strategy, "num_processes", 1))
    free = free_bytes(run.device, run.folder, resume=run.config.resume)
    on_gpu = run.device.type == "cuda"
    budget = run.config.schedule.seconds is not None
    largest = OmegaConf.select(run.config, LARGEST_BATCH) if budget else 1.0
    # A GPU says that it has no more memory, and half is drawn.
    whole, least = (
        Forecast(
            needed_bytes(scene, [s.with_batches(share) for s in stages], processes, on_gpu=on_gpu),
            free,
        )
        for share in (largest, largest / 2 if on_gpu else largest)
    )
    line = f"needs about {whole}"
    lacking = least.shortage()
    if lacking is None:
        return line + "; batches will be halved" * bool(whole.shortage()), None
    problem = f"the run {line}; it would end for lack of {lacking}"
    if run.chooses_size and (factor := least.downscale(run.datamodule.downscale)):
        log.info("%s=auto: %d, as %s", SIZE, factor, problem)
        run.config.data.downscale = factor
        del run.datamodule  # the images are read again
        return forecast(run, names)
    key = least.key(lacking)
    change = "raise it (auto: as far as is needed)" if key == SIZE else "lower it"
    if key == SIZE and "downscale" not in run.config.data:
        key, change = "data.frames", "lower it"
    return line, Advice(key, problem, f"{change}, or free some {lacking}")


def _needs(run: RunContext, scene: Scene, names: Sequence[str]) -> dict[str, StageNeeds]:
    """Memory that stages need, by name; several processes share a batch."""
    processes = int(getattr(run.strategy, "world_size", 1))
    with torch.device("meta"):
        plans = {name: run.plan(name) for name in run.learning_stages}
    needs: dict[str, StageNeeds] = {}
    for name in names:
        below = run.protocol[name].builds_on
        rest = None if below is None else plans[below]
        needs[name] = plans[name].needs(scene, rest).with_batches(1 / processes)
    return needs
