"""The inward-facing procedural scenes: images, cameras, flow and depth, all of it exact."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from devrf.scenes.inward_space import inward_space
from devrf.scenes.procedural.cameras import HAND_HELD, STUDIO, dynamic_rig, static_rig
from devrf.scenes.procedural.filming import Filming
from devrf.scenes.procedural.flower import Flower
from devrf.scenes.procedural.recipe import Recipe
from devrf.scenes.procedural.robot import Robot
from devrf.scenes.procedural.room import REACH, STEPS, Room
from devrf.scenes.procedural.shape import BoundedShape, Shape
from devrf.scenes.procedural.surrounded import Surrounded
from devrf.scenes.procedural.truth import extent
from devrf.scenes.scene import Bounds, Scene
from devrf.scenes.validation import check_choice

SHAPES: dict[str, Callable[[float], BoundedShape]] = {"robot": Robot, "flower": Flower}


SURROUNDINGS = ("none", "room")
TEXTURES = ("soft", "fine")


@dataclass(frozen=True)
class ProceduralScene(Recipe):
    """An object with cameras all around it, in world units about the origin.

    The other numbers are those of :class:`~devrf.scenes.procedural.recipe.Recipe`.

    Attributes:
        shape: ``robot`` (rigid parts, large fast motion) or ``flower`` (non-rigid).
        static_test_views: held-out views of the scene at rest.
        surroundings: ``none``: the images have mattes; ``room``: the object stands in a furnished
            room, filmed from inside it, and the images have none.
        texture: how the room is painted: ``soft``, or ``fine`` for images of about 240 pixels or
            more, in which no place looks like another.
    """

    shape: str = "robot"
    static_test_views: int = field(default=8, kw_only=True)
    surroundings: str = field(default="none", kw_only=True)
    texture: str = field(default="soft", kw_only=True)

    def render(self) -> Scene:
        """The scene, from checked numbers."""
        shape = self.model()
        where = extent(shape)
        reach, size = where.reach, {"width": self.width, "height": self.height}
        check_choice("data.surroundings", self.surroundings, SURROUNDINGS)
        check_choice("data.texture", self.texture, TEXTURES)
        inside = self.surroundings == "room"
        rig = HAND_HELD if inside else STUDIO
        views = self.static_views, self.static_test_views
        learned, tested = static_rig(*views, reach=reach, rig=rig, **size)
        watching, unseen = dynamic_rig(self.train_views, reach=reach, rig=rig, **size)
        film = Filming(shape, reach, self.supersample, self.light)
        if inside:
            room = self.filmed()
            film = Filming(room, REACH, self.supersample, self.light, STEPS, opaque=True)
        static, dynamic = (
            film.at_rest(learned, tested),
            film.moving(watching, unseen, self.frames, self.unseen_frames),
        )
        if inside:
            everyone = [static.train, static.test, dynamic.train, dynamic.test]
            space, bounds = inward_space("auto", static.train, dynamic.train, everyone)
            return Scene(f"{self.shape}_room", "inward", static, dynamic, bounds, "white", space)
        bounds = Bounds(
            box=where.rest,
            near=rig.distance - reach,
            far=rig.distance + reach,
            motion=where.motion,
            scale=1.0,
            source="known exactly (procedural scene)",
        )
        return Scene(self.shape, "inward", static, dynamic, bounds, "white")

    def filmed(self) -> Shape:
        """The moving shape, in its room if there is one."""
        shape = self.model()
        if self.surroundings == "none":
            return shape
        where = extent(shape)
        room = Room(floor=where.motion.low[2], weave=self.texture == "fine")
        return Surrounded(shape, room, where.reach)

    def model(self) -> BoundedShape:
        """The moving shape itself, for exact answers at any point and time."""
        check_choice("data.shape", self.shape, SHAPES)
        return SHAPES[self.shape](float(self.speed))
