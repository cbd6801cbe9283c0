"""The embedded forward-facing scene: exact, made in seconds, nothing to download."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from devrf.data.options import takes_options_of
from devrf.data.rendered import RenderedDataModule
from devrf.scenes.procedural.recipe import ProceduralForwardScene


@dataclass(frozen=True, kw_only=True)
class ExportableScene(ProceduralForwardScene):
    """The recipe, and where to write the scene.

    Attributes:
        export: the folder that ``stage=prepare`` writes the scene to.
    """

    export: str | Path | None = None


class ProceduralForwardDataModule(RenderedDataModule):
    """A soft toy on a pedestal before a painted wall, seen from one side."""

    @takes_options_of(ExportableScene)
    def __init__(self, *name: Any, **options: Any) -> None:
        """Say what to render; see :class:`ProceduralForwardScene`."""
        recipe = ExportableScene(*name, **options)
        super().__init__(recipe, recipe.export)
