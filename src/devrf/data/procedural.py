"""The embedded inward-facing scenes: exact, made in seconds, nothing to download."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from devrf.data.options import takes_options_of
from devrf.data.rendered import RenderedDataModule
from devrf.scenes.procedural.recipe import ProceduralScene


@dataclass(frozen=True, kw_only=True)
class ExportableScene(ProceduralScene):
    """The recipe, and where to write the scene.

    Attributes:
        export: the folder that ``stage=prepare`` writes the scene to.
    """

    export: str | Path | None = None


class ProceduralDataModule(RenderedDataModule):
    """An embedded inward-facing scene, ``robot`` or ``flower``."""

    @takes_options_of(ExportableScene)
    def __init__(self, *shape: Any, **options: Any) -> None:
        """Say what to render; see :class:`ProceduralScene`."""
        recipe = ExportableScene(*shape, **options)
        super().__init__(recipe, recipe.export)
