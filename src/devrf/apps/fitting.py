"""Whether a run fits into a machine, and the least change with which it does."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch

from devrf.apps.needs import host_bytes
from devrf.engine.needs import StageNeeds
from devrf.errors import DevrfError
from devrf.scenes.scene import Scene
from devrf.system.files import free_disk
from devrf.system.memory import free_host_memory, free_memory, gib, own_memory

# The key by which images are made smaller.
SIZE = "data.downscale"
# A checkpoint, and three progress files at once, each with values and Adam's two means.
FILES = 10
# Images are made at most MOST_OF_SIZE times smaller, other values at most MOST times.
MOST_OF_SIZE = 8
MOST = 64
# Bytes by resource: GPU memory, host memory, disk.
Bytes = Mapping[str, float]


def free_bytes(device: torch.device, folder: Path, *, resume: bool) -> Bytes:
    """Bytes available to a run in ``folder``; with ``resume`` it replaces the checkpoints there."""
    disk: float = free_disk(folder)
    if resume:
        disk += sum(file.stat().st_size for file in folder.glob("checkpoints/*.ckpt"))
    gpu = {"GPU memory": float(free_memory(device))} if device.type == "cuda" else {}
    return {**gpu, "host memory": free_host_memory() + own_memory(), "disk": disk}


def needed_bytes(
    scene: Scene,
    stages: Sequence[StageNeeds],
    processes: int,
    batch_share: float,
    *,
    on_gpu: bool,
) -> Bytes:
    """Needs of stages with ``batch_share`` of each batch; without a GPU in each process."""
    host = host_bytes(scene, stages, on_host=not on_gpu, batch_share=batch_share)
    return {
        "GPU memory": max(stage.peak(batch_share) for stage in stages),
        "host memory": host * (1 if on_gpu else processes),
        "disk": FILES * max(stage.learned for stage in stages),
    }


def lacking(needed: Bytes, free: Bytes) -> list[str]:
    """The resources of which there is too little."""
    return [name for name in free if needed[name] > free[name]]


def in_words(needed: Bytes, free: Bytes) -> str:
    """Needed and free bytes of each resource, in words."""
    return ", ".join(f"{gib(needed[name])} of {gib(free[name])} GiB of {name}" for name in free)


def least_change(
    parts: Bytes, present: Mapping[str, Any], suffices: Callable[[str, int], bool]
) -> tuple[str, int] | None:
    """A key and the value nearest to its ``present`` one that suffices; None: there is none.

    It is the images' size, which costs the least quality, else the key of the largest of the
    ``parts`` that has such a value.
    """

    def fits(key: str, value: int) -> bool:
        try:
            return suffices(key, value)
        except DevrfError:  # it does not go with the other settings
            return False

    for key in sorted(parts, key=lambda key: (key != SIZE, -parts[key])):
        value = present[key]
        values = range(0)
        if key == SIZE:
            values = range(value + 1, MOST_OF_SIZE * value + 1)
        elif isinstance(value, int | float):
            values = range(math.ceil(value) - 1, math.ceil(value) // MOST, -1)
        index = bisect_left(values, True, key=partial(fits, key))
        if index < len(values):
            return key, values[index]
    return None
