"""Videos of a learned scene: the held-out view over time, and an orbit while time runs."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import imageio
import numpy as np
import torch
from torch import Tensor

from devrf.artifacts.colors import depth_colors, to_bytes
from devrf.artifacts.files import whole_file
from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras
from devrf.rendering.model import SceneModel

# Small pictures are shown enlarged: a video of 100 pixels is too small to watch.
WATCHABLE = 240


@dataclass(frozen=True)
class FilmSettings:
    """What is filmed.

    Attributes:
        frames: pictures of each video, evenly spread over [0, 1]: times between the captured
            frames are rendered like any other.
        fps: pictures a second.
        orbit_turns: how often the orbit goes round while time runs once.
        orbit_elevation: degrees above the horizon.
    """

    frames: int = 60
    fps: int = 20
    orbit_turns: float = 1.0
    orbit_elevation: float = 25.0


def orbit(cameras: Cameras, box: Box, settings: FilmSettings) -> Cameras:
    """Cameras on a circle around a box, looking at its middle.

    Args:
        cameras: the captured cameras: the orbit has their mean distance, their lens, and the
            direction that is up for them.
        box: what to look at.
        settings: how many, how high, how often round.
    """
    middle = torch.tensor([(a + b) / 2 for a, b in zip(box.low, box.high, strict=True)])
    radius = float((cameras.positions - middle).norm(dim=1).mean())
    up = torch.nn.functional.normalize(cameras.camera_to_world[:, :, 1].mean(dim=0), dim=0)
    away = torch.eye(3)[int(up.abs().argmin())]
    east = torch.nn.functional.normalize(torch.linalg.cross(away, up), dim=0)
    north = torch.linalg.cross(up, east)
    angle = torch.arange(settings.frames) * (2 * math.pi * settings.orbit_turns / settings.frames)
    height = math.radians(settings.orbit_elevation)
    ring = angle.cos()[:, None] * east + angle.sin()[:, None] * north
    positions = middle + radius * (math.cos(height) * ring + math.sin(height) * up)
    return Cameras.looking_at(
        positions,
        middle.expand_as(positions),
        focal=float(cameras.focal.mean()),
        width=cameras.width,
        height=cameras.height,
        up=up,
    )


def pictures(
    model: SceneModel, cameras: Cameras, background: float, device: torch.device
) -> Iterator[Tensor]:
    """Colour beside depth (H, 2W, 3) from each of N cameras, while time runs from 0 to 1."""
    box = model.canonical.box
    half_diagonal = math.dist(box.low, box.high) / 2
    middle = torch.tensor([(a + b) / 2 for a, b in zip(box.low, box.high, strict=True)])
    behind = torch.full((3,), background, device=device)
    for k in range(len(cameras)):
        time = k / max(len(cameras) - 1, 1)
        picture = model.picture(cameras.image_rays(k).to(device), time, behind)
        distance = float((cameras.positions[k] - middle).norm())
        shape = (cameras.height, cameras.width)
        depth = depth_colors(
            picture.depth.view(shape).cpu(),
            picture.opacity.view(shape).cpu(),
            near=max(distance - half_diagonal / 1.5, 0.0),
            far=distance + half_diagonal / 1.5,
        )
        yield torch.cat([picture.color.view(*shape, 3).cpu(), depth], dim=1)


def write_video(path: Path, images: Iterator[Tensor], fps: int) -> None:
    """Write images (H, W, 3) in [0, 1] of one size as an mp4 (H.264)."""
    with whole_file(path) as partial:
        writer = imageio.get_writer(
            partial, format="FFMPEG", fps=fps, codec="libx264", quality=8, macro_block_size=2
        )
        # As a context manager of its own it would leave ffmpeg running, and writing, on an error.
        with closing(writer):
            for image in images:
                writer.append_data(_watchable(to_bytes(image).numpy()))  # type: ignore[attr-defined]


def _watchable(image: np.ndarray) -> np.ndarray:
    """Enlarged by whole pixels to a watchable height, with even sides as H.264 needs."""
    factor = max(1, math.ceil(WATCHABLE / image.shape[0]))
    image = image.repeat(factor, axis=0).repeat(factor, axis=1)
    return np.pad(image, [(0, image.shape[0] % 2), (0, image.shape[1] % 2), (0, 0)], mode="edge")
