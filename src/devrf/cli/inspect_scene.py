"""The steps that learn nothing: ``stage=inspect`` and ``stage=prepare``."""

from __future__ import annotations

import logging

from rich.console import Console
from rich.filesize import decimal

from devrf.apps.inspection.report import as_text, inspection_text
from devrf.cli.context import RunContext
from devrf.cli.preflight import requirements
from devrf.errors import DevrfError
from devrf.scenes.export import export

log = logging.getLogger(__name__)


def prepare(run: RunContext) -> None:
    """Write the scene to ``data.export`` in the published layout."""
    if not hasattr(run.datamodule, "export"):
        raise DevrfError(
            "stage=prepare: writes an embedded scene; choose data=procedural or "
            "data=procedural_forward, and give data.export=PATH"
        )
    folder = run.datamodule.export
    if folder is None:
        raise DevrfError("data.export: stage=prepare needs a folder; give data.export=PATH")
    export(run.scene, folder)
    log.info("scene written to %s", folder)


def inspect(run: RunContext) -> None:
    """Report and draw what the scene holds and what may be wrong with it."""
    # Only this step draws with matplotlib.
    from devrf.apps.inspection.picture import write_inspection_picture

    needs = [(name, decimal(size)) for name, size in requirements(run).rows()]
    report = inspection_text(run.scene, needs)
    console = Console()
    if console.is_terminal:
        console.print(report)
    else:
        log.info("%s", as_text(report))
    path = run.folder / "images" / "inspect.png"
    write_inspection_picture(path, run.scene)
    log.info("picture written to %s", path)
