"""Checks shared by the scene readers: what is wrong, where, and what to do, in one line."""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path

from devrf.errors import DevrfError
from devrf.geometry.box import Box

# A hostile header can promise any size; no camera in the field makes images beyond this.
MAX_PIXELS = 100_000_000
# Below this the fields see nothing and the window of SSIM does not fit.
MIN_SIDE = 8
# Numbers become float32 tensors: what overflows there is as bad as infinity.
LARGEST = 3e38


def problem(where: object, what: str) -> DevrfError:
    """The error ``where: what``, made one line whatever its parts contain."""
    return DevrfError(" ".join(f"{where}: {what}".split()))


def existing_folder(folder: Path) -> Path:
    """``folder`` itself, or DevrfError when there is no such folder."""
    if not folder.is_dir():
        raise problem(folder, "no such folder; set data.root to the scene's folder")
    return folder


def inside(root: Path, path: Path, file: Path) -> Path:
    """``path`` with links and ``..`` resolved, or DevrfError when it leaves ``root``.

    Args:
        root: the scene's folder.
        path: a path built from text in a file.
        file: the file that the text came from, for the message.
    """
    try:
        resolved = path.resolve()
        inner = resolved.is_relative_to(root.resolve())
    except (OSError, ValueError, RuntimeError) as error:
        raise problem(file, f"file_path {str(path)!r} is not a path ({error})") from None
    if not inner:
        raise problem(
            file, f"file_path leads to {resolved}, outside the scene's folder; put the images "
            "into it",
        )
    return resolved


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
        raise problem(
            where,
            f"{width}x{height} px at data.downscale={downscale} leaves {w}x{h} px, at least "
            f"{MIN_SIDE} px a side are needed; use a smaller data.downscale",
        )
    return w, h


def check_choice(key: str, value: object, choices: Iterable[str]) -> None:
    """DevrfError unless ``value`` is one of ``choices``."""
    allowed = tuple(choices)
    if value not in allowed:
        raise problem(key, f"expected one of {', '.join(allowed)}, not {value!r}")


def check_count(key: str, value: object, least: int) -> None:
    """DevrfError unless ``value`` is None or a whole number of at least ``least``."""
    if value is None:
        return
    if isinstance(value, bool) or not isinstance(value, int) or value < least:
        raise problem(key, f"expected a whole number of at least {least}, not {value!r}")


def check_bound_scale(value: object) -> None:
    """DevrfError unless ``value`` is "auto" or a number ≥ 1."""
    scale = number(value)
    if value != "auto" and (scale is None or scale < 1):
        raise problem(
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
        raise problem(
            "data.box", f"expected [[x, y, z], [x, y, z]] with low < high, not {value!r}"
        ) from None
