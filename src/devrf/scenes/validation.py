"""Checks shared by the scene readers: what is wrong, where, and what to do, in one line."""

from __future__ import annotations

import math
import reprlib
from collections.abc import Iterable

from devrf.errors import DevrfError
from devrf.geometry.box import Box

# A hostile header can promise any size; no camera in the field makes images beyond this.
MAX_PIXELS = 100_000_000
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
    """The error ``where: what``, made one short printable line whatever its parts contain."""
    line = " ".join(_shortened(f"{where}: {what}", LONGEST_MESSAGE).split())
    # Names may hold what a terminal takes for a command, or what no file can be written with.
    printable = "".join(
        c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in line
    )
    return DevrfError(_shortened(printable, LONGEST_MESSAGE))


def abbreviated(value: object) -> str:
    """A value from a file as a message shows it: however large or deep, in a few words."""
    return _shortened(_brief.repr(value), LONGEST_VALUE)


def _shortened(text: str, most: int) -> str:
    """``text``, its middle left out where it is longer than ``most`` characters."""
    half = most // 2 - 2
    return text if len(text) <= most else f"{text[:half]}...{text[-half:]}"


def number(value: object) -> float | None:
    """``value`` as a float, or None when it is none: a bool, text, NaN, beyond float32."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    try:
        result = float(value)
    except OverflowError:
        return None
    return result if abs(result) < LARGEST else None


def reduced_size(width: int, height: int, downscale: int, where: object) -> tuple[int, int]:
    """(width, height) // downscale, or DevrfError when a side falls under 8 px."""
    w, h = width // downscale, height // downscale
    if min(w, h) < MIN_SIDE:
        raise scene_error(
            where,
            f"{width}x{height} px at data.downscale={downscale} leaves {w}x{h} px, at least "
            f"{MIN_SIDE} px a side are needed; use a smaller data.downscale",
        )
    return w, h


def same_shape(one: tuple[float, float], other: tuple[float, float]) -> bool:
    """Whether two (width, height) are those of one image at two scales, sides rounded."""
    return abs(one[0] * other[1] / (one[1] * other[0]) - 1) <= SAME_SHAPE


def check_choice(key: str, value: object, choices: Iterable[str]) -> None:
    """DevrfError unless ``value`` is one of ``choices``."""
    allowed = tuple(choices)
    if value not in allowed:
        raise scene_error(key, f"expected one of {', '.join(allowed)}, not {value!r}")


def check_count(key: str, value: object, least: int) -> None:
    """DevrfError unless ``value`` is None or a whole number of at least ``least``."""
    if value is None:
        return
    if isinstance(value, bool) or not isinstance(value, int) or value < least:
        raise scene_error(key, f"expected a whole number of at least {least}, not {value!r}")


def check_bound_scale(value: object) -> None:
    """DevrfError unless ``value`` is "auto" or a number ≥ 1."""
    scale = number(value)
    if value != "auto" and (scale is None or scale < 1):
        raise scene_error(
            "data.bound_scale", f'expected "auto" or a number of at least 1, not {value!r}'
        )


def checked_box(value: object) -> Box:
    """The box of ``[[x, y, z], [x, y, z]]``: its low and high corner in world units."""
    try:
        low, high = ([float(v) for v in corner] for corner in value)  # type: ignore[attr-defined]
        if not all(math.isfinite(v) for v in (*low, *high)):
            raise ValueError
        return Box.of(low, high)
    except (TypeError, ValueError):
        raise scene_error(
            "data.box", f"expected [[x, y, z], [x, y, z]] with low < high, not {value!r}"
        ) from None
