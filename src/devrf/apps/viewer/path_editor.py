"""The keyframes that are being collected on the page."""

from __future__ import annotations

import threading
from dataclasses import replace

from torch import Tensor

from devrf.apps.keyframes import CameraPath, Keyframe
from devrf.errors import DevrfError


class PathEditor:
    """A list of keyframes, changed by several threads."""

    def __init__(self) -> None:
        self._keyframes: tuple[Keyframe, ...] = ()
        self._lock = threading.Lock()

    @property
    def keyframes(self) -> tuple[Keyframe, ...]:
        """All of them, in their order."""
        return self._keyframes

    def add(self, camera_to_world: Tensor, fov: float, time: float, gap: float) -> None:
        """Add a keyframe after the others, ``gap`` seconds later.

        Args:
            camera_to_world: (3, 4), OpenGL axes, world units.
            fov: the vertical angle of view in degrees.
            time: the scene's, in [0, 1].
            gap: seconds, more than 0.
        """
        with self._lock:
            last = self._keyframes[-1:]
            seconds = last[0].seconds + gap if last else 0.0
            one = Keyframe(camera_to_world, fov, time, seconds)
            self._keyframes = (*self._keyframes, one)

    def remove_last(self) -> None:
        """Remove the newest keyframe, if there is one."""
        with self._lock:
            self._keyframes = self._keyframes[:-1]

    def replace(self, keyframes: tuple[Keyframe, ...]) -> None:
        """Take other keyframes, the first at second 0."""
        with self._lock:
            self._keyframes = tuple(
                replace(one, seconds=one.seconds - keyframes[0].seconds) for one in keyframes
            )

    def path(self, aspect: float, fps: float) -> CameraPath:
        """The path through the keyframes.

        Raises:
            DevrfError: there are fewer than two.
        """
        if len(self._keyframes) < 2:
            raise DevrfError("a path needs two keyframes; add the camera at two places or times")
        return CameraPath(self._keyframes, aspect, fps)
