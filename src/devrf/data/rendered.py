"""The embedded scenes: exact, made in seconds, nothing to download."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from devrf.data.datamodule import SceneDataModule
from devrf.scenes.scene import Scene


class RenderedDataModule(SceneDataModule):
    """A scene rendered when it is first needed."""

    def __init__(self, recipe: Callable[[], Scene], export: str | Path | None) -> None:
        """Say how to render the scene.

        Args:
            recipe: renders it when called.
            export: the folder that ``stage=prepare`` writes the scene to.
        """
        super().__init__()
        self.recipe = recipe
        self.export = None if export is None else Path(export)

    def load(self) -> Scene:
        """Render the scene."""
        return self.recipe()
