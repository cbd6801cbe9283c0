"""Camera rigs around the origin: many for the scene at rest, a few that watch it move."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from devrf.geometry.cameras import Cameras

DISTANCE = 4.0  # from the origin, as in NeRF's synthetic scenes
FIELD_OF_VIEW = 0.69  # radians across the image's shorter side
# Sines of the lowest and highest elevation of a static view.
_LOWEST, _HIGHEST = -0.3, 0.95
_FIRST_AZIMUTH = math.radians(-60)
_ELEVATIONS = (math.radians(22), math.radians(34))
_TEST_ELEVATION = math.radians(28)


def static_rig(
    train: int, test: int, *, width: int, height: int, reach: float
) -> tuple[Cameras, Cameras]:
    """Training and held-out cameras, spread evenly from a little below the horizon upwards.

    All are points of one Fibonacci lattice; the held-out ones lie evenly between the others.

    Args:
        train: number of training cameras.
        test: number of held-out cameras.
        width: image width in pixels.
        height: image height in pixels.
        reach: radius of the ball about the origin that every image must hold.
    """
    count = train + test
    index = torch.arange(count, dtype=torch.float64)
    sine = _LOWEST + (_HIGHEST - _LOWEST) * (index + 0.5) / count
    golden = math.pi * (3 - math.sqrt(5))
    cameras = _around(golden * index, sine.asin(), width, height, reach)
    held_out = ((torch.arange(test) + 0.5) * count / test).long()
    mask = torch.zeros(count, dtype=torch.bool)
    mask[held_out] = True
    return cameras[~mask], cameras[mask]


def dynamic_rig(train: int, *, width: int, height: int, reach: float) -> tuple[Cameras, Cameras]:
    """``train`` fixed cameras all around, and one held out between the first two of them."""
    step = 2 * math.pi / train
    index = torch.arange(train, dtype=torch.float64)
    low, high = _ELEVATIONS
    elevation = torch.where(index % 2 == 0, low, high).double()
    cameras = _around(_FIRST_AZIMUTH + step * index, elevation, width, height, reach)
    # A lone camera sees one side only: then the held-out one stays on that side.
    azimuth = torch.tensor([_FIRST_AZIMUTH + min(step / 2, math.pi / 4)], dtype=torch.float64)
    elevation = torch.full_like(azimuth, _TEST_ELEVATION)
    return cameras, _around(azimuth, elevation, width, height, reach)


def _around(azimuth: Tensor, elevation: Tensor, width: int, height: int, reach: float) -> Cameras:
    """Float32 cameras that look at the origin from directions (N,), (N,) in radians."""
    directions = torch.stack(
        [elevation.cos() * azimuth.cos(), elevation.cos() * azimuth.sin(), elevation.sin()], dim=-1
    )
    positions = (DISTANCE * directions).float()
    field = max(FIELD_OF_VIEW, 2 * math.asin(min(reach / DISTANCE, 0.95)))
    focal = min(width, height) / 2 / math.tan(field / 2)
    return Cameras.looking_at(
        positions, torch.zeros_like(positions), focal=focal, width=width, height=height
    )
