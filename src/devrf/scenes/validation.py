"""Checks shared by the scene readers; errors name fault, place and remedy in one line."""

from __future__ import annotations

import math
from collections.abc import Callable

import psutil
import torch
from torch import Tensor

from devrf.errors import DevrfError
from devrf.geometry.box import Box
from devrf.system.options import one_line

# In smaller images there is nothing to learn, and the window of SSIM does not fit.
MIN_SIDE = 8
# Numbers become float32 tensors: overflow there is as bad as infinity.
LARGEST = 3e38


def scene_error(where: object, what: str, typed: str = "") -> DevrfError:
    """The error ``where: what`` in one line; it ends with words to be ``typed``, if any."""
    return DevrfError(one_line(where, what, typed))


def reduced_size(width: int, height: int, downscale: int, where: object) -> tuple[int, int]:
    """(width, height) // downscale, or DevrfError if a side falls under 8 px."""
    w = width // downscale
    h = height // downscale
    if min(w, h) < MIN_SIDE:
        raise scene_error(
            where,
            f"{w}x{h} px at data.downscale={downscale}, expected {MIN_SIDE} px or more; lower it",
        )
    return w, h


def same_shape(size: tuple[float, float], other: tuple[float, float]) -> bool:
    """Whether two (width, height) are those of one image at two scales.

    Sides of the smaller one may be rounded by a pixel each: with more it was cropped or turned.
    """
    smaller, larger = sorted((size, other), key=math.prod)
    least = max((few - 1) / many for few, many in zip(smaller, larger, strict=True))
    most = min((few + 1) / many for few, many in zip(smaller, larger, strict=True))
    return least <= most


def checked_box(value: object) -> Box:
    """The box of its low and high corner, ``[[x, y, z], [x, y, z]]`` in world units.

    DevrfError if it is something else, or holds no volume.
    """
    try:
        low, high = ([float(v) for v in corner] for corner in value)  # type: ignore[attr-defined]
        if not all(math.isfinite(v) for v in (*low, *high)):
            raise ValueError
        return Box.of(low, high)
    except (TypeError, ValueError):
        raise scene_error(
            "data.box", f"expected [[x, y, z], [x, y, z]] with low < high, not {value!r}"
        ) from None


def check_memory(needed: int, where: object, what: str) -> None:
    """DevrfError if ``what``, which ``where`` needs, takes more bytes than the machine has."""
    total = psutil.virtual_memory().total
    if needed > total:
        raise scene_error(
            where,
            f"{what} take {needed / 2**30:.1f} GiB, but this machine has "
            f"{total / 2**30:.1f} GiB of memory; make data.downscale "
            f"{math.ceil(math.sqrt(needed / total))} times as large, or give fewer data.frames",
        )


# Rotations are written with 5 digits or more; further off they are scaled, sheared or mirrored.
ROTATION_TOLERANCE = 1e-2
# World units; a distance, squared twice, still is a float32.
FARTHEST = 1e9


def is_rotation(matrices: Tensor) -> Tensor:
    """Mask (...,) of the matrices (..., 3, 3) that are rotations, up to rounding.

    It is false for matrices that scale, shear or mirror, or hold NaN.
    """
    eye = torch.eye(3).to(matrices)
    off = (matrices.mT @ matrices - eye).abs().amax(dim=(-2, -1))
    upright: Tensor = (off <= ROTATION_TOLERANCE) & (torch.linalg.det(matrices) > 0)
    return upright


def in_reach(positions: Tensor) -> Tensor:
    """Mask (...,) of the positions (..., 3), world units, that float32 can hold; false for NaN."""
    near: Tensor = (positions.abs() <= FARTHEST).all(dim=-1)
    return near


def check_poses(poses: Tensor, where: Callable[[int], object]) -> None:
    """Check camera-to-world poses (N, 3, 4); ``where`` names the one at fault by its position.

    DevrfError if one is no rigid transform, or too far from the origin to be computed with.
    """
    for good, what in (
        (is_rotation(poses[:, :, :3]), "is no rigid transform (scaled, sheared or mirrored axes)"),
        (in_reach(poses[:, :, 3]), f"is farther than {FARTHEST:g} from the origin"),
    ):
        if not bool(good.all()):
            raise scene_error(where(int((~good).nonzero()[0])), f"{what}; correct the pose")
