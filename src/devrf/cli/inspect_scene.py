"""The steps that learn nothing: ``stage=inspect`` and ``stage=prepare``."""

from __future__ import annotations

import logging

from rich.console import Console

from devrf.artifacts.inspection import inspect_scene
from devrf.artifacts.inspection_picture import write_inspection_picture
from devrf.artifacts.inspection_text import plain, tables
from devrf.cli.context import RunContext
from devrf.cli.memory import budget_rows
from devrf.cli.preflight import requirements
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
    """Say and draw what the scene holds and what may be wrong with it; learn nothing."""
    rows = budget_rows(requirements(run))
    found = inspect_scene(run.scene)
    console = Console()
    if console.is_terminal:
        console.print(tables(found, rows))
    else:
        log.info("%s", plain(found, rows))
    path = run.folder / "images" / "inspect.png"
    write_inspection_picture(path, run.scene)
    log.info("picture written to %s", path)
