"""Checks shared by the scene readers: what is wrong, where, and what to do, in one line."""

from __future__ import annotations

import math
import reprlib
from collections.abc import Callable
from typing import Any

import psutil
import torch
from pydantic import ConfigDict, ValidationError, model_validator
from pydantic.dataclasses import dataclass
from torch import Tensor

from devrf.errors import DevrfError
from devrf.geometry.box import Box

# Below this the fields see nothing and the window of SSIM does not fit.
MIN_SIDE = 8
# Numbers become float32 tensors: what overflows there is as bad as infinity.
LARGEST = 3e38
# A name in a file can be of any length; a message has to be read.
LONGEST_MESSAGE = 480
LONGEST_VALUE = 60
# Sides are rounded when images are made smaller; beyond this they were cropped or turned.
SAME_SHAPE = 0.05

_brief = reprlib.Repr()
_brief.maxlevel = 2


def scene_error(where: object, what: str) -> DevrfError:
    """The error ``where: what`` in one line."""
    return DevrfError(_shortened(" ".join(f"{where}: {what}".split()), LONGEST_MESSAGE))


def first_error(error: ValidationError, where: str) -> DevrfError:
    """The first thing that pydantic found wrong: key, expectation, and the value that was given.

    Args:
        error: what a model or an adapter raised.
        where: what comes before the key: ``FILE: `` for values in a file, ``data.`` for options.
    """
    first = error.errors(include_url=False)[0]
    key = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in first["loc"])
    place = f"{where}{key.removeprefix('.')}" if key else where.rstrip(": .")
    if first["type"] == "json_invalid":
        return scene_error(place, f"not valid JSON ({first['ctx']['error']}); write it again")
    if first["type"] == "missing":
        return scene_error(place, "is missing; add it")
    if first["type"] == "unexpected_keyword_argument":
        return scene_error(place, "no such option; correct its name")
    if first["type"] == "value_error":  # raised by a validator of ours
        return scene_error(place, str(first["ctx"]["error"]))
    expected = first["msg"].removeprefix("Input ").replace(" after validation", "")
    # For lists that are too short or too long, the message says the length itself.
    value = "" if ", not " in expected else f", not {abbreviated(first['input'])}"
    return scene_error(place, f"{expected[0].lower()}{expected[1:]}{value}; correct it")


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class Options:
    """Options of a scene, checked when they are set; a wrong one is a DevrfError of one line."""

    @model_validator(mode="wrap")
    @classmethod
    def _in_one_line(cls, value: Any, validate: Any) -> Any:
        try:
            return validate(value)
        except ValidationError as error:
            raise first_error(error, "data.") from None


def abbreviated(value: object) -> str:
    """A value from a file as a message shows it: however large or deep, in a few words."""
    return _shortened(_brief.repr(value), LONGEST_VALUE)


def _shortened(text: str, most: int) -> str:
    """``text``, its middle left out where it is longer than ``most`` characters."""
    half = most // 2 - 2
    return text if len(text) <= most else f"{text[:half]}...{text[-half:]}"


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
    """Whether two (width, height) are those of one image at two scales, sides rounded."""
    return abs(size[0] * other[1] / (size[1] * other[0]) - 1) <= SAME_SHAPE


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
    """DevrfError if ``what``, which ``where`` asks for, takes more bytes than the machine has."""
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
# World units in which a distance, squared twice, still is a float32.
FARTHEST = 1e9


def is_rotation(matrices: Tensor) -> Tensor:
    """Which matrices (..., 3, 3) turn without scaling, shearing or mirroring, up to rounding.

    Returns:
        A mask (...,); false where a matrix holds NaN.
    """
    eye = torch.eye(3).to(matrices)
    off = (matrices.mT @ matrices - eye).abs().amax(dim=(-2, -1))
    upright: Tensor = (off <= ROTATION_TOLERANCE) & (torch.linalg.det(matrices) > 0)
    return upright


def in_reach(positions: Tensor) -> Tensor:
    """Which positions (..., 3), world units, can be computed with; false where one holds NaN."""
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
