"""Worlds far from the origin: an offset that is kept apart, so that float32 tells cameras apart.

UTM or ECEF coordinates are of millions of metres, where a float32 goes in steps of half a metre.
Readers have positions in double precision. If cameras are much farther from the origin than from
one another, a scene lives in the capture's world − offset:

- The offset is found once, from the first camera file that is read, and holds for all files of a
  scene (:class:`devrf.scenes.transforms.TransformsFiles`). It is subtracted there, before poses are
  compared with one another or become float32.
- It is subtracted from a box that options or files state in the capture's world
  (:meth:`devrf.scenes.reader.InwardReader.placed`). Distances need nothing.
- The scene and checkpoints keep it, beside the cameras.
- It is added to all positions that leave the program, and subtracted from those that come in:
  written scenes, exported geometry, camera paths, links to a page.

There is none near the origin. Readers that give the world an origin of their own, as COLMAP's and
LLFF's, do so in double precision, and have none either.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

# x, y, z in the capture's unit.
Offset = tuple[float, float, float]
NO_OFFSET: Offset = (0.0, 0.0, 0.0)

# The share of the cameras' spread that float32 may lose of a position.
LOST = 1e-5
# Cameras count as no nearer to one another than this: a fixed one is not far away.
LEAST_SPREAD = 0.1
# A float32 is wrong by up to this share of itself.
ROUNDING = 2.0**-24


def offset_of(poses: Tensor) -> Offset:
    """The offset of a world with cameras at ``poses`` (N, 3, 4); :data:`NO_OFFSET` if it is near.

    It is the middle of their positions, rounded to a power of ten that is as large as their spread.
    """
    low, high = poses[:, :, 3].double().aminmax(dim=0)
    spread = max(float((high - low).norm()) / 2, LEAST_SPREAD)
    farthest = float(torch.maximum(low.abs(), high.abs()).max())
    if farthest * ROUNDING <= LOST * spread:
        return NO_OFFSET
    step = 10.0 ** math.ceil(math.log10(spread))
    # Without negative zeros.
    x, y, z = (((low + high) / 2 / step).round() * step + 0.0).tolist()
    return x, y, z


def added(poses: Tensor, offset: Offset) -> Tensor:
    """Poses (..., 3, 4) of a scene in the capture's world, float64."""
    moved = poses.double().clone()
    moved[..., 3] += moved.new_tensor(offset)
    return moved


def subtracted(poses: Tensor, offset: Offset) -> Tensor:
    """Poses (..., 3, 4) of the capture's world in the scene's, float64."""
    x, y, z = offset
    return added(poses, (-x, -y, -z))
