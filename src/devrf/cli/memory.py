"""Whether memory and disk suffice for a run, before it begins."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from hydra.utils import instantiate
from omegaconf import OmegaConf

from devrf.apps.needs import StageNeeds, host_bytes, needs_of_devrf, needs_of_networks
from devrf.cli.context import RunContext
from devrf.engine.micro_batching import MicroBatching
from devrf.errors import DevrfError
from devrf.system.files import free_disk
from devrf.system.memory import free_host_memory, free_memory, gib, own_memory

# A checkpoint, and three progress files at once, each with values and Adam's two means.
FILES = 10
# A part grows with this power of the value of its key, else in proportion.
POWER = {"downscale": -2, "side": 3, "width": 2}


def needs(run: RunContext) -> dict[str, StageNeeds]:
    """What each stage of the configured run needs; several processes share a batch."""
    scene, config, processes = run.scene, run.config, int(getattr(run.strategy, "world_size", 1))
    images = "data.downscale" if "downscale" in config.data else "data.frames"
    if "canonical" in config:
        stages = needs_of_devrf(
            scene,
            instantiate(config.canonical, _convert_="all"),
            instantiate(config.deformation.schedule, _convert_="all"),
            images,
            [name for name, row in config.schedule.deformation.levels.items() if row][-1],
            offloaded=config.schedule.motion.store == "host",
            processes=processes,
        )
    else:
        with torch.device("meta"):
            model = instantiate(config.ray_stage.model, _convert_="all")
        schedule = config.ray_stage.schedule
        rays = max(schedule.rays, schedule.get("rays_without_hull") or 0) / processes
        networks = needs_of_networks(scene, model, images, rays)
        stages = dict.fromkeys(run.learning_stages, networks)
    # A scene at rest that the protocol has no stage for can be looked at all the same.
    return {name: stages[name] for name in run.stages_with_images or run.learning_stages}


def check_memory(run: RunContext, names: Sequence[str]) -> str:
    """Compare what the stages ``names`` need with what there is; both, in one line.

    Raises:
        DevrfError: memory or disk cannot suffice.
    """
    every = needs(run)
    stages = [every[name] for name in names]
    stage = max(stages, key=StageNeeds.peak)
    on_gpu = run.device.type == "cuda"
    host = host_bytes(run.scene, stages, on_host=not on_gpu)
    host *= 1 if on_gpu else int(getattr(run.strategy, "num_processes", 1))
    disk = FILES * max(stage_needs.learned for stage_needs in stages)
    room = free_disk(run.folder)
    if run.config.resume:  # what is there is replaced
        room += sum(file.stat().st_size for file in run.folder.glob("checkpoints/*.ckpt"))
    # What, needed, needed at least, there.
    compared = [
        ("host memory", host, host, free_host_memory() + own_memory()),
        ("disk", disk, disk, room),
    ]
    if on_gpu:
        minimum = stage.peak(MicroBatching.MOST)
        compared.insert(0, ("GPU memory", stage.peak(), minimum, free_memory(run.device)))
    summary = ", ".join(f"{gib(n)} of {gib(free)} GiB of {name}" for name, n, _, free in compared)
    for resource, _, minimum, free in compared:
        if minimum > free:
            key, part = max(stage.parts.items(), key=lambda item: item[1])
            share = 1 - (1 - free / minimum) * stage.peak() / part
            raise DevrfError(
                f"{key}: the run needs about {summary}; it would end for lack of {resource}: give "
                f"{_smaller(run, key, share)}, or try all the same with memory_check=false"
            )
    split = any(needed > free for _, needed, _, free in compared)
    return f"needs about {summary}{'; batches will be split, slower' if split else ''}"


def _smaller(run: RunContext, key: str, share: float) -> str:
    """``key=VALUE`` with which its part takes ``share`` as much; in words where that is unknown."""
    value = OmegaConf.select(run.config, key)
    if share <= 0 or not isinstance(value, int | float):
        return f"another {key}"
    power = POWER.get(key.rpartition(".")[2], 1)
    scaled = value * share ** (1 / power)
    return f"{key}={math.ceil(scaled) if power < 0 else max(math.floor(scaled), 1)}"
