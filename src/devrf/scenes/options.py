"""What all readers of inward-facing scenes ask of their options."""

from __future__ import annotations

from typing import Any, get_args

from devrf.geometry.box import Box
from devrf.scenes.scene import Background
from devrf.scenes.validation import (
    check_bound_scale,
    check_choice,
    check_count,
    checked_box,
    number,
    scene_error,
)


def check_options(
    *,
    downscale: Any,
    background: Any,
    bound_scale: Any,
    near: Any,
    far: Any,
    box: Any,
    frames: Any,
    static_until: Any,
    train_views: Any = None,
) -> Box | None:
    """DevrfError unless each option is of its kind; else the box that was given, if one was."""
    check_count("data.downscale", downscale, 1)
    check_count("data.train_views", train_views, 1)
    check_count("data.frames", frames, 2)
    check_choice("data.background", background, get_args(Background))
    check_bound_scale(bound_scale)
    for key, value in (("data.near", near), ("data.far", far)):
        if value is not None and number(value) is None:
            raise scene_error(key, f"expected a distance in world units or null, not {value!r}")
    until = 0.0 if static_until is None else number(static_until)
    if until is None or not 0 <= until <= 1:
        raise scene_error("data.static_until", f"expected a time in [0, 1], not {static_until!r}")
    return None if box is None else checked_box(box)
