"""The procedural scenes: the numbers that each is made from, checked, and how it is rendered."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Literal

import torch

from devrf.scenes.bounds import forward_bounds, reference_space
from devrf.scenes.procedural.filming import Filming, extent
from devrf.scenes.procedural.flower import Flower
from devrf.scenes.procedural.plush import Plush
from devrf.scenes.procedural.rigs import (
    HAND_HELD,
    STUDIO,
    dynamic_rig,
    facing_dynamic_rig,
    facing_static_rig,
    static_rig,
)
from devrf.scenes.procedural.robot import Robot
from devrf.scenes.procedural.solids import BoundedShape, Shape
from devrf.scenes.procedural.surroundings import REACH, STEPS, Backdrop, Room, Surrounded
from devrf.scenes.scene import Bounds, Scene
from devrf.scenes.space import inward_space
from devrf.scenes.splits import every_nth
from devrf.scenes.validation import MIN_SIDE, check_choice, scene_error

_LARGEST_SIDE = 4096
_MOST = 10_000
# Least and largest value of each count that a recipe may have.
_COUNTS = {
    "width": (MIN_SIDE, _LARGEST_SIDE),
    "height": (MIN_SIDE, _LARGEST_SIDE),
    "static_views": (1, _MOST),
    "static_test_views": (1, _MOST),
    "train_views": (1, _MOST),
    "frames": (2, _MOST),
    "supersample": (1, 16),
}
# Further than at this speed the flower folds into itself, the robot goes through its own body
# and the toy is squashed to pieces.
_FASTEST = 2.0


@dataclass(frozen=True, kw_only=True)
class Recipe(ABC):
    """Calling a recipe renders its scene. The same recipe always gives the same scene.

    Attributes:
        width: image width in pixels.
        height: image height in pixels.
        static_views: training views of the scene at rest.
        train_views: fixed cameras that watch the scene move (V); one more is held out.
        frames: number of frames T, at times k / (T − 1).
        speed: scales how far everything moves; 0 is still.
        supersample: n × n rays a pixel.
        light: share of the lamp in the lighting, 0 … 1: how much motion changes the colours.
        novel_times_every: n: every n-th frame is seen by the held-out camera alone, the last
            frame excepted; None: all frames are learned from.
    """

    width: int = 96
    height: int = 96
    static_views: int = 36
    train_views: int = 4
    frames: int = 14
    speed: float = 1.0
    supersample: int = 2
    light: float = 0.2
    novel_times_every: int | None = None

    @property
    def unseen_frames(self) -> list[int]:
        """The frames that are not learned from."""
        if self.novel_times_every is None:
            return []
        _, held_out = every_nth(self.frames, self.novel_times_every)
        return [frame for frame in held_out if frame < self.frames - 1]

    def __call__(self) -> Scene:
        """Render everything.

        Raises:
            DevrfError: an argument is out of range.
        """
        # Not in __post_init__: Hydra would wrap the error in one of its own, many lines long.
        self._check()
        with _one_thread():
            return self.render()

    @abstractmethod
    def render(self) -> Scene:
        """The scene, from checked numbers."""

    @abstractmethod
    def filmed(self) -> Shape:
        """All that the cameras see, for exact answers at any point and time."""

    def _check(self) -> None:
        for key, (least, most) in _COUNTS.items():
            value = getattr(self, key, least)
            if isinstance(value, bool) or not isinstance(value, int):
                raise scene_error(f"data.{key}", f"must be a whole number, not {value!r}")
            if not least <= value <= most:
                bound = f"at least {least}" if value < least else f"at most {most}"
                raise scene_error(f"data.{key}", f"must be {bound}, not {value}")
        every = self.novel_times_every
        whole = isinstance(every, int) and not isinstance(every, bool)
        if every is not None and not (whole and 2 <= every < self.frames):
            expected = f"must be a whole number in 2 … {self.frames - 1}, or null, not {every!r}"
            raise scene_error("data.novel_times_every", expected)
        for key, highest in (("speed", _FASTEST), ("light", 1.0)):
            given = getattr(self, key)
            number = isinstance(given, int | float) and not isinstance(given, bool)
            if not (number and 0 <= given <= highest):
                expected = f"must be a number in 0 … {highest:g}, not {given!r}"
                raise scene_error(f"data.{key}", expected)


@contextmanager
def _one_thread() -> Iterator[None]:
    """PyTorch on one thread inside, on as many as before afterwards.

    Rendering is thousands of small operations: a second thread gains little, and where the cores
    are shared with others it waits at each of them, which makes a scene take minutes.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


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
        surroundings: ``none``: the images have alpha masks; ``room``: the object stands in a
            furnished room, filmed from inside it, and the images have none.
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


# Radius of a ball about the origin that holds all that the cameras see of wall and floor.
_REACH = 9.0
# One static view in so many is held out, the first one included, as readers of LLFF do.
HOLDOUT = 8
NEAR = 1.0
# Rays that creep past the toy have to reach the wall: with 256 steps a few in a million do not.
_STEPS = 400


@dataclass(frozen=True)
class ProceduralForwardScene(Recipe):
    """A soft toy on a pedestal before a painted wall, seen from one side.

    The world is the one that :class:`devrf.scenes.formats.llff.LlffReader` makes: the static
    cameras' average pose is the identity, and nothing is nearer to a camera than 1/0.75. Besides
    ``static_views`` to learn from there are held-out ones, one in eight of all. The other
    numbers are those of :class:`~devrf.scenes.procedural.recipe.Recipe`.

    Attributes:
        name: the scene's name.
        texture: how wall and floor are painted: ``soft``, or ``fine`` for images of about 240
            pixels or more, in which it has waves of five to twelve pixels.
    """

    name: str = "plush"
    texture: Literal["soft", "fine"] = field(default="soft", kw_only=True)
    height: int = field(default=72, kw_only=True)
    static_views: int = field(default=20, kw_only=True)
    frames: int = field(default=12, kw_only=True)

    def render(self) -> Scene:
        """The scene, from checked numbers."""
        film = Filming(self.model(), _REACH, self.supersample, self.light, _STEPS, opaque=True)
        size = {"width": self.width, "height": self.height}
        # Of each eight views seven are learned from.
        held_out = -(-self.static_views // (HOLDOUT - 1))
        static = facing_static_rig(self.static_views + held_out, **size)
        order = torch.arange(len(static))
        learned, tested = static[order % HOLDOUT != 0], static[order % HOLDOUT == 0]
        watching, unseen = facing_dynamic_rig(self.train_views, **size)
        at_rest = film.at_rest(learned, tested)
        moving = film.moving(watching, unseen, self.frames, self.unseen_frames)
        space = reference_space(static, NEAR)
        source = "all that the cameras see (procedural scene)"
        bounds = forward_bounds([at_rest.train, moving.train], space, source)
        return Scene(self.name, "forward", at_rest, moving, bounds, "white", space)

    def filmed(self) -> Shape:
        """The toy and its stage."""
        return self.model()

    def model(self) -> Shape:
        """The toy and its stage themselves, for exact answers at any point and time."""
        return Surrounded(Plush(float(self.speed)), Backdrop(weave=self.texture == "fine"))
