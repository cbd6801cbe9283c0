"""Checks of the numbers that a procedural scene is made from."""

from __future__ import annotations

from devrf.scenes.validation import MIN_SIDE, number, scene_error

_LARGEST_SIDE = 4096
_MOST = 10_000
# Least and largest value of each count that a recipe may have.
_COUNTS = {
    "width": (MIN_SIDE, _LARGEST_SIDE),
    "height": (MIN_SIDE, _LARGEST_SIDE),
    "static_views": (1, _MOST),
    "static_test_views": (1, _MOST),
    "train_views": (1, _MOST),
    "frames": (2, _MOST),
    "supersample": (1, 16),
}


def check_recipe(recipe: object, *, fastest: float) -> None:
    """DevrfError unless all numbers of ``recipe`` are in range.

    Args:
        recipe: its attributes ``width``, ``frames``, … where it has them, ``speed``, ``light``.
        fastest: the largest speed at which the shape stays whole.
    """
    for key, (least, most) in _COUNTS.items():
        if not hasattr(recipe, key):
            continue
        value = getattr(recipe, key)
        if isinstance(value, bool) or not isinstance(value, int):
            raise scene_error(f"data.{key}", f"must be a whole number, not {value!r}")
        if not least <= value <= most:
            bound = f"at least {least}" if value < least else f"at most {most}"
            raise scene_error(f"data.{key}", f"must be {bound}, not {value}")
    for key, highest in (("speed", fastest), ("light", 1.0)):
        given = getattr(recipe, key)
        amount = number(given)
        if amount is None or not 0 <= amount <= highest:
            raise scene_error(f"data.{key}", f"must be a number in 0 … {highest:g}, not {given!r}")
