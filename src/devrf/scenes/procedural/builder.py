"""A procedural scene from a handful of numbers: images, cameras, flow and depth, all exact."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from devrf.scenes.procedural.cameras import DISTANCE, dynamic_rig, static_rig
from devrf.scenes.procedural.filming import Filming, one_thread
from devrf.scenes.procedural.flower import Flower
from devrf.scenes.procedural.recipe import check_recipe
from devrf.scenes.procedural.robot import Robot
from devrf.scenes.procedural.shape import Shape
from devrf.scenes.procedural.truth import extent
from devrf.scenes.scene import Bounds, Capture, Scene
from devrf.scenes.validation import check_choice

SHAPES: dict[str, Callable[[float], Shape]] = {"robot": Robot, "flower": Flower}
# Further than this the flower folds into itself and the robot through its own body.
_FASTEST = 2.0


@dataclass(frozen=True)
class ProceduralScene:
    """A recipe; calling it renders the scene. The same recipe always gives the same scene.

    Wrong values raise :class:`~devrf.errors.DevrfError` when the recipe is called.

    Attributes:
        shape: ``robot`` (rigid parts, large fast motion) or ``flower`` (non-rigid).
        width: image width in pixels.
        height: image height in pixels.
        static_views: training views of the scene at rest.
        static_test_views: held-out views of the scene at rest.
        train_views: fixed cameras that watch the scene move (V); one more is held out.
        frames: number of frames T, at times k / (T − 1).
        speed: scales how far everything moves; 0 is still.
        supersample: n × n rays a pixel.
        light: share of the lamp in the lighting, 0 … 1: how much motion changes the colours.
    """

    shape: str = "robot"
    width: int = 96
    height: int = 96
    static_views: int = 36
    static_test_views: int = 8
    train_views: int = 4
    frames: int = 14
    speed: float = 1.0
    supersample: int = 2
    light: float = 0.2

    def __call__(self) -> Scene:
        """Render everything.

        Raises:
            DevrfError: an argument is out of range.
        """
        self._check()
        with one_thread():
            return self._rendered()

    def _rendered(self) -> Scene:
        shape = self.model()
        where = extent(shape)
        static_train, static_test = static_rig(
            self.static_views,
            self.static_test_views,
            width=self.width,
            height=self.height,
            reach=where.reach,
        )
        dynamic_train, dynamic_test = dynamic_rig(
            self.train_views, width=self.width, height=self.height, reach=where.reach
        )
        filming = Filming(shape, where.reach, self.supersample, self.light)
        return Scene(
            name=self.shape,
            kind="inward",
            static=Capture(
                filming.at_rest(static_train, "train"), filming.at_rest(static_test, "test")
            ),
            dynamic=Capture(
                filming.moving(dynamic_train, self.frames, "train"),
                filming.moving(dynamic_test, self.frames, "test"),
            ),
            bounds=Bounds(
                box=where.rest,
                near=DISTANCE - where.reach,
                far=DISTANCE + where.reach,
                motion=where.motion,
                scale=1.0,
                source="known exactly (procedural scene)",
            ),
            background="white",
        )

    def model(self) -> Shape:
        """The moving shape itself, for exact answers at any point and time."""
        check_choice("data.shape", self.shape, SHAPES)
        return SHAPES[self.shape](float(self.speed))

    def _check(self) -> None:
        # Not in __post_init__: Hydra would wrap the error in one of its own, many lines long.
        check_choice("data.shape", self.shape, SHAPES)
        check_recipe(self, fastest=_FASTEST)
