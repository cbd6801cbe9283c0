"""Whether memory and disk suffice for a run: an estimate of what is large, before it begins.

Counted are the images, the fields with their gradients and Adam's state, and a batch. The rest is
small beside them; where memory runs out all the same, batches are split
(:mod:`devrf.engine.micro_batching`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, is_dataclass

import torch
from hydra.utils import instantiate
from omegaconf import OmegaConf
from torch import Tensor, nn

from devrf.cli.context import RunContext
from devrf.engine.micro_batching import MicroBatching
from devrf.errors import DevrfError
from devrf.methods.devrf.architecture import fitted_to
from devrf.system.files import free_disk
from devrf.system.memory import free_host_memory, free_memory, gib, is_oom, numbers, own_memory

# Python and its libraries on the host; measured, as is what the C library keeps of freed memory.
PROGRAM, FRAGMENTATION = 600_000_000, 1.3
# Values, gradients, Adam's two means, and the copy that a rollback returns to.
LEARNED = 5
# A checkpoint, and three progress files at once, each with values and Adam's two means.
FILES = 10
# Measured around a free-standing object: the share of a ray's samples that are occupied, and of
# these the share whose colour counts once surfaces have formed.
OCCUPIED, COLOURED = 0.3, 0.25
# A part grows with this power of the value of its key, else in proportion.
POWER = {"downscale": -2, "side": 3, "width": 2}


@dataclass(frozen=True)
class StageNeeds:
    """What a stage needs, in bytes.

    Attributes:
        parts: on the device that trains, by the config key that changes them most: the batch by
            that of its rays.
        learned: the values of the fields.
    """

    parts: Mapping[str, float]
    learned: float

    def peak(self, pieces: int = 1) -> float:
        """Bytes on the device, with each batch taken in ``pieces``."""
        batch = sum(size for key, size in self.parts.items() if key.endswith(".rays"))
        return sum(self.parts.values()) - batch * (1 - 1 / pieces)


def host_bytes(run: RunContext, stages: Iterable[StageNeeds], *, on_host: bool) -> float:
    """Bytes that stages need of the host, which trains (``on_host``) or holds what a GPU learns."""
    held = (FRAGMENTATION * s.peak() if on_host else 2 * s.learned for s in stages)
    return PROGRAM + tensor_bytes(run.scene.captures.values()) + max(held)


def needs_table(run: RunContext) -> list[tuple[str, float]]:
    """What the configured run needs, for people: names and bytes."""
    stages = needs(run)
    return [
        *((f"GPU, {name} stage", stage.peak()) for name, stage in stages.items()),
        ("host, beside a GPU", host_bytes(run, stages.values(), on_host=False)),
        ("host, without a GPU", host_bytes(run, stages.values(), on_host=True)),
        ("checkpoint", max(stage.learned for stage in stages.values())),
    ]


def tensor_bytes(value: object) -> int:
    """Bytes of all tensors in a dataclass (nested too) or an iterable."""
    if isinstance(value, Tensor):
        return value.nbytes
    if is_dataclass(value):
        return tensor_bytes(getattr(value, field.name) for field in fields(value))
    if isinstance(value, Iterable) and not isinstance(value, str):
        return sum(map(tensor_bytes, value))
    return 0


def needs(run: RunContext) -> dict[str, StageNeeds]:
    """What each stage of the configured run needs; several processes share a batch."""
    processes = int(getattr(run.strategy, "world_size", 1))
    stages = (_of_devrf if "canonical" in run.config else _of_rays)(run, processes)
    # A scene at rest that the protocol has no stage for can be looked at all the same.
    return {name: stages[name] for name in run.stages_with_images or run.learning_stages}


def _of_rays(run: RunContext, processes: int) -> dict[str, StageNeeds]:
    """Each stage of a method of ray stages trains the whole model."""
    with torch.device("meta"):
        model: nn.Module = instantiate(run.config.ray_stage.model, _convert_="all")
    schedule, learned = run.config.ray_stage.schedule, tensor_bytes(model.parameters())
    # Three values are kept for each output of each layer, for 128 samples of a ray.
    outputs = sum(layer.out_features for layer in model.modules() if isinstance(layer, nn.Linear))
    rays = max(schedule.rays, schedule.get("rays_without_hull") or 0) / processes
    parts = {
        _key_of_images(run): float(tensor_bytes(run.scene.captures.values())),
        "ray_stage.model.settings.width": LEARNED * learned,
        "ray_stage.schedule.rays": rays * 128 * 12 * outputs,
    }
    return dict.fromkeys(run.learning_stages, StageNeeds(parts, learned))


def _of_devrf(run: RunContext, processes: int) -> dict[str, StageNeeds]:
    """DeVRF's fields at their final resolution: grids of about side³ voxels in any box."""
    scene, config, images = run.scene, run.config, _key_of_images(run)
    canonical = instantiate(config.canonical, _convert_="all")
    schedule, sizes = fitted_to(scene, canonical.schedule, canonical.architecture)
    moving = instantiate(config.deformation.schedule, _convert_="all")
    last = [name for name, row in config.schedule.deformation.levels.items() if row][-1]
    values = 4 * (1 + sizes.channels) * schedule.side**3
    # With the graph of its gradients: measured, for each sample whose colour counts.
    sample = 600 + 24 * sizes.width + 96 * sizes.channels
    along = 2 / 3 * schedule.side * OCCUPIED if sizes.planes is None else sizes.planes
    ray = along / canonical.sampling.step * sample / processes
    at_rest = {
        images: tensor_bytes(scene.static.train),
        "schedule.canonical.side": LEARNED * values,
        "schedule.canonical.rays": schedule.rays * ray,
    }
    # Displacements of a frame: three numbers in both directions. Active frames are learned.
    frame, frames = 24 * moving.levels[-1].side ** 3, len(scene.clock)
    active = moving.max_parallel_frames(len(moving.levels) - 1, frames)
    held = active if config.schedule.motion.store == "host" else frames
    in_motion = {
        images: tensor_bytes(scene.dynamic.train),
        "schedule.canonical.side": values,
        f"schedule.deformation.levels.{last}.side": frame * (held + LEARNED * active),
        "schedule.deformation.rays": active * moving.rays * COLOURED * ray,
    }
    refined = {**in_motion, "schedule.canonical.side": LEARNED * values}
    return {
        "canonical": StageNeeds(at_rest, values),
        "deformation": StageNeeds(in_motion, values + frames * frame),
        "refinement": StageNeeds(refined, values + frames * frame),
    }


