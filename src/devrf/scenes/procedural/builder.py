"""A procedural scene from a handful of numbers: images, cameras, flow and depth, all exact."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch

from devrf.geometry.cameras import Cameras
from devrf.scenes.procedural.cameras import DISTANCE, dynamic_rig, static_rig
from devrf.scenes.procedural.flower import Flower
from devrf.scenes.procedural.picture import Pictures, render
from devrf.scenes.procedural.robot import Robot
from devrf.scenes.procedural.shape import Shape
from devrf.scenes.procedural.truth import backward_flow, extent
from devrf.scenes.scene import Bounds, Capture, OpticalFlow, Scene, Views
from devrf.scenes.validation import MIN_SIDE, check_choice, number, problem

SHAPES: dict[str, Callable[[float], Shape]] = {"robot": Robot, "flower": Flower}
_LARGEST_SIDE = 4096
_MOST = 10_000
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
        with _one_thread():
            return self._rendered()

    def _rendered(self) -> Scene:
        shape = self.model()
        where = extent(shape)
        static_train, static_test = static_rig(
            self.static_views, self.static_test_views,
            width=self.width, height=self.height, reach=where.reach,
        )
        dynamic_train, dynamic_test = dynamic_rig(
            self.train_views, width=self.width, height=self.height, reach=where.reach
        )
        return Scene(
            name=self.shape,
            kind="inward",
            static=Capture(
                self._at_rest(shape, static_train, "train", where.reach),
                self._at_rest(shape, static_test, "test", where.reach),
            ),
            dynamic=Capture(
                self._moving(shape, dynamic_train, "train", where.reach),
                self._moving(shape, dynamic_test, "test", where.reach),
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

    def _render(self, shape: Shape, cameras: Cameras, time: float, reach: float) -> Pictures:
        return render(
            shape, cameras, time, reach=reach, supersample=self.supersample, light=self.light
        )

    def _at_rest(self, shape: Shape, cameras: Cameras, split: str, reach: float) -> Views:
        pictures = self._render(shape, cameras, 0.0, reach)
        return Views(
            pixels=pictures.pixels,
            cameras=cameras,
            times=torch.zeros(len(cameras)),
            view=torch.arange(len(cameras)),
            names=tuple(f"static {split} {k:03d}" for k in range(len(cameras))),
            depth=pictures.depth,
        )

    def _moving(self, shape: Shape, cameras: Cameras, split: str, reach: float) -> Views:
        """All cameras at frame 0, then all at frame 1, …, with the exact backward flow."""
        times = torch.arange(self.frames) / (self.frames - 1)
        clock: list[float] = times.tolist()
        pictures = [self._render(shape, cameras, time, reach) for time in clock]
        nowhere = torch.zeros_like(pictures[0].depth)
        flows = [OpticalFlow(torch.stack([nowhere, nowhere], dim=-1), nowhere.bool())]
        for earlier, time, picture in zip(clock, clock[1:], pictures[1:], strict=False):
            flows.append(backward_flow(shape, cameras, picture.depth, time, earlier))
        view = torch.arange(len(cameras)).repeat(self.frames)
        frame = torch.arange(self.frames).repeat_interleave(len(cameras))
        return Views(
            pixels=torch.cat([p.pixels for p in pictures]),
            cameras=cameras[view],
            times=times[frame],
            view=view,
            names=tuple(
                f"dynamic {split} frame {k:03d} view {v}"
                for k, v in zip(frame.tolist(), view.tolist(), strict=True)
            ),
            flow=OpticalFlow(
                torch.cat([f.vectors for f in flows]), torch.cat([f.valid for f in flows])
            ),
            depth=torch.cat([p.depth for p in pictures]),
        )

    def _check(self) -> None:
        # Not in __post_init__: Hydra would wrap the error in one of its own, many lines long.
        check_choice("data.shape", self.shape, SHAPES)
        for key, least, most in (
            ("width", MIN_SIDE, _LARGEST_SIDE),
            ("height", MIN_SIDE, _LARGEST_SIDE),
            ("static_views", 1, _MOST),
            ("static_test_views", 1, _MOST),
            ("train_views", 1, _MOST),
            ("frames", 2, _MOST),
            ("supersample", 1, 16),
        ):
            value = getattr(self, key)
            if isinstance(value, bool) or not isinstance(value, int):
                raise problem(f"data.{key}", f"must be a whole number, not {value!r}")
            if not least <= value <= most:
                bound = f"at least {least}" if value < least else f"at most {most}"
                raise problem(f"data.{key}", f"must be {bound}, not {value}")
        for key, highest in (("speed", _FASTEST), ("light", 1.0)):
            given = getattr(self, key)
            amount = number(given)
            if amount is None or not 0 <= amount <= highest:
                raise problem(f"data.{key}", f"must be a number in 0 … {highest:g}, not {given!r}")



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
