"""Camera rigs, around the origin or facing one side: many static views, a few dynamic ones."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from devrf.geometry.cameras import Cameras
from devrf.geometry.poses import average_pose, relative_to

# Width and height of images in pixels.
Size = tuple[int, int]


@dataclass(frozen=True)
class Rig:
    """A rig of cameras around the origin.

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
# A phone in the hand of a walking person: above the floor, and a wider lens.
HAND_HELD = Rig(distance=3.4, field_of_view=0.96, lowest=0.05, highest=0.75)
_FIRST_AZIMUTH = math.radians(-60)
_ELEVATIONS = (math.radians(22), math.radians(34))
_TEST_ELEVATION = math.radians(28)


def static_rig(
    train: int, test: int, size: Size, *, reach: float, rig: Rig = STUDIO
) -> tuple[Cameras, Cameras]:
    """Training and held-out cameras, spread evenly from the rig's lowest elevation upwards.

    All are points of one Fibonacci lattice; the held-out ones lie evenly between the others. Every
    image, of a ``size`` in pixels, holds the ball of radius ``reach`` about the origin.
    """
    count = train + test
    index = torch.arange(count, dtype=torch.float64)
    sine = rig.lowest + (rig.highest - rig.lowest) * (index + 0.5) / count
    golden = math.pi * (3 - math.sqrt(5))
    cameras = _around(golden * index, sine.asin(), size, reach, rig)
    held_out = ((torch.arange(test) + 0.5) * count / test).long()
    mask = torch.zeros(count, dtype=torch.bool)
    mask[held_out] = True
    return cameras[~mask], cameras[mask]


def dynamic_rig(
    train: int, size: Size, *, reach: float, rig: Rig = STUDIO
) -> tuple[Cameras, Cameras]:
    """``train`` fixed cameras all around, and one held out between the first two of them."""
    step = 2 * math.pi / train
    index = torch.arange(train, dtype=torch.float64)
    low, high = _ELEVATIONS
    elevation = torch.where(index % 2 == 0, low, high).double()
    cameras = _around(_FIRST_AZIMUTH + step * index, elevation, size, reach, rig)
    # A lone camera sees one side only: the held-out one is on that side, too.
    azimuth = torch.tensor([_FIRST_AZIMUTH + min(step / 2, math.pi / 4)], dtype=torch.float64)
    elevation = torch.full_like(azimuth, _TEST_ELEVATION)
    return cameras, _around(azimuth, elevation, size, reach, rig)


def _around(azimuth: Tensor, elevation: Tensor, size: Size, reach: float, rig: Rig) -> Cameras:
    """Float32 cameras that look at the origin from directions (N,), (N,) in radians."""
    directions = torch.stack(
        [elevation.cos() * azimuth.cos(), elevation.cos() * azimuth.sin(), elevation.sin()], dim=-1
    )
    positions = (rig.distance * directions).float()
    field = max(rig.field_of_view, 2 * math.asin(min(reach / rig.distance, 0.95)))
    focal = min(size) / 2 / math.tan(field / 2)
    middle = torch.zeros_like(positions)
    return Cameras.looking_at(positions, middle, focal=focal, width=size[0], height=size[1])


FIELD_OF_VIEW = 1.05  # radians across the image's longer side
# Half axes (x, y) of the ellipse of static cameras and of that of the fixed dynamic ones; all look
# at one point on the −z axis. World units.
_STATIC = (0.45, 0.24)
_DYNAMIC = (0.36, 0.18)
_HELD_OUT = (0.07, -0.04)
_TARGET_DEPTH = 3.4
# Static cameras deviate this much from a plane, as hand-held ones do.
_UNEVEN = 0.05


def facing_static_rig(count: int, size: Size) -> Cameras:
    """``count`` cameras evenly over an ellipse, whose average pose is the identity."""
    index = torch.arange(count, dtype=torch.float64)
    radius = ((index + 0.5) / count).sqrt()
    angle = math.pi * (3 - math.sqrt(5)) * index
    x = _STATIC[0] * radius * angle.cos()
    y = _STATIC[1] * radius * angle.sin()
    positions = torch.stack([x, y, _UNEVEN * (2.0 * index).sin()], dim=-1)
    return _facing(positions, size, centred=True)


def facing_dynamic_rig(train: int, size: Size) -> tuple[Cameras, Cameras]:
    """``train`` fixed cameras on an ellipse, and one held out near its middle."""
    angle = math.pi / 4 + 2 * math.pi * torch.arange(train, dtype=torch.float64) / train
    level = torch.zeros_like(angle)
    around = torch.stack([_DYNAMIC[0] * angle.cos(), _DYNAMIC[1] * angle.sin(), level], dim=-1)
    middle = torch.tensor([[*_HELD_OUT, 0.0]], dtype=torch.float64)
    return _facing(around, size), _facing(middle, size)


# Half widths (x, y, z) of a hand-held camera's path, and its periods in the video.
_SWAY = (0.70, 0.22, 0.15)
_TIMES_AROUND = (1.0, 1.7, 1.3)
# The others have its pose of so much of the video later, aside.
_LATER = 0.4
_ASIDE = (-0.08, 0.06, 0.0)


def hand_held_rig(frames: int, size: Size) -> tuple[Cameras, Cameras]:
    """A hand-held camera at each of ``frames`` times, and another view at each of them.

    It sways, trembles, and looks about the rig's target. The average pose of all is the identity.
    """
    time = torch.arange(frames, dtype=torch.float64) / (frames - 1)
    aside = torch.tensor(_ASIDE, dtype=torch.float64)
    positions = torch.cat([_swayed(time), _swayed(time + _LATER) + aside])
    at = torch.cat([time, time + _LATER])
    # Nobody holds the target in the middle of the picture.
    wanders = torch.stack([0.15 * (9 * at).sin(), 0.10 * (7 * at + 1).cos(), 0 * at], dim=-1)
    cameras = _facing(positions, size, centred=True, wanders=wanders)
    return cameras[slice(frames)], cameras[slice(frames, None)]


def _swayed(time: Tensor) -> Tensor:
    """Positions (N, 3) of the hand at times (N,), world units."""
    turns = 2 * math.pi * time[:, None] * time.new_tensor(_TIMES_AROUND)
    tremor = 0.006 * (time[:, None] * time.new_tensor([157.0, 181.0, 139.0])).sin()
    return time.new_tensor(_SWAY) * (turns + time.new_tensor([0.0, 0.5, 1.0])).sin() + tremor


def _facing(
    positions: Tensor, size: Size, *, centred: bool = False, wanders: Tensor | float = 0.0
) -> Cameras:
    """Float32 cameras at positions (N, 3) float64 that look at the rig's target, y up.

    ``wanders`` (N, 3) is the offset of the point that each looks at from it.
    """
    cameras = Cameras.looking_at(
        positions,
        positions.new_tensor([0.0, 0.0, -_TARGET_DEPTH]).expand_as(positions) + wanders,
        focal=max(size) / 2 / math.tan(FIELD_OF_VIEW / 2),
        width=size[0],
        height=size[1],
        up=positions.new_tensor([0.0, 1.0, 0.0]),
    )
    poses = cameras.camera_to_world
    if centred:
        poses = relative_to(average_pose(poses), poses)
    return replace(
        cameras,
        camera_to_world=poses.float(),
        focal=cameras.focal.float(),
        center=cameras.center.float(),
    )
