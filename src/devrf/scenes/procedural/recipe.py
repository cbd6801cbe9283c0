"""The numbers that every procedural scene is made from, and the checks of them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch

from devrf.scenes.holdout import every_nth
from devrf.scenes.procedural.shape import Shape
from devrf.scenes.scene import Scene
from devrf.scenes.validation import MIN_SIDE, number, scene_error

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
            amount = number(given)
            if amount is None or not 0 <= amount <= highest:
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
