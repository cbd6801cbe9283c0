"""The embedded scenes: exact, made in seconds, nothing to download."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import replace
from pathlib import Path
from typing import Any

from devrf.data.datamodule import SceneDataModule
from devrf.scenes.procedural.filming import exact_flow
from devrf.scenes.procedural.recipe import ProceduralScene, Recipe
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

    def provide(self, priors: Collection[str]) -> None:
        """Compute exact forward flow, if a method wants it."""
        scene, train = self.scene, self.scene.dynamic.train
        wanted = "forward_flow" in priors and train.forward_flow is None
        if wanted and isinstance(self.recipe, Recipe):
            flow = exact_flow(self.recipe.filmed(), train, forward=True)
            train = replace(train, forward_flow=flow)
            self.replace(replace(scene, dynamic=replace(scene.dynamic, train=train)))


class ProceduralDataModule(RenderedDataModule):
    """An embedded scene: ``robot`` or ``flower``, or another recipe's."""

    def __init__(
        self,
        *shape: Any,
        recipe: Callable[..., Recipe] = ProceduralScene,
        export: str | Path | None = None,
        **numbers: Any,
    ) -> None:
        """Say what to render.

        Args:
            shape: which shape, or the scene's name.
            recipe: :class:`ProceduralScene` or :class:`ProceduralForwardScene`.
            export: the folder that ``stage=prepare`` writes the scene to.
            numbers: of the recipe.
        """
        super().__init__(recipe(*shape, **numbers), export)
