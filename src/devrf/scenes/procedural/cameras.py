"""Camera rigs around the origin: many for the scene at rest, a few that watch it move."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from devrf.geometry.cameras import Cameras


@dataclass(frozen=True)
class Rig:
    """How cameras stand around the origin.

    Attributes:
        distance: from the origin, world units.
        field_of_view: radians across the image's shorter side, at least.
        lowest: sine of the lowest elevation of a static view.
        highest: sine of the highest.
    """

    distance: float
    field_of_view: float
    lowest: float
    highest: float


# As in NeRF's synthetic scenes.
STUDIO = Rig(distance=4.0, field_of_view=0.69, lowest=-0.3, highest=0.95)
# A telephone in the hand of someone who walks around: above the floor, and a wider lens.
HAND_HELD = Rig(distance=3.4, field_of_view=0.96, lowest=0.05, highest=0.75)
_FIRST_AZIMUTH = math.radians(-60)
_ELEVATIONS = (math.radians(22), math.radians(34))
_TEST_ELEVATION = math.radians(28)


def static_rig(
    train: int, test: int, *, width: int, height: int, reach: float, rig: Rig = STUDIO
) -> tuple[Cameras, Cameras]:
    """Training and held-out cameras, spread evenly from the rig's lowest elevation upwards.

    All are points of one Fibonacci lattice; the held-out ones lie evenly between the others.

    Args:
        train: number of training cameras.
        test: number of held-out cameras.
        width: image width in pixels.
        height: image height in pixels.
        reach: radius of the ball about the origin that every image must hold.
        rig: how the cameras stand.
    """
    count = train + test
    index = torch.arange(count, dtype=torch.float64)
    sine = rig.lowest + (rig.highest - rig.lowest) * (index + 0.5) / count
    golden = math.pi * (3 - math.sqrt(5))
    cameras = _around(golden * index, sine.asin(), width, height, reach, rig)
    held_out = ((torch.arange(test) + 0.5) * count / test).long()
    mask = torch.zeros(count, dtype=torch.bool)
    mask[held_out] = True
    return cameras[~mask], cameras[mask]


def dynamic_rig(
    train: int, *, width: int, height: int, reach: float, rig: Rig = STUDIO
) -> tuple[Cameras, Cameras]:
    """``train`` fixed cameras all around, and one held out between the first two of them."""
    step = 2 * math.pi / train
    index = torch.arange(train, dtype=torch.float64)
    low, high = _ELEVATIONS
    elevation = torch.where(index % 2 == 0, low, high).double()
    cameras = _around(_FIRST_AZIMUTH + step * index, elevation, width, height, reach, rig)
    # A lone camera sees one side only: then the held-out one stays on that side.
    azimuth = torch.tensor([_FIRST_AZIMUTH + min(step / 2, math.pi / 4)], dtype=torch.float64)
    elevation = torch.full_like(azimuth, _TEST_ELEVATION)
    return cameras, _around(azimuth, elevation, width, height, reach, rig)


def _around(
    azimuth: Tensor, elevation: Tensor, width: int, height: int, reach: float, rig: Rig
) -> Cameras:
    """Float32 cameras that look at the origin from directions (N,), (N,) in radians."""
    directions = torch.stack(
        [elevation.cos() * azimuth.cos(), elevation.cos() * azimuth.sin(), elevation.sin()], dim=-1
    )
    positions = (rig.distance * directions).float()
    field = max(rig.field_of_view, 2 * math.asin(min(reach / rig.distance, 0.95)))
    focal = min(width, height) / 2 / math.tan(field / 2)
    return Cameras.looking_at(
        positions, torch.zeros_like(positions), focal=focal, width=width, height=height
    )
