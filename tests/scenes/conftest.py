"""Small scenes on disk, written on the fly in the published layouts."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
import torch

from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras
from devrf.scenes.scene import Views

# Not square, so that a swap of the axes cannot hide: 32 columns, 24 rows.
WIDTH, HEIGHT, ANGLE = 32, 24, 0.8


def ring(count: int, *, width: int, height: int, angle: float, turn: float = 0.0) -> Cameras:
    """``count`` cameras at distance 4 around the origin, 1.2 above it, looking at it."""
    theta = torch.arange(count) * (2 * math.pi / count) + turn
    level = math.sqrt(16 - 1.2**2)
    where = torch.stack(
        [level * theta.cos(), level * theta.sin(), torch.full_like(theta, 1.2)], dim=-1
    )
    focal = width / 2 / math.tan(angle / 2)
    return Cameras.looking_at(
        where, torch.zeros_like(where), focal=focal, width=width, height=height
    )


def frames_json(cameras: Cameras, times: list[float] | None, folder: str) -> list[dict[str, Any]]:
    """The ``frames`` of a transforms file for images ``folder/r_000`` and so on."""
    bottom = torch.tensor([[0.0, 0.0, 0.0, 1.0]])
    frames: list[dict[str, Any]] = []
    for i, pose in enumerate(cameras.camera_to_world):
        frame: dict[str, Any] = {
            "file_path": f"./{folder}/r_{i:03d}",
            "transform_matrix": torch.cat([pose, bottom]).tolist(),
        }
        if times is not None:
            frame["time"] = times[i]
        frames.append(frame)
    return frames


def write_split(
    folder: Path,
    split: str,
    cameras: Cameras,
    times: list[float] | None,
    pixels: Callable[[int], np.ndarray],
    suffix: str = ".png",
    angle: float = ANGLE,
) -> None:
    """One transforms file and its images."""
    (folder / split).mkdir(parents=True, exist_ok=True)
    content = {"camera_angle_x": angle, "frames": frames_json(cameras, times, split)}
    (folder / f"transforms_{split}.json").write_text(json.dumps(content))
    for i in range(len(cameras)):
        iio.imwrite(folder / split / f"r_{i:03d}{suffix}", pixels(i))


def matte(number: int) -> np.ndarray:
    """An RGBA image with an opaque block in the middle, whose red tells the number."""
    image = np.zeros((HEIGHT, WIDTH, 4), dtype=np.uint8)
    image[8:16, 12:20] = (number, 100, 200, 255)
    return image


class SceneFolder:
    """A valid scene of 2 views × 3 frames that a test then breaks in one place."""

    def __init__(self, root: Path) -> None:
        """Write it under ``root``."""
        self.root = root
        self.static, self.dynamic = root / "static", root / "dynamic_2views"
        size: dict[str, Any] = {"width": WIDTH, "height": HEIGHT, "angle": ANGLE}
        pair = ring(2, turn=0.3, **size)
        moving = pair[[0, 1] * 3]
        self.times = [0.0, 0.0, 0.5, 0.5, 1.0, 1.0]
        write_split(self.static, "train", ring(6, **size), None, matte)
        write_split(self.static, "test", ring(2, turn=0.1, **size), None, matte)
        write_split(self.dynamic, "train", moving, self.times, matte)
        write_split(self.dynamic, "test", ring(1, turn=2.0, **size)[[0] * 3], [0, 0.5, 1], matte)

    def edit(self, file: Path, change: Callable[[dict[str, Any]], object]) -> None:
        """Change the content of a JSON file."""
        content = json.loads(file.read_text())
        change(content)
        file.write_text(json.dumps(content))


@pytest.fixture
def scene_folder(tmp_path: Path) -> SceneFolder:
    """A valid scene on disk."""
    return SceneFolder(tmp_path / "scene")


@pytest.fixture
def single_folder(tmp_path: Path) -> Path:
    """A scene in D-NeRF's layout: 8 training images and 3 test images of a moving camera."""
    root = tmp_path / "monocular"
    size: dict[str, Any] = {"width": WIDTH, "height": HEIGHT, "angle": ANGLE}
    times = [i / 7 for i in range(8)]
    write_split(root, "train", ring(8, **size), times, matte)
    write_split(root, "test", ring(3, turn=0.2, **size), [0.1, 0.4, 0.9], matte)
    return root


@pytest.fixture
def ball_views() -> Callable[..., Views]:
    """A function that makes mattes of a ball at given places (T, 3), seen by a ring of cameras."""

    def make(places: torch.Tensor, radius: float, count: int = 4, channels: int = 4) -> Views:
        cameras = ring(count, width=96, height=80, angle=0.9)
        images = []
        for place in places:
            for camera in range(count):
                rays = cameras.image_rays(camera)
                offset = place - rays.origins
                along = (offset * rays.directions).sum(dim=1)
                miss = (offset - along[:, None] * rays.directions).norm(dim=1)
                alpha = (miss < radius).to(torch.uint8).reshape(80, 96, 1) * 255
                images.append(alpha.expand(-1, -1, channels))
        total = len(places) * count
        return Views(
            torch.stack(images),
            cameras[list(range(count)) * len(places)],
            torch.linspace(0, 1, len(places)).repeat_interleave(count),
            torch.arange(count).repeat(len(places)),
            tuple(f"{i}" for i in range(total)),
        )

    return make


@pytest.fixture
def unit_box() -> Box:
    """The cube from −1 to 1."""
    return Box((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))


@pytest.fixture
def ring_cameras() -> Callable[..., Cameras]:
    """The function :func:`ring`."""
    return ring
