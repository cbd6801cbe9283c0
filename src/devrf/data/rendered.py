"""The embedded scenes: exact, made in seconds, nothing to download."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import replace
from functools import lru_cache
from typing import Any, Literal, get_args

from devrf.data.datamodule import SceneDataModule
from devrf.scenes.procedural.filming import exact_flow
from devrf.scenes.procedural.recipe import ProceduralScene, Recipe
from devrf.scenes.scene import Scene
from devrf.scenes.validation import scene_error

Flow = Literal["exact", "none"]
FLOWS = get_args(Flow)


@lru_cache(maxsize=1)
def rendered(recipe: Callable[[], Scene]) -> Scene:
    """The recipe's scene; the jobs of a sweep over settings render it once."""
    return recipe()


class ProceduralDataModule(SceneDataModule):
    """An embedded scene, rendered when it is first needed."""

    def __init__(
        self,
        *shape: Any,
        recipe: Callable[..., Callable[[], Scene]] = ProceduralScene,
        flow: Flow = "exact",
        **numbers: Any,
    ) -> None:
        """Choose the scene.

        Args:
            shape: the shape, or the scene's name.
            recipe: :class:`ProceduralScene` or :class:`ProceduralForwardScene`.
            flow: the training images' optical flow.
            numbers: the recipe's options.
        """
        super().__init__()
        self.recipe = recipe(*shape, **numbers)
        if flow not in FLOWS:
            raise scene_error("data.flow", f"expected 'exact' or 'none', not {flow!r}")
        self.flow = flow

    def load(self) -> Scene:
        """Render the scene."""
        scene = rendered(self.recipe)
        if self.flow == "exact":
            return scene
        dynamic = replace(scene.dynamic, train=replace(scene.dynamic.train, flow=None))
        return replace(scene, dynamic=dynamic)

    def provide(self, priors: Collection[str]) -> None:
        """Compute exact forward flow, if a method needs it."""
        scene = self.scene
        train = self.scene.dynamic.train
        wanted = "forward_flow" in priors and train.forward_flow is None
        if self.flow == "exact" and wanted and isinstance(self.recipe, Recipe):
            flow = exact_flow(self.recipe.visible_shape(), train, forward=True)
            train = replace(train, forward_flow=flow)
            self.replace(replace(scene, dynamic=replace(scene.dynamic, train=train)))
