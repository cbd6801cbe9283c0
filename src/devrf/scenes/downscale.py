"""By what factor images are made smaller: as asked, or as far as they stay large enough."""

from __future__ import annotations

import logging
import re
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

from pydantic import PlainValidator

from devrf.errors import DevrfError
from devrf.scenes.image_files import image_size
from devrf.scenes.image_folders import image_folder, listed_images

log = logging.getLogger(__name__)

# ``up_to_<N>`` keeps so many pixels of the shorter side: of smaller images little can be learned.
LEAST_SIDE = 64
_UP_TO = re.compile(r"up_to_([1-9]\d{0,3})")


def _downscale(value: object) -> object:
    whole = isinstance(value, int) and not isinstance(value, bool) and value >= 1
    if not whole and not (isinstance(value, str) and _UP_TO.fullmatch(value)):
        raise ValueError(f"expected a whole number of at least 1, or up_to_<number>, not {value!r}")
    return value


# A factor, or ``up_to_<factor>``.
Downscale = Annotated[int | str, PlainValidator(_downscale)]


def whole_factor(downscale: int | str, side_at: Callable[[int], int | None]) -> int:
    """The factor by which images are made smaller.

    A number is obeyed. ``up_to_<N>`` takes the largest factor up to N at which the shorter side
    keeps 64 pixels, or else the one that leaves the most.

    Args:
        downscale: an option of that name.
        side_at: the shorter side in pixels at a factor, None where it cannot be had.
    """
    if isinstance(downscale, int):
        return downscale
    most = int(downscale.removeprefix("up_to_"))
    sides = {factor: side_at(factor) for factor in range(most, 0, -1)}
    known = {factor: side for factor, side in sides.items() if side is not None}
    enough = [factor for factor, side in known.items() if side >= LEAST_SIDE]
    if not known:
        return most  # the reader of the files says what is missing
    factor = enough[0] if enough else max(known, key=lambda one: (known[one], -one))
    if factor < most:
        log.info(
            "images %s, although data.downscale=%s: their shorter side has %d px, and is not to "
            "fall below %d (data.downscale=%d all the same)",
            f"are made smaller by {factor}" if factor > 1 else "keep their size",
            downscale,
            known[factor],
            LEAST_SIDE,
            most,
        )
    return factor


def folder_factor(
    parent: Path, downscale: int | str, *, full: str = "images", reduced: str = "images_{}"
) -> int:
    """:func:`whole_factor` for images in folders of several sizes; arguments as image_folder's.

    Raises:
        DevrfError: a folder holds no image, or one that cannot be read.
    """

    def side_at(factor: int) -> int | None:
        try:
            source = image_folder(parent, factor, full=full, reduced=reduced)
        except DevrfError:
            return None
        return min(image_size(listed_images(source.path)[0])) // source.downscale

    return whole_factor(downscale, side_at)
