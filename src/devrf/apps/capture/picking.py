"""Which frames of a moving camera's video become images: the sharpest of each stretch."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from devrf.errors import DevrfError

log = logging.getLogger(__name__)

# Below this, an image of a textured scene is blurred so far that few features are left. Of sharp
# photographs the value is 0.5 and more; of strong blur up to 0.44, as H.264 makes blocks of it.
BLURRED = 0.45
# From fewer images there is no structure from motion worth the name.
LEAST = 3


def sharpest(sharpness: Sequence[float], count: int) -> list[int]:
    """Positions, ascending, of the sharpest frame of each of ``count`` equal stretches.

    Of no more than ``count`` frames all are taken.
    """
    if len(sharpness) <= count:
        return list(range(len(sharpness)))
    bounds = np.linspace(0, len(sharpness), count + 1).round().astype(int)
    return [
        int(low + np.argmax(sharpness[low:high]))
        for low, high in zip(bounds, bounds[1:], strict=False)
    ]


def check_sharp(path: Path, sharpness: Sequence[float], picked: Sequence[int]) -> None:
    """Check that enough frames are sharp enough.

    Raises:
        DevrfError: there are too few frames, or most of them are blurred.
    """
    if len(picked) < LEAST:
        raise DevrfError(
            f"{path}: {len(picked)} images, expected at least {LEAST}; film the scene from more "
            "places"
        )
    blurred = [position for position in picked if sharpness[position] < BLURRED]
    if len(blurred) > len(picked) / 2:
        raise DevrfError(
            f"{path}: {len(blurred)} of its {len(picked)} sharpest frames are blurred; film more "
            "slowly, with a shutter of 1/100 s or shorter, in focus"
        )
    if blurred:
        log.warning("%s: %d of %d frames are blurred", path, len(blurred), len(picked))
