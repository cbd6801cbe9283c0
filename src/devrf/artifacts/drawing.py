"""Lines in space, seen from far away and drawn on a picture."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from PIL import Image, ImageDraw
from torch import Tensor

Color = tuple[int, int, int]

# Lines are drawn this much larger and then made smaller, so that their edges are smooth.
SMOOTHING = 3
# How much of its colour the farthest line keeps: what is behind looks paler.
FARTHEST = 0.4


@dataclass(frozen=True)
class Lines:
    """Segments in space that look alike.

    Attributes:
        ends: (N, 2, 3) both ends of each segment, world units.
        color: RGB, 0 to 255.
        width: in pixels.
    """

    ends: Tensor
    color: Color
    width: float = 1.0


@dataclass(frozen=True)
class Projection:
    """A parallel projection of space onto a picture.

    Attributes:
        axes: (3, 3) rows: the directions in world space that point right, up and to the eye.
        origin: (3,) the point that falls on the middle of the picture, world units.
        scale: pixels per world unit.
        width: of the picture in pixels.
        height: of the picture in pixels.
    """

    axes: Tensor
    origin: Tensor
    scale: float
    width: int
    height: int

    def pixels(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Where points (..., 3) fall: pixels (..., 2) as x, y, and how near they are (...,)."""
        right, up, nearness = ((points - self.origin) @ self.axes.T).unbind(-1)
        x = self.width / 2 + self.scale * right
        y = self.height / 2 - self.scale * up
        return torch.stack([x, y], dim=-1), nearness

    @staticmethod
    def onto(
        points: Tensor, toward: Tensor, up: Tensor, width: int, height: int, margin: float
    ) -> Projection:
        """The projection that fits ``points`` (N, 3) into a picture.

        Args:
            points: what must be seen whole.
            toward: (3,) unit direction from the scene to the eye.
            up: (3,) direction that is up in the picture; not parallel to ``toward``.
            width: of the picture in pixels.
            height: of the picture in pixels.
            margin: pixels kept free at each edge.
        """
        right = torch.nn.functional.normalize(torch.linalg.cross(up, toward), dim=0)
        axes = torch.stack([right, torch.linalg.cross(toward, right), toward])
        flat = points @ axes.T
        low, high = flat.amin(dim=0), flat.amax(dim=0)
        reach = (high - low).clamp(min=1e-6).tolist()
        scale = min((width - 2 * margin) / reach[0], (height - 2 * margin) / reach[1])
        return Projection(axes, (low + high) / 2 @ axes, scale, width, height)


def direction(east: Tensor, north: Tensor, up: Tensor, azimuth: float, elevation: float) -> Tensor:
    """The unit direction (3,) at ``azimuth`` from east to north and ``elevation``, in degrees."""
    a, e = math.radians(azimuth), math.radians(elevation)
    return math.cos(e) * (math.cos(a) * east + math.sin(a) * north) + math.sin(e) * up


def draw(groups: Sequence[Lines], projection: Projection, paper: Color) -> Image.Image:
    """Draw lines on paper, far ones first and paler.

    Args:
        groups: what to draw; of two lines equally near, the later group's is on top.
        projection: gives the picture its size.
        paper: RGB of the background.
    """
    size = (projection.width * SMOOTHING, projection.height * SMOOTHING)
    image = Image.new("RGB", size, paper)
    pen = ImageDraw.Draw(image)
    strokes = []
    for group in groups:
        pixels, nearness = projection.pixels(group.ends)
        for ends, near in zip(pixels.tolist(), nearness.mean(dim=-1).tolist(), strict=True):
            strokes.append((near, ends, group))
    strokes.sort(key=lambda stroke: stroke[0])
    far, near = (strokes[0][0], strokes[-1][0]) if strokes else (0.0, 1.0)
    for nearness_of, ends, group in strokes:
        share = FARTHEST + (1 - FARTHEST) * (nearness_of - far) / max(near - far, 1e-6)
        color = tuple(round(p + share * (c - p)) for c, p in zip(group.color, paper, strict=True))
        path = [(x * SMOOTHING, y * SMOOTHING) for x, y in ends]
        pen.line(path, fill=color, width=max(1, round(group.width * SMOOTHING)))
    return image.resize((projection.width, projection.height), Image.Resampling.LANCZOS)
