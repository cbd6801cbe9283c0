"""Memory and disk that a run needs, by the config keys that change it most; what is free."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from rich.filesize import decimal

from devrf.engine.needs import SIZE, StageNeeds, tensor_bytes
from devrf.scenes.scene import Scene
from devrf.system.files import free_disk
from devrf.system.memory import free_host_memory, free_memory, gib, own_memory

# A checkpoint, and three progress files at once, each with values and Adam's two means.
FILES = 10
# Python and its libraries on the host; measured, as is the freed memory that the C library keeps.
PROGRAM, FRAGMENTATION = 600_000_000.0, 1.3
# Bytes by config key.
Parts = Mapping[str, float]
# Images are made at most so many times smaller.
MAX_DOWNSCALE = 8


@dataclass(frozen=True)
class Forecast:
    """Bytes that a run needs and that there are, by resource (GPU memory, host memory, disk).

    Attributes:
        needed: the parts of what is needed, by config key; those of no key under "".
        free: what is available.
    """

    needed: Mapping[str, Parts]
    free: Mapping[str, float]

    def shortage(self, downscale: float = 1.0) -> str | None:
        """The first resource of which there is too little, if any, with images so much smaller."""
        images = 1 - 1 / downscale**2
        for name, free in self.free.items():
            if _total(self.needed[name]) - images * self.needed[name].get(SIZE, 0.0) > free:
                return name
        return None

    def key(self, resource: str) -> str:
        """The config key of the largest part of a resource."""
        parts = self.needed[resource]
        return max((key for key in parts if key), key=parts.__getitem__)

    def downscale(self, present: int) -> int | None:
        """The least factor above ``present`` by which images are small enough, if any."""
        factors = range(present + 1, MAX_DOWNSCALE * present + 1)
        return next((f for f in factors if self.shortage(f / present) is None), None)

    def __str__(self) -> str:
        """Needed and free amounts, in words."""
        return ", ".join(
            f"{gib(_total(self.needed[name]))} of {gib(free)} GiB of {name}"
            for name, free in self.free.items()
        )


def free_bytes(device: torch.device, folder: Path, *, resume: bool) -> dict[str, float]:
    """Bytes available to a run in ``folder``; with ``resume`` it replaces the checkpoints there."""
    disk: float = free_disk(folder)
    if resume:
        disk += sum(file.stat().st_size for file in folder.glob("checkpoints/*.ckpt"))
    gpu = {"GPU memory": float(free_memory(device))} if device.type == "cuda" else {}
    return {**gpu, "host memory": free_host_memory() + own_memory(), "disk": disk}


def needed_bytes(
    scene: Scene, stages: Sequence[StageNeeds], processes: int, *, on_gpu: bool
) -> dict[str, Parts]:
    """Needs of stages by resource; ``processes`` train on the host, unless on GPUs."""
    host = _host(scene, stages, trains=not on_gpu)
    return {
        "GPU memory": max((stage.parts for stage in stages), key=_total),
        "host memory": _times(1 if on_gpu else processes, host),
        "disk": _times(FILES, max((stage.learned for stage in stages), key=_total)),
    }


def needs_table(scene: Scene, stages: Mapping[str, StageNeeds]) -> list[tuple[str, str]]:
    """Needs of ``stages``, for people: names and amounts."""
    needs = [*stages.values()]
    rows = [
        *((f"GPU, {name} stage", stage.parts) for name, stage in stages.items()),
        ("host, beside a GPU", _host(scene, needs, trains=False)),
        ("host, without a GPU", _host(scene, needs, trains=True)),
        ("checkpoint", max((stage.learned for stage in needs), key=_total)),
    ]
    return [(name, decimal(round(_total(parts)))) for name, parts in rows]


def _host(scene: Scene, stages: Sequence[StageNeeds], *, trains: bool) -> Parts:
    """Needs of the host, which ``trains`` the stages or holds a GPU's results."""
    held = [_times(FRAGMENTATION, s.parts) if trains else _times(2, s.learned) for s in stages]
    parts = max(held, key=_total)
    captures = tensor_bytes(scene.captures.values())
    return {**parts, SIZE: parts.get(SIZE, 0.0) + captures, "": PROGRAM}


def _times(factor: float, parts: Parts) -> Parts:
    return {key: factor * size for key, size in parts.items()}


def _total(parts: Parts) -> float:
    return sum(parts.values())
