"""Whether memory and disk suffice for a run, before it begins."""

from __future__ import annotations

import logging
from collections.abc import Sequence

import torch
from omegaconf import DictConfig, OmegaConf

from devrf.apps.fitting import (
    SIZE,
    Bytes,
    free_bytes,
    in_words,
    lacking,
    least_change,
    needed_bytes,
)
from devrf.apps.inspection.advice import Advice
from devrf.apps.needs import smaller
from devrf.callbacks.time_budget import BATCHES, LEAST_BATCH
from devrf.cli.context import RunContext
from devrf.cli.messages import as_own_errors
from devrf.engine.needs import StageNeeds
from devrf.scenes.scene import Scene

log = logging.getLogger(__name__)

# The key of the most of a batch that is drawn within a budget of seconds.
LARGEST_BATCH = "callbacks.time_budget.largest_batch"


def needs(run: RunContext, config: DictConfig, scene: Scene) -> dict[str, StageNeeds]:
    """Memory that each stage of a configured run needs; several processes share a batch."""
    processes = int(getattr(run.strategy, "world_size", 1))
    images = SIZE if "downscale" in config.data else "data.frames"
    # A scene at rest that the protocol has no stage for can be looked at all the same.
    names = run.stages_with_images or run.learning_stages
    found: dict[str, StageNeeds] = {}
    with torch.device("meta"):
        plans = {name: run.plan(name, config) for name in run.learning_stages}
    for name in names:
        below = run.protocol[name].builds_on
        rest = None if below is None else plans[below]
        found[name] = plans[name].needs(scene, images, processes, rest)
    return found


def _stages(
    run: RunContext, config: DictConfig, scene: Scene, names: Sequence[str]
) -> list[StageNeeds]:
    """Needs of the stages ``names`` of a configured run."""
    with as_own_errors():
        every = needs(run, config, scene)
    return [every[name] for name in names]


def compare(run: RunContext, names: Sequence[str]) -> tuple[str, Advice | None, list[str]]:
    """Needs of the stages ``names`` in words; if something lacks, a remedy and its override.

    If the images' size was left to the run, it is changed at once; with ``schedule.seconds``
    the largest batch is.
    """
    scene = run.scene
    by = run.datamodule.downscale
    processes = int(getattr(run.strategy, "num_processes", 1))
    free = free_bytes(run.device, run.folder, resume=run.config.resume)
    on_gpu = run.device.type == "cuda"
    budget = run.config.schedule.seconds is not None
    most = OmegaConf.select(run.config, LARGEST_BATCH) if budget else 1.0
    least = most / 2 if on_gpu else most  # a GPU says that it has no more memory, and half is drawn
    stages = _stages(run, run.config, scene, names)

    def with_share(batch_share: float) -> Bytes:
        return needed_bytes(scene, stages, processes, batch_share, on_gpu=on_gpu)

    def with_change(key: str, value: int, batch_share: float = least) -> Bytes:
        config = run.config.copy()
        OmegaConf.update(config, key, value)
        less = smaller(scene, value / by) if key == SIZE else scene
        changed = _stages(run, config, less, names)
        return needed_bytes(less, changed, processes, batch_share, on_gpu=on_gpu)

    whole = with_share(most)
    line = f"needs about {in_words(whole, free)}"
    if budget and lacking(whole, free):
        # Images that may be made smaller are, before batches teach little.
        smallest = LEAST_BATCH if run.chooses_size else BATCHES[-1]
        shares = (share for share in BATCHES if smallest <= share < most)
        share = next((s for s in shares if not lacking(with_share(s), free)), None)
        if share is not None:
            OmegaConf.update(run.config, LARGEST_BATCH, share)
            return f"{line}: batches have at most {share:.2g} of their rays", None, []
    lacks = lacking(with_share(least), free)
    if not lacks:
        return line + "; batches will be halved" * bool(lacking(whole, free)), None, []
    parts = max(stages, key=StageNeeds.peak).parts
    present = {key: OmegaConf.select(run.config, key) for key in parts} | {SIZE: by}
    change = least_change(parts, present, lambda *one: not lacking(with_change(*one), free))
    problem = f"the run {line}; it would end for lack of {lacks[0]}"
    if change is None:
        remedy = "lower several keys, or free some of it"
        return line, Advice(max(parts, key=parts.__getitem__), problem, remedy), []
    key, value = change
    if key == SIZE and run.chooses_size:
        log.info("%s=auto: %d, as %s", key, value, problem)
        run.config.data.downscale = value
        del run.datamodule  # the images are read again
        return compare(run, names)
    then = in_words(with_change(key, value, most), {lacks[0]: free[lacks[0]]})
    return line, Advice(key, problem, f"give {key}={value} ({then})"), [f"{key}={value}"]
