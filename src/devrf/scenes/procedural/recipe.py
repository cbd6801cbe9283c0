"""The procedural scenes: their numbers and their rendering."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import KW_ONLY
from typing import Annotated, ClassVar, Literal

from pydantic import Field, model_validator
from pydantic.dataclasses import dataclass

from devrf.scenes.bounds import forward_bounds, reference_space
from devrf.scenes.procedural.cushion import MIDDLE as CUSHION_MIDDLE
from devrf.scenes.procedural.cushion import REACH as CUSHION_REACH
from devrf.scenes.procedural.cushion import Cushion
from devrf.scenes.procedural.filming import Filming, extent
from devrf.scenes.procedural.flower import Flower
from devrf.scenes.procedural.plush import BASE as PLUSH_BASE
from devrf.scenes.procedural.plush import REACH as PLUSH_REACH
from devrf.scenes.procedural.plush import Plush
from devrf.scenes.procedural.random_bodies import placed, random_body
from devrf.scenes.procedural.rigs import (
    HAND_HELD,
    STUDIO,
    dynamic_rig,
    facing_dynamic_rig,
    facing_static_rig,
    hand_held_rig,
    static_rig,
)
from devrf.scenes.procedural.robot import Robot
from devrf.scenes.procedural.solids import Body, Shape
from devrf.scenes.procedural.surroundings import REACH, Backdrop, Room, Surrounded
from devrf.scenes.scene import Bounds, Capture, GivenBounds, Scene
from devrf.scenes.space import inward_space
from devrf.scenes.splits import every_nth
from devrf.scenes.validation import MIN_SIDE, scene_error
from devrf.system.options import Options, Several, Share, Whole
from devrf.system.threads import one_thread

Side = Annotated[int, Field(strict=True, ge=MIN_SIDE, le=4096)]
Count = Annotated[int, Field(strict=True, ge=1, le=10_000)]
Frames = Annotated[int, Field(strict=True, ge=2, le=10_000)]
# Above speed 2 the flower folds into itself, the robot goes through its own body and the toy is
# squashed to pieces.
Speed = Annotated[float, Field(strict=True, ge=0, le=2)]


@dataclass(frozen=True, kw_only=True)
class Recipe(Options, ABC):
    """Calling a recipe renders its scene. The same recipe always gives the same scene.

    Attributes:
        width: image width in pixels.
        height: image height in pixels.
        static_views: training views of the static scene.
        train_views: fixed cameras of the moving scene (V); one more is held out.
        frames: number of frames T, at times k / (T − 1).
        speed: scales all displacements; 0 is no motion.
        supersample: n × n rays a pixel.
        light: share of the lamp in the lighting, 0 … 1: with more, motion changes colours more.
        scene_seed: of the body of ``shape`` ``random``.
        texture: the paint of room, wall and floor: ``soft``, or ``fine`` for images of about 240
            pixels or more, in which no place looks like another.
        sliding: whether its round parts spin, so that texture slides over a fixed silhouette.
        novel_times_every: n: only the held-out camera has every n-th frame, except the last one;
            None: all frames are training frames.

    Raises:
        DevrfError: a number is out of range; the message names it.
    """

    key: ClassVar[str] = "data"
    width: Side = 96
    height: Side = 96
    static_views: Count = 36
    train_views: Count = 4
    frames: Frames = 14
    speed: Speed = 1.0
    supersample: Annotated[int, Field(strict=True, ge=1, le=16)] = 2
    light: Share = 0.2
    scene_seed: Whole = 0
    texture: Literal["soft", "fine"] = "soft"
    sliding: bool = False
    novel_times_every: Several | None = None

    @model_validator(mode="after")
    def _some_frames_are_learned_from(self) -> Recipe:
        if self.novel_times_every is not None and self.novel_times_every >= self.frames:
            raise scene_error(
                "data.novel_times_every",
                f"expected below data.frames={self.frames}, not {self.novel_times_every}",
            )
        return self

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the images."""
        return self.width, self.height

    @property
    def unseen_frames(self) -> list[int]:
        """The frames that are not training frames."""
        if self.novel_times_every is None:
            return []
        _, held_out = every_nth(self.frames, self.novel_times_every)
        return [frame for frame in held_out if frame < self.frames - 1]

    @abstractmethod
    def __call__(self) -> Scene:
        """Render everything."""

    @abstractmethod
    def visible_shape(self) -> Shape:
        """All that the cameras see, exact at any point and time."""


