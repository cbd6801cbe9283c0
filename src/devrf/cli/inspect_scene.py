"""The steps that learn nothing: ``stage=inspect`` and ``stage=prepare``."""

from __future__ import annotations

import logging
from collections.abc import Mapping

from rich.console import Console
from rich.filesize import decimal

from devrf.artifacts.inspection.report import inspect_scene
from devrf.artifacts.inspection.text import inspection_text
from devrf.artifacts.tables import as_text
from devrf.cli.context import RunContext
from devrf.cli.memory import Budget, StageMemory
from devrf.cli.preflight import estimated
from devrf.errors import DevrfError
from devrf.scenes.export import export

log = logging.getLogger(__name__)


def prepare(run: RunContext) -> None:
    """Write the scene to ``data.export`` in the published layout."""
    folder = getattr(run.datamodule, "export", None)
    if folder is None:
        raise DevrfError("data.export: stage=prepare needs a folder; give data.export=PATH")
    export(run.scene, folder)
    log.info("scene written to %s", folder)


def inspect(run: RunContext) -> None:
    """Report and draw what the scene holds and what may be wrong with it; learn nothing."""
    # Only this step draws with matplotlib.
    from devrf.artifacts.inspection.picture import write_inspection_picture

    report = inspection_text(inspect_scene(run.scene), _requirements(estimated(run)))
    console = Console()
    if console.is_terminal:
        console.print(report)
    else:
        log.info("%s", as_text(report))
    path = run.folder / "images" / "inspect.png"
    write_inspection_picture(path, run.scene)
    log.info("picture written to %s", path)


def _requirements(budget: Budget) -> list[tuple[str, str, str]]:
    """Rows of what is needed, how much of it, and its largest parts."""
    alone = "the scene and the larger stage"
    return [
        ("GPU, canonical stage", decimal(budget.canonical.peak), _largest(budget.canonical)),
        ("GPU, deformation stage", decimal(budget.deformation.peak), _largest(budget.deformation)),
        ("host, beside a GPU", decimal(budget.host), "the scene: " + _parts(budget.scene)),
        ("host, without a GPU", decimal(budget.host_alone), alone),
        ("checkpoint", decimal(sum(budget.checkpoint.values())), _parts(budget.checkpoint, 2)),
    ]


def _largest(stage: StageMemory) -> str:
    worst = max(stage.passing, key=lambda name: stage.passing[name])
    return _parts({**stage.held, worst: stage.passing[worst]})


def _parts(parts: Mapping[str, int], most: int = 3) -> str:
    """The largest parts, by name."""
    ordered = sorted(parts.items(), key=lambda part: -part[1])
    return ", ".join(f"{name} {decimal(count)}" for name, count in ordered[:most])
