"""Whether memory and disk suffice for a run, checked before it begins."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

from hydra.utils import instantiate
from omegaconf import OmegaConf

from devrf.apps.video import video_bytes
from devrf.callbacks import PeriodicCheckpoint
from devrf.cli.context import RunContext
from devrf.cli.memory import IMAGES, Budget, Parts, estimate, module_needs, tensor_bytes
from devrf.cli.scene_stages import stages_with_images
from devrf.engine.micro_batching import MicroBatching
from devrf.errors import DevrfError
from devrf.system.files import free_disk
from devrf.system.memory import free_host_memory, free_memory, gib, is_oom, numbers, own_memory

# Keys that lower the need, by the stage that ran out of memory.
LOWER = {
    "canonical": "schedule.canonical.side or schedule.canonical.rays",
    "deformation": "schedule.deformation.levels, schedule.deformation.rays or data.frames",
}


@dataclass(frozen=True)
class Requirement:
    """How much a run needs of ``what``, in bytes.

    Attributes:
        what: in words: ``host memory``.
        needed: how much.
        there: how much is available.
        parts: what it is made of.
        least: the least that the run can do with.
    """

    what: str
    needed: int
    there: int
    parts: Parts
    least: int

    def __str__(self) -> str:
        return f"{gib(self.needed)} of {gib(self.there)} GiB of {self.what}"

    @property
    def keys(self) -> list[str]:
        """The config keys that change it, those of the largest part first."""
        largest = sorted(self.parts, key=lambda keys: -self.parts[keys])
        return list(dict.fromkeys(key for keys in largest if self.parts[keys] for key in keys))


def requirements(run: RunContext) -> Budget:
    """What the configured run needs; several processes share a batch."""
    budget = _of_devrf(run) if "canonical" in run.config else _of_rays(run)
    processes = getattr(run.strategy, "world_size", 1)
    # A scene at rest that the protocol has no stage for can be looked at all the same.
    kept = stages_with_images(run) or run.learning_stages
    stages = {k: replace(budget.stages[k], batch=budget.stages[k].batch // processes) for k in kept}
    return replace(budget, stages=stages)


def _of_rays(run: RunContext) -> Budget:
    """The budget of a method of ray stages: each trains the whole model."""
    model = instantiate(run.config.ray_stage.model, _convert_="all")
    schedule, scene = run.config.ray_stage.schedule, run.scene
    rays = max(schedule.rays, schedule.get("rays_without_hull") or 0)
    stages = {
        step.name: module_needs(
            model,
            (scene.static if step.capture == "static" else scene.dynamic).train,
            keys=("ray_stage.schedule.rays",),
            batch=model.batch_bytes(rays),
            rays="ray_stage.schedule.rays",
        )
        for step in run.protocol.steps
    }
    return Budget(tensor_bytes(scene.captures.values()), stages)


def _of_devrf(run: RunContext) -> Budget:
    canonical = instantiate(run.config.canonical, _convert_="all")
    budget = estimate(
        run.scene,
        canonical.schedule,
        instantiate(run.config.deformation.schedule, _convert_="all"),
        canonical.architecture,
        canonical.sampling.step,
        instantiate(run.config.deformation.motion, _convert_="all"),
    )
    # It holds what the deformation has learned, and learns the canonical field.
    return replace(budget, stages={**budget.stages, "refinement": budget.stages["deformation"]})


def preflight(run: RunContext, learns: Sequence[str], *, films: bool) -> str | None:
    """Compare what a run needs with what there is.

    Args:
        run: the run; its scene is read.
        learns: names of the stages that it will learn, finished ones included.
        films: whether the run makes videos.

    Returns:
        Both, in one line; None where every stage is finished.

    Raises:
        DevrfError: memory or disk cannot suffice.
    """
    config = run.config
    names = [name for name in learns if not (config.resume and run.own_checkpoint(name).is_file())]
    if not names:
        return None
    budget = requirements(run)
    budget = replace(budget, stages={name: budget.stages[name] for name in names})
    stage = max(budget.stages.values(), key=lambda one: one.peak())
    parts = {**stage.held, (stage.rays,): stage.batch}
    needs, on_gpu = [], run.device.type == "cuda"
    if on_gpu:
        there, least = free_memory(run.device), stage.peak(MicroBatching.MOST)
        needs.append(Requirement("GPU memory", stage.peak(), there, parts, least))
    host = budget.host(alone=not on_gpu, processes=getattr(run.strategy, "num_processes", 1))
    on_host = Counter(stage.held if on_gpu else parts) + Counter({IMAGES: budget.scene})
    there = free_host_memory() + own_memory()
    needs.append(Requirement("host memory", host, there, on_host, host))
    free, videos = free_disk(run.folder), 0
    if config.resume:  # these files will be replaced
        free += sum(file.stat().st_size for file in run.folder.glob("checkpoints/*.ckpt"))
    if films:
        videos = video_bytes(instantiate(config.video), run.scene.static.train.cameras)
    disk = budget.disk(kept=PeriodicCheckpoint.KEPT, films=videos)
    needs.append(Requirement("disk", disk, free, stage.held, disk))
    return check(needs, lambda key: OmegaConf.select(config, key, default="") != "")


def check(needs: Sequence[Requirement], known: Callable[[str], bool]) -> str:
    """What is needed, in one line; ``known`` says whether the config has a key.

    Raises:
        DevrfError: something does not suffice.
    """
    said = f"needs about {', '.join(map(str, needs))}"
    for need in needs:
        if need.least > need.there:
            keys = list(filter(known, need.keys))[:4]
            raise DevrfError(
                f"{keys[0] if keys else 'data'}: the run {said}; it would end for lack of "
                f"{need.what}: change {', '.join(keys)}, or try all the same with "
                "memory_check=false"
            )
    short = any(need.needed > need.there for need in needs)
    return f"{said}; batches will be taken in parts, slower" if short else said


@contextmanager
def shortage_in_words(name: str, run: RunContext) -> Iterator[None]:
    """Raise a DevrfError where memory runs out in the step ``name``."""
    try:
        yield
    except (RuntimeError, MemoryError) as error:
        if not is_oom(error):
            raise
        keys = LOWER.get(name)
        hint = f"lower {keys}" if keys else "free some of it, or use a larger machine"
        raise DevrfError(
            f"stage={name}: out of memory ({numbers(str(error), run.device)}); {hint}; what was "
            "written before stays"
        ) from error