@dataclass(frozen=True)
class ProceduralScene(Recipe):
    """An object with cameras all around it, in world units about the origin.

    Attributes:
        shape: ``robot`` (rigid parts, large fast motion), ``flower`` (non-rigid), or ``random``.
        static_test_views: held-out views of the static scene.
        surroundings: ``none``: the images have alpha masks; ``room``: the object stands in a
            furnished room, filmed from inside it, and the images have none.
    """

    shape: Literal["robot", "flower", "random"] = "robot"
    _: KW_ONLY
    static_test_views: Count = 8
    surroundings: Literal["none", "room"] = "none"

    @one_thread()
    def __call__(self) -> Scene:
        """Render everything."""
        where = extent(self.model())
        inside = self.surroundings == "room"
        rig = HAND_HELD if inside else STUDIO
        surface = self.visible_shape()
        learned, tested = static_rig(
            self.static_views, self.static_test_views, self.size, reach=where.reach, rig=rig
        )
        watching, unseen = dynamic_rig(self.train_views, self.size, reach=where.reach, rig=rig)
        filming = Filming(surface, where.reach, self.supersample, self.light)
        if inside:
            filming = Filming(surface, REACH, self.supersample, self.light, opaque=True)
        static = filming.static(learned, tested)
        dynamic = filming.dynamic(watching, unseen, self.frames, self.unseen_frames)
        if inside:
            everyone = [static.train, static.test, dynamic.train, dynamic.test]
            space, bounds = inward_space(
                "auto", static.train, dynamic.train, everyone, GivenBounds()
            )
            return Scene(f"{self.shape}_room", "inward", static, dynamic, bounds, "white", space)
        bounds = Bounds(
            box=where.canonical,
            near=rig.distance - where.reach,
            far=rig.distance + where.reach,
            motion=where.motion,
            scale=1.0,
            source="known exactly (procedural scene)",
        )
        return Scene(self.shape, "inward", static, dynamic, bounds, "white")

    def visible_shape(self) -> Shape:
        """The moving shape, in its room if there is one."""
        shape = self.model()
        if self.surroundings == "none":
            return shape
        where = extent(shape)
        room = Room(floor=where.motion.low[2], weave=self.texture == "fine")
        return Surrounded(shape, room, where.reach)

    def model(self) -> Body:
        """The moving shape itself."""
        if self.shape == "random":
            return random_body(self.scene_seed, self.speed, self.sliding)
        return Robot(self.speed) if self.shape == "robot" else Flower(self.speed)


# Radius of a ball about the origin that holds all that the cameras see of wall and floor.
_REACH = 9.0
# One static view in so many is held out, the first one included, as readers of LLFF do.
HOLDOUT = 8
NEAR = 1.0
# The position of a random body, and the radius of a ball that it does not leave, so that it touches
# neither wall nor floor.
_HANGS = (0.0, 0.0, -2.6)
_STAYS_WITHIN = 1.1
# The contrast of the wall behind the cushion: most features are on the cushion.
_PALE = 0.3


@dataclass(frozen=True)
class ProceduralForwardScene(Recipe):
    """A soft toy on a pedestal, or a random body, before a painted wall, seen from one side.

    The world is the one that :class:`devrf.scenes.formats.llff.LlffReader` makes: the static
    cameras' average pose is the identity, and nothing is nearer to a camera than 1/0.75. Besides
    ``static_views`` to learn from there are held-out ones, one in eight of all.

    Attributes:
        shape: ``plush`` (the toy), ``cushion`` (a large, finely painted body that fills a third of
            the picture), or ``random``.
        camera: ``fixed``: a static set, and fixed cameras; ``handheld``: one camera that moves
            while the scene does, and at each time another view, held out; then there is no static
            set, and ``static_views`` and ``train_views`` are not used.
    """

    shape: Literal["plush", "cushion", "random"] = "plush"
    _: KW_ONLY
    camera: Literal["fixed", "handheld"] = "fixed"
    height: Side = 72
    static_views: Count = 20
    frames: Frames = 12

    @one_thread()
    def __call__(self) -> Scene:
        """Render everything."""
        shape = self.visible_shape()
        filming = Filming(shape, _REACH, self.supersample, self.light, opaque=True)
        name = {"random": "random_forward"}.get(self.shape, self.shape)
        if self.camera == "handheld":
            camera, others = hand_held_rig(self.frames, self.size)
            video = filming.handheld(camera, others)
            return self._scene(f"{name}_by_hand", video, video)
        # Seven of each eight views are training views.
        held_out = -(-self.static_views // (HOLDOUT - 1))
        count = self.static_views + held_out
        cameras = facing_static_rig(count, self.size)
        learned, tested = (cameras[part] for part in every_nth(count, HOLDOUT, start=0))
        watching, unseen = facing_dynamic_rig(self.train_views, self.size)
        static = filming.static(learned, tested)
        dynamic = filming.dynamic(watching, unseen, self.frames, self.unseen_frames)
        return self._scene(name, static, dynamic)

    def _scene(self, name: str, static: Capture, dynamic: Capture) -> Scene:
        space = reference_space(static.train.cameras, NEAR)
        source = "all that the cameras see (procedural scene)"
        bounds = forward_bounds([static.train, dynamic.train], space, source)
        return Scene(name, "forward", static, dynamic, bounds, "white", space)

    def visible_shape(self) -> Shape:
        """The moving shape and its stage."""
        weave = self.texture == "fine"
        if self.shape == "plush":
            return Surrounded(Plush(self.speed), Backdrop(weave), PLUSH_REACH, PLUSH_BASE)
        if self.shape == "cushion":
            pale = Backdrop(weave, contrast=_PALE)
            return Surrounded(Cushion(self.speed), pale, CUSHION_REACH, CUSHION_MIDDLE)
        body = random_body(self.scene_seed, self.speed, self.sliding)
        hung = placed(body, _HANGS, _STAYS_WITHIN)
        return Surrounded(hung, Backdrop(weave, pedestal=False), _STAYS_WITHIN, _HANGS)
