"""Embedded scenes filmed into videos, as a phone would, and the true cameras."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from devrf.apps.settings import CaptureSettings
from devrf.geometry.cameras import Cameras
from devrf.pictures.video_file import write_pictures
from devrf.scenes.procedural.filming import Filming
from devrf.scenes.procedural.recipe import ProceduralForwardScene, ProceduralScene
from devrf.scenes.procedural.surroundings import REACH
from devrf.scenes.scene import Scene

RATE = 10
# Frames that each fixed camera has filmed of the rest state before the motion begins.
EARLY = (3, 1, 0, 2)
# The robot's videos: their pixels, field of view in radians, and distance from the robot.
SIZE = (240, 180)
FIELD = 1.05
DISTANCE = 3.4


@dataclass(frozen=True)
class Filmed:
    """Videos, and the truth about them.

    Attributes:
        settings: the videos, as ``stage=capture`` takes them.
        moving: the true cameras of the moving camera's video.
        fixed: those of the fixed views, the held-out one last; None: there are none.
        every: the video has so many frames for each of ``moving``.
        distance: at which the scene is, about, world units.
    """

    settings: CaptureSettings
    moving: Cameras
    fixed: Cameras | None
    every: int
    distance: float

    def true_poses(self, frames: list[dict[str, Any]]) -> Tensor:
        """(N, 3, 4) float64: the true camera of each frame of a transforms file."""
        poses = []
        for frame in frames:
            _, label, file = str(frame["file_path"]).split("/")
            if label == "static":
                poses.append(self.moving.camera_to_world[int(Path(file).stem) // self.every])
            else:
                assert self.fixed is not None
                poses.append(self.fixed.camera_to_world[int(label.removeprefix("view")) - 1])
        return torch.stack(poses).double()


def forward(folder: Path) -> Filmed:
    """The finely painted toy before its wall, 240×136; one of each three static frames is sharp."""
    cache = folder / "scene.pt"
    if cache.is_file():
        scene: Scene = torch.load(cache, weights_only=False)
    else:
        scene = ProceduralForwardScene(
            width=240, height=136, static_views=21, train_views=3, frames=10, texture="fine"
        )()
        torch.save(scene, cache)
    sets = (scene.static.train, scene.static.test)
    still = torch.cat([views.pixels for views in sets]).numpy()
    train = scene.dynamic.train
    test = scene.dynamic.test
    count = int(train.view.max()) + 1
    moving = [*(train.pixels[train.view == v].numpy() for v in range(count)), test.pixels.numpy()]
    assert scene.static.train.depth is not None
    return Filmed(
        _settings(folder, _shaken(still), moving, frames=24),
        joined(*(views.cameras for views in sets)),
        joined(train.cameras[list(range(count))], test.cameras[[0]]),
        3,
        # The median distance of what the cameras see.
        float(scene.static.train.depth.median()),
    )


def inward(folder: Path) -> Filmed:
    """The robot in its room: once around it at rest, then four fixed views of its motion."""
    turn = torch.arange(48) / 48
    walk = _around(2 * math.pi * turn, _up(22, 12, turn))
    stand = _around(torch.tensor([0.2, 0.8, -0.4, 0.5]), torch.tensor([0.35, 0.5, 0.5, 0.42]))
    still = _kept(folder / "static.pt", walk, [0.0] * len(walk))
    times = (torch.arange(10) / 9).tolist()
    moving = [
        _kept(folder / f"view{v + 1}.pt", stand[[v] * len(times)], times) for v in range(len(stand))
    ]
    settings = _settings(folder, iter(still), moving)
    return Filmed(settings, walk, stand, 1, DISTANCE)


def monocular(folder: Path) -> Filmed:
    """The robot in its room, filmed by a camera that goes a quarter round while it moves."""
    turn = torch.arange(40) / 40
    walk = _around(1.8 * turn - 0.6, _up(25, 8, turn))
    frames = _kept(folder / "moving.pt", walk, torch.linspace(0, 1, len(walk)).tolist())
    write_pictures(folder / "moving.mp4", iter(frames), RATE)
    settings = CaptureSettings(views=(str(folder / "moving.mp4"),))
    return Filmed(settings, walk, None, 1, DISTANCE)


SCENES: dict[str, Callable[[Path], Filmed]] = {
    "forward": forward,
    "inward": inward,
    "monocular": monocular,
}


def joined(*cameras: Cameras) -> Cameras:
    """Cameras of one size, one after the other."""
    first = cameras[0]
    return Cameras(
        torch.cat([part.camera_to_world for part in cameras]),
        torch.cat([part.focal for part in cameras]),
        torch.cat([part.center for part in cameras]),
        first.width,
        first.height,
    )


def _settings(
    folder: Path, still: Iterator[np.ndarray], moving: list[np.ndarray], frames: int = 60
) -> CaptureSettings:
    """Write the videos; each fixed one begins a little earlier or later."""
    write_pictures(folder / "static.mp4", still, RATE)
    paths = [folder / f"view{number}.mp4" for number in range(1, len(moving) + 1)]
    for path, early, pixels in zip(paths, EARLY, moving, strict=True):
        write_pictures(path, iter([pixels[0]] * early + [*pixels, pixels[-1]]), RATE)
    views = tuple(map(str, paths))
    return CaptureSettings(static=str(folder / "static.mp4"), views=views, frames=frames)


def _shaken(pictures: np.ndarray) -> Iterator[np.ndarray]:
    """Each picture between two that are blurred, as a hand-held camera would give."""
    for picture in pictures:
        yield from (cv2.blur(picture, (5, 5)), picture, cv2.blur(picture, (4, 4)))


def _around(azimuth: Tensor, elevation: Tensor) -> Cameras:
    """Float32 cameras that look at the robot from directions (N,), (N,) in radians."""
    level = elevation.cos()
    places = torch.stack([level * azimuth.cos(), level * azimuth.sin(), elevation.sin()], dim=-1)
    width, height = SIZE
    focal = width / 2 / math.tan(FIELD / 2)
    middle = torch.zeros_like(places)
    return Cameras.looking_at(DISTANCE * places, middle, focal=focal, width=width, height=height)


def _up(middle: float, swing: float, turn: Tensor) -> Tensor:
    """Elevations in radians that go up and down twice, from degrees."""
    return math.radians(middle) + math.radians(swing) * (4 * math.pi * turn).sin()


def _kept(file: Path, cameras: Cameras, times: list[float]) -> np.ndarray:
    """(N, H, W, 3) uint8: what cameras see of the robot in its room, each at its time."""
    if not file.is_file():
        room = ProceduralScene(surroundings="room", texture="fine")
        film = Filming(room.visible_shape(), REACH, opaque=True)
        shown = [film.pictures(cameras[[k]], time)[0] for k, time in enumerate(times)]
        torch.save(torch.cat(shown), file)
    pixels: Tensor = torch.load(file, weights_only=True)
    return pixels.numpy()
