"""Footage frame by frame: a video, or a folder of photographs."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from devrf.errors import DevrfError
from devrf.scenes.image_folders import listed_images

# 8-bit RGB, (H, W, 3).
Picture = npt.NDArray[np.uint8]

_REMEDY = "convert it, for example to H.264 in an mp4 file"


def is_folder(path: Path) -> bool:
    """Whether the footage is a folder of photographs, which have no times."""
    return os.path.isdir(path)


def frame_count(path: Path) -> int:
    """How many frames the footage says to have, at least 1: for progress, not to be relied on."""
    if is_folder(path):
        return len(listed_images(path))
    video = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    try:
        return max(1, int(video.get(cv2.CAP_PROP_FRAME_COUNT)))
    finally:
        video.release()


def pictures(path: Path) -> Iterator[tuple[float, Picture]]:
    """Time in seconds since the first frame, and each frame, turned as its file says.

    Of photographs the times are their positions.

    Raises:
        DevrfError: there is no such file, or it cannot be read as footage.
    """
    if is_folder(path):
        for position, file in enumerate(listed_images(path)):
            image = cv2.imread(str(file), cv2.IMREAD_COLOR)
            if image is None:
                raise DevrfError(f"{file}: not a readable image; convert it to PNG or JPEG")
            yield float(position), _rgb(image)
        return
    if not os.path.isfile(path):
        raise DevrfError(f"{path}: no such video; correct capture.static or capture.views")
    # FFmpeg and OpenCV would complain on stderr of what is said here in a line.
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)
    video = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    cv2.utils.logging.setLogLevel(level)
    try:
        if not video.isOpened():
            raise DevrfError(f"{path}: not a readable video; {_REMEDY}")
        yield from _frames(path, video)
    finally:
        video.release()


def _frames(path: Path, video: cv2.VideoCapture) -> Iterator[tuple[float, Picture]]:
    rate = float(video.get(cv2.CAP_PROP_FPS))
    if not 0 < rate < 10_000:
        raise DevrfError(f"{path}: states no frame rate; {_REMEDY}")
    position, last = 0, -1.0
    while True:
        found, image = video.read()
        if not found:
            break
        # Telephones do not keep their rate; a file without times of its frames is taken as even.
        time = float(video.get(cv2.CAP_PROP_POS_MSEC)) / 1000
        if not time > last:
            time = last + 1 / rate if position else 0.0
        yield time, _rgb(image)
        position, last = position + 1, time
    if position < 2:
        raise DevrfError(
            f"{path}: a video of {position or 'no'} frame{'s' * (position != 1)}, expected at "
            f"least 2; give a longer one, or {_REMEDY}"
        )


def chosen(path: Path, positions: Sequence[int]) -> Iterator[tuple[int, Picture]]:
    """The frames at ``positions``, ascending, each with its position.

    Raises:
        DevrfError: what :func:`pictures` raises.
    """
    wanted, last = set(positions), max(positions)
    for position, (_, picture) in enumerate(pictures(path)):
        if position in wanted:
            yield position, picture
        if position == last:
            return


def _rgb(image: npt.NDArray[Any]) -> Picture:
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8)
