"""Footage frame by frame: a video, or a folder of photographs."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from devrf.scenes.files import existing_file
from devrf.scenes.image_folders import listed_images
from devrf.scenes.validation import scene_error

# 8-bit RGB, (H, W, 3).
Picture = npt.NDArray[np.uint8]
# Width, height.
Size = tuple[int, int]

_REMEDY = "convert it, for example to H.264 in an mp4 file"


def is_folder(path: Path) -> bool:
    """Whether the footage is a folder of photographs, which have no times."""
    return os.path.isdir(path)


@dataclass(frozen=True)
class FilmHeader:
    """What a video says of itself.

    Attributes:
        size: width and height of its frames in pixels.
        frames: how many it has; not to be relied on, cameras and converters miscount.
    """

    size: Size
    frames: int


def film_header(path: Path) -> FilmHeader:
    """What a video says of itself, no frame decoded; DevrfError if it is none."""
    with _opened(path) as video:
        width = int(video.get(cv2.CAP_PROP_FRAME_WIDTH))
        height = int(video.get(cv2.CAP_PROP_FRAME_HEIGHT))
        frames = int(video.get(cv2.CAP_PROP_FRAME_COUNT))
    return FilmHeader((width, height), frames)


def frame_count(path: Path) -> int:
    """How many frames the footage claims to have, at least 1: for progress, not to rely on."""
    return max(1, len(listed_images(path)) if is_folder(path) else film_header(path).frames)


def pictures(path: Path) -> Iterator[tuple[float, Picture]]:
    """Time in seconds since the first frame, and each frame, turned as its file says.

    The times of photographs are their positions. DevrfError if it is no footage.
    """
    if is_folder(path):
        for position, file in enumerate(listed_images(path)):
            yield float(position), _photograph(file)
        return
    with _opened(path) as video:
        yield from _frames(path, video)


def chosen(path: Path, positions: Sequence[int]) -> Iterator[tuple[int, Picture]]:
    """The frames at ``positions``, ascending, each with its position; no others are kept.

    DevrfError if it is no footage, or ends before the last position.
    """
    wanted = set(positions)
    last = max(positions)
    if is_folder(path):
        files = listed_images(path)
        for position in sorted(wanted):
            yield position, _photograph(files[position])
        return
    with _opened(path) as video:
        for position in range(last + 1):
            read = video.grab()
            image = None
            if read and position in wanted:
                read, image = video.retrieve()
            if not read:
                raise scene_error(
                    path, f"ends after {position} frames, expected {last + 1}; convert it again"
                )
            if image is not None:
                yield position, _rgb(image)


@contextmanager
def _opened(path: Path) -> Iterator[cv2.VideoCapture]:
    existing_file(path, "give a video that is there")
    # FFmpeg and OpenCV would print on stderr what is said here in a line.
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)
    video = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    cv2.utils.logging.setLogLevel(level)
    try:
        if not video.isOpened():
            raise scene_error(path, f"not a readable video; {_REMEDY}")
        yield video
    finally:
        video.release()


def _frames(path: Path, video: cv2.VideoCapture) -> Iterator[tuple[float, Picture]]:
    rate = float(video.get(cv2.CAP_PROP_FPS))
    if not 0 < rate < 10_000:
        raise scene_error(path, f"states no frame rate; {_REMEDY}")
    position = 0
    last = -1.0
    while True:
        read, image = video.read()
        if not read:
            break
        # Phones do not keep their rate; frames without times are taken to be evenly spaced.
        time = float(video.get(cv2.CAP_PROP_POS_MSEC)) / 1000
        if not time > last:
            time = last + 1 / rate if position else 0.0
        yield time, _rgb(image)
        position += 1
        last = time
    if position < 2:
        raise scene_error(
            path,
            f"a video of {position or 'no'} frame{'s' * (position != 1)}, expected at least 2; "
            f"give a longer one, or {_REMEDY}",
        )


def _photograph(file: Path) -> Picture:
    image = cv2.imread(str(file), cv2.IMREAD_COLOR)
    if image is None:
        raise scene_error(file, "not a readable image; convert it to PNG or JPEG")
    return _rgb(image)


def _rgb(image: npt.NDArray[Any]) -> Picture:
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8)
