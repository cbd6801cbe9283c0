"""Chosen frames of all footage as image files of one size."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import repeat
from pathlib import Path

import cv2
import numpy as np

from devrf.apps.capture.mattes import Matte, chosen_mattes
from devrf.errors import DevrfError
from devrf.scenes.footage import Picture, chosen

Size = tuple[int, int]


@dataclass(frozen=True)
class Chosen:
    """Which frames of one video become images.

    Attributes:
        path: the footage.
        label: the folder of its images: ``static``, ``view1`` …
        positions: of its frames, ascending where distinct; a frame may be wanted twice.
        mattes: of all its frames, which become the images' alpha; None: the images have none.
    """

    path: Path
    label: str
    positions: tuple[int, ...]
    mattes: Path | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """The image of each position, relative to the folder of images."""
        return tuple(f"{self.label}/{position:05d}.png" for position in self.positions)


def common_size(sizes: dict[Path, Size], longer: int) -> Size:
    """Width and height of all images: those of the first footage, made smaller if need be.

    Raises:
        DevrfError: some footage is upright, other lies on its side.
    """
    (first, (width, height)), *others = sizes.items()
    for path, (w, h) in others:
        if (w > h) != (width > height):
            raise DevrfError(
                f"{path}: {w}x{h} px, but {first} has {width}x{height} px; hold all cameras the "
                "same way, or turn the video"
            )
    factor = min(1.0, longer / max(width, height))
    return round(width * factor), round(height * factor)


def write_frames(folder: Path, footage: Chosen, size: Size, filmed: Size) -> Iterator[Path]:
    """Write the images of one video, each when it is asked for.

    Frames of other proportions are cropped in the middle; then all are brought to ``size``.

    Args:
        folder: of images.
        footage: which of its frames.
        size: of the images.
        filmed: of the frames.

    Raises:
        DevrfError: what :func:`devrf.scenes.footage.chosen` and
            :func:`devrf.apps.capture.mattes.chosen_mattes` raise, or an image cannot be written.
    """
    (folder / footage.label).mkdir(parents=True, exist_ok=True)
    places = dict(zip(footage.positions, footage.names, strict=True))
    wanted = sorted(places)
    mattes: Iterator[tuple[int, Matte] | None] = repeat(None, len(wanted))
    if footage.mattes is not None:
        mattes = chosen_mattes(footage.mattes, footage.path, wanted, filmed)
    for (position, picture), matte in zip(chosen(footage.path, wanted), mattes, strict=False):
        path = folder / places[position]
        image = cv2.cvtColor(fitted(picture, size), cv2.COLOR_RGB2BGR)
        if matte is not None:
            image = np.dstack([image, fitted(matte[1], size)])
        if not cv2.imwrite(str(path), image):
            raise DevrfError(f"{path}: cannot be written; see that there is room, and permission")
        yield path


def fitted(picture: Picture, size: Size) -> Picture:
    """A picture cropped in the middle to the proportions of ``size``, and brought to it."""
    height, width = picture.shape[:2]
    scale = max(size[0] / width, size[1] / height)
    w, h = min(width, round(size[0] / scale)), min(height, round(size[1] / scale))
    left, top = (width - w) // 2, (height - h) // 2
    part = picture[top : top + h, left : left + w]
    if (w, h) == size:
        return part
    way = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    return np.asarray(cv2.resize(part, size, interpolation=way), np.uint8)
