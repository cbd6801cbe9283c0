"""Whether the machine has room for a run, before it has cost any time."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

from hydra.utils import instantiate
from omegaconf import OmegaConf

from devrf.artifacts.film import film_bytes
from devrf.callbacks import PeriodicCheckpoint
from devrf.cli.context import RunContext
from devrf.cli.memory import Budget, estimate
from devrf.cli.requirements import Requirement, check, disk_need, gpu_need, host_need
from devrf.errors import DevrfError
from devrf.system.machine import free_disk, free_host_memory, free_memory, own_memory
from devrf.system.out_of_memory import is_oom, numbers

# What lowers the need, by the step that has too little.
LOWER = {
    "canonical": "schedule.canonical.side or schedule.canonical.rays",
    "deformation": "schedule.deformation.sides, schedule.deformation.rays or data.frames",
}


def preflight(run: RunContext, learns: Sequence[str], *, scores: bool, films: bool) -> str | None:
    """Compare what a run needs with what there is; all figures are estimates.

    Stages whose checkpoint is there already need nothing.

    Args:
        run: the run; its scene is read.
        learns: the stages that it will learn, by name.
        scores: whether it also scores or films.
        films: whether it makes videos.

    Returns:
        Both, in one line; None where nothing is needed.

    Raises:
        DevrfError: memory or disk cannot suffice.
    """
    resumed = run.config.resume
    stages = [name for name in learns if not (resumed and run.own_checkpoint(name).is_file())]
    if not stages:
        return None
    processes = getattr(run.strategy, "num_processes", 1)
    world = getattr(run.strategy, "world_size", 1)
    budget = estimated(run, world)
    on_gpu = run.device.type == "cuda"
    host = free_host_memory()
    needs: list[Requirement] = [gpu_need(budget, stages, free_memory(run.device))] if on_gpu else []
    needs.append(
        host_need(
            budget,
            stages,
            None if host is None else host + own_memory(),
            alone=not on_gpu,
            scores=scores,
            processes=processes,
        )
    )
    disk, videos = free_disk(run.folder), 0
    if films:
        videos = 2 * film_bytes(instantiate(run.config.video), run.scene.static.train.cameras)
    if disk is not None and resumed:
        disk += sum(file.stat().st_size for file in run.folder.glob("checkpoints/*.ckpt"))
    needs.append(disk_need(budget, stages, disk, kept=PeriodicCheckpoint.KEPT, films=videos))
    settings = OmegaConf.to_container(run.config)
    assert isinstance(settings, dict)
    return check(needs, set(_keys(settings)))


def estimated(run: RunContext, processes: int = 1) -> Budget:
    """What the configured run will need, in each of some processes that share the rays."""
    canonical = instantiate(run.config.canonical, _convert_="all")
    moving = instantiate(run.config.deformation.schedule, _convert_="all")
    motion = instantiate(run.config.deformation.motion, _convert_="all")
    resting = canonical.schedule
    return estimate(
        run.scene,
        replace(resting, rays=-(-resting.rays // processes)),
        replace(moving, rays=-(-moving.rays // processes)),
        canonical.architecture,
        canonical.sampling.step,
        motion,
    )


@contextmanager
def shortage_in_words(name: str, run: RunContext) -> Iterator[None]:
    """Say in one line that memory has run out where nothing could be done about it.

    Args:
        name: the step.
        run: says where it works.

    Raises:
        DevrfError: it has.
    """
    try:
        yield
    except (RuntimeError, MemoryError) as error:
        if not is_oom(error):
            raise
        said = str(error)
        keys = LOWER.get(name)
        remedy = f"lower {keys}" if keys else "free some of it, or use a larger machine"
        raise DevrfError(
            f"stage={name}: out of memory ({numbers(said, run.device)}); {remedy}; what was "
            "written before stays"
        ) from error


def _keys(values: Mapping[Any, Any], path: str = "") -> Iterator[str]:
    """Every key of nested settings, with dots."""
    for key, value in values.items():
        yield f"{path}{key}"
        if isinstance(value, Mapping):
            yield from _keys(value, f"{path}{key}.")
