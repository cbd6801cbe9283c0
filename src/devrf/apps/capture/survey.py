"""A survey of footage: the sharpness of each frame, its motion, and the best frames."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from devrf.apps.capture.images import shrunk
from devrf.errors import DevrfError
from devrf.scenes.footage import Picture, pictures

log = logging.getLogger(__name__)

# Frames are looked at with so many pixels of the longer side: much smaller ones hide blur, larger
# ones show the sensor's noise.
LONGER_SIDE = 640
# Longer side, in pixels, of the images in which motion is measured: noise and compression are
# averaged away.
MOTION_SIDE = 160
# A change of so many grey levels, or fewer, is noise.
NOISE = 2.0
# Below this, an image of a textured scene is blurred so far that few features are left. Sharp
# photographs have 0.5 and more; strong blur has up to 0.44, as H.264 makes blocks of it.
BLURRED = 0.45
# Fewer images do not suffice for structure from motion.
MIN_IMAGES = 3

Grey = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Survey:
    """Measurements of one video.

    Attributes:
        size: width and height of its frames in pixels.
        times: N times in seconds, the first frame's 0.
        sharpness: N values in [0, 1], see :func:`sharpness`.
        motion: N values, the change since the frame before (:func:`moved`).
    """

    size: tuple[int, int]
    times: tuple[float, ...]
    sharpness: tuple[float, ...]
    motion: tuple[float, ...]

    def __post_init__(self) -> None:
        rising = all(a < b < math.inf for a, b in pairwise((-1.0, *self.times)))
        finite = all(map(math.isfinite, (*self.sharpness, *self.motion)))
        alike = 0 < len(self.times) == len(self.sharpness) == len(self.motion)
        if not (rising and finite and alike and min(self.size) > 0):
            raise ValueError("no survey")

    @property
    def rate(self) -> float:
        """Frames a second, the median."""
        return 1 / float(np.median(np.diff(self.times)))


def survey(path: Path, frames: Iterable[tuple[float, Picture]] | None = None) -> Survey:
    """Look at all frames of a video, or at all photographs of a folder, or at ``frames`` of it.

    Raises:
        DevrfError: as of :func:`devrf.scenes.footage.pictures`, or the frames have several sizes.
    """
    size: tuple[int, int] | None = None
    times = list[float]()
    sharp = list[float]()
    motion = list[float]()
    before: Grey | None = None
    for time, picture in frames or pictures(path):
        height, width = picture.shape[:2]
        if size not in (None, (width, height)):
            raise DevrfError(
                f"{path}: image {len(times) + 1} has {width}x{height} px, those before it have "
                f"{size}; bring all images to one size"
            )
        size = (width, height)
        grey = shrunk(
            np.asarray(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), np.float32), LONGER_SIDE
        )
        small = cv2.GaussianBlur(shrunk(grey, MOTION_SIDE), (0, 0), 1.0).astype(np.float32)
        times.append(time)
        sharp.append(sharpness(grey))
        change = 0.0 if before is None else moved(before, small)
        motion.append(change)
        before = small
    assert size is not None  # there is a first frame, or reading has failed
    return Survey(size, tuple(times), tuple(sharp), tuple(motion))


def sharpness(grey: Grey) -> float:
    """Sharpness of an image (H, W), from 0 (blurred) to 1, whatever it shows.

    It is the share of the differences between neighbouring pixels that a strong blur takes away:
    large for a sharp image, small for one that is blurred already (Crété et al., "The blur
    effect", 2007). The less sharp of both directions counts.
    """
    shares = []
    for axis, kernel in ((0, (1, 9)), (1, (9, 1))):
        sharp = np.abs(np.diff(grey, axis=axis))
        blurred = cv2.blur(grey, kernel)
        soft = np.abs(np.diff(blurred, axis=axis))
        lost = np.maximum(sharp - soft, 0).sum()
        shares.append(float(lost / sharp.sum()) if sharp.sum() > 0 else 0.0)
    return min(shares)


def moved(before: Grey, after: Grey) -> float:
    """Mean over the image of the change that exceeds noise, grey levels.

    The median change is taken off first: exposure and key frames change all pixels alike.
    """
    change = after - before
    change = np.abs(change - np.median(change))
    return float(np.maximum(change - NOISE, 0).mean())


def sharpest(sharpness: Sequence[float], count: int) -> list[int]:
    """Positions, ascending, of the sharpest frame of each of at most ``count`` equal stretches."""
    count = min(count, len(sharpness))
    bounds = np.linspace(0, len(sharpness), count + 1).round().astype(int)
    return [int(low + np.argmax(sharpness[low:high])) for low, high in pairwise(bounds)]


def check_sharp(path: Path, sharpness: Sequence[float], picked: Sequence[int]) -> None:
    """Check that enough frames are sharp enough.

    Raises:
        DevrfError: there are too few frames, or most of them are blurred.
    """
    if len(picked) < MIN_IMAGES:
        raise DevrfError(
            f"{path}: {len(picked)} images, expected at least {MIN_IMAGES}; film the scene from "
            "more places"
        )
    blurred = [position for position in picked if sharpness[position] < BLURRED]
    if len(blurred) > len(picked) / 2:
        raise DevrfError(
            f"{path}: {len(blurred)} of its {len(picked)} sharpest frames are blurred; film more "
            "slowly, with a shutter of 1/100 s or shorter, in focus"
        )
    if blurred:
        log.warning("%s: %d of %d frames are blurred", path, len(blurred), len(picked))
