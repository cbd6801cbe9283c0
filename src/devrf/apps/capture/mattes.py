"""Mattes of footage that another program has made: where they are, and that they fit."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from devrf.errors import DevrfError
from devrf.scenes.footage import chosen, is_folder
from devrf.scenes.image_folders import listed_images
from devrf.scenes.masks import read_mask

# 8-bit grey, (H, W): white is kept, black is background.
Matte = npt.NDArray[np.uint8]

VIDEOS = (".mp4", ".mov", ".mkv", ".avi", ".webm")


def mattes_of(folder: Path, footage: Path, count: int) -> Path:
    """The mattes of some footage: ``<folder>/<its name without suffix>``, a folder or a video.

    Of photographs it is a folder with a file of each one's name; of a video one with as many
    images as it has frames, in the order of their names, or a video of as many frames.

    Args:
        folder: ``capture.mattes``.
        footage: the video, or the folder of photographs.
        count: how many frames it has.

    Raises:
        DevrfError: there are none, or not of all frames.
    """
    if not os.path.isdir(folder):
        raise DevrfError(
            f"{folder}: no such folder of mattes; correct capture.mattes, or give subtract"
        )
    place = folder / footage.stem
    video = next((v for v in (folder / f"{footage.stem}{s}" for s in VIDEOS) if v.is_file()), None)
    if not os.path.isdir(place):
        if video is None or is_folder(footage):
            raise DevrfError(
                f"{place}: no such folder, expected the mattes of {footage}; add it with an image "
                f"for each {'photograph' if is_folder(footage) else 'frame'}"
            )
        return video
    if is_folder(footage):
        for photograph in listed_images(footage):
            _of_photograph(place, photograph)
    elif len(listed_images(place)) != count:
        raise DevrfError(
            f"{place}: {len(listed_images(place))} mattes, but {footage} has {count} frames; give "
            "an image for each frame, in the order of their names"
        )
    return place


def chosen_mattes(
    mattes: Path, footage: Path, positions: Sequence[int], size: tuple[int, int]
) -> Iterator[tuple[int, Matte]]:
    """The mattes of the frames at ``positions``, ascending, each with its position.

    Args:
        mattes: what :func:`mattes_of` returned.
        footage: what they belong to.
        positions: of the frames.
        size: width and height of the frames.

    Raises:
        DevrfError: one is no grey image, has another size than its frame, or is missing.
    """
    if is_folder(mattes):
        files = listed_images(mattes)
        if is_folder(footage):
            files = [_of_photograph(mattes, one) for one in listed_images(footage)]
        for position in positions:
            yield position, read_mask(files[position], size, None, footage)
        return
    for position, picture in chosen(mattes, positions):
        height, width = picture.shape[:2]
        if (width, height) != size:
            raise DevrfError(
                f"{mattes}: {width}x{height} px, but {footage} has {size[0]}x{size[1]} px; give "
                "mattes of its size"
            )
        # Grey as it is, whatever compression has made of its colours.
        yield position, picture.mean(axis=2).round().astype(np.uint8)


def _of_photograph(mattes: Path, photograph: Path) -> Path:
    for one in listed_images(mattes):
        if one.stem == photograph.stem:
            return one
    raise DevrfError(
        f"{mattes / photograph.stem}.png: no such matte, of {photograph}; give each photograph one "
        "of its name"
    )
