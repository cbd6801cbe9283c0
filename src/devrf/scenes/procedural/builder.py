"""The inward-facing procedural scenes: images, cameras, flow and depth, all of it exact."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from devrf.scenes.procedural.cameras import DISTANCE, dynamic_rig, static_rig
from devrf.scenes.procedural.filming import Filming
from devrf.scenes.procedural.flower import Flower
from devrf.scenes.procedural.recipe import Recipe
from devrf.scenes.procedural.robot import Robot
from devrf.scenes.procedural.shape import BoundedShape
from devrf.scenes.procedural.truth import extent
from devrf.scenes.scene import Bounds, Scene
from devrf.scenes.validation import check_choice

SHAPES: dict[str, Callable[[float], BoundedShape]] = {"robot": Robot, "flower": Flower}


@dataclass(frozen=True)
class ProceduralScene(Recipe):
    """An object with cameras all around it, in world units about the origin.

    The other numbers are those of :class:`~devrf.scenes.procedural.recipe.Recipe`.

    Attributes:
        shape: ``robot`` (rigid parts, large fast motion) or ``flower`` (non-rigid).
        static_test_views: held-out views of the scene at rest.
    """

    shape: str = "robot"
    static_test_views: int = field(default=8, kw_only=True)

    def render(self) -> Scene:
        """The scene, from checked numbers."""
        shape = self.model()
        where = extent(shape)
        reach, size = where.reach, {"width": self.width, "height": self.height}
        learned, tested = static_rig(self.static_views, self.static_test_views, reach=reach, **size)
        watching, unseen = dynamic_rig(self.train_views, reach=reach, **size)
        film = Filming(shape, reach, self.supersample, self.light)
        return Scene(
            name=self.shape,
            kind="inward",
            static=film.at_rest(learned, tested),
            dynamic=film.moving(watching, unseen, self.frames),
            bounds=Bounds(
                box=where.rest,
                near=DISTANCE - reach,
                far=DISTANCE + reach,
                motion=where.motion,
                scale=1.0,
                source="known exactly (procedural scene)",
            ),
            background="white",
        )

    def model(self) -> BoundedShape:
        """The moving shape itself, for exact answers at any point and time."""
        check_choice("data.shape", self.shape, SHAPES)
        return SHAPES[self.shape](float(self.speed))