def _key_of_images(run: RunContext) -> str:
    return "data.downscale" if "downscale" in run.config.data else "data.frames"


def check_memory(run: RunContext, names: Sequence[str]) -> str:
    """Compare what the stages ``names`` need with what there is; both, in one line.

    Raises:
        DevrfError: memory or disk cannot suffice.
    """
    every = needs(run)
    stages = [every[name] for name in names]
    stage = max(stages, key=StageNeeds.peak)
    on_gpu = run.device.type == "cuda"
    host = host_bytes(run, stages, on_host=not on_gpu)
    host *= 1 if on_gpu else int(getattr(run.strategy, "num_processes", 1))
    disk = FILES * max(one.learned for one in stages)
    room = free_disk(run.folder)
    if run.config.resume:  # what is there is replaced
        room += sum(file.stat().st_size for file in run.folder.glob("checkpoints/*.ckpt"))
    # What, needed, needed at least, there.
    compared = [
        ("host memory", host, host, free_host_memory() + own_memory()),
        ("disk", disk, disk, room),
    ]
    if on_gpu:
        least = stage.peak(MicroBatching.MOST)
        compared.insert(0, ("GPU memory", stage.peak(), least, free_memory(run.device)))
    said = ", ".join(f"{gib(n)} of {gib(there)} GiB of {what}" for what, n, _, there in compared)
    for what, _, least, there in compared:
        if least > there:
            key, part = max(stage.parts.items(), key=lambda item: item[1])
            share = 1 - (1 - there / least) * stage.peak() / part
            raise DevrfError(
                f"{key}: the run needs about {said}; it would end for lack of {what}: give "
                f"{_smaller(run, key, share)}, or try all the same with memory_check=false"
            )
    split = any(needed > there for _, needed, _, there in compared)
    return f"needs about {said}{'; batches will be split, slower' if split else ''}"


def _smaller(run: RunContext, key: str, share: float) -> str:
    """``key=VALUE`` with which its part takes ``share`` as much; in words where that is unknown."""
    value = OmegaConf.select(run.config, key)
    if share <= 0 or not isinstance(value, int | float):
        return f"another {key}"
    power = POWER.get(key.rpartition(".")[2], 1)
    scaled = value * share ** (1 / power)
    return f"{key}={math.ceil(scaled) if power < 0 else max(math.floor(scaled), 1)}"


@contextmanager
def shortage_in_words(name: str, run: RunContext) -> Iterator[None]:
    """Raise a DevrfError where memory runs out in the step ``name``."""
    try:
        yield
    except (RuntimeError, MemoryError) as error:
        if not is_oom(error):
            raise
        rays = f"schedule.{name}.rays"
        known = OmegaConf.select(run.config, rays) is not None
        hint = f"lower {rays}" if known else "free some of it, or use a larger machine"
        raise DevrfError(
            f"stage={name}: out of memory ({numbers(str(error), run.device)}); {hint}; what was "
            "written before stays"
        ) from error
