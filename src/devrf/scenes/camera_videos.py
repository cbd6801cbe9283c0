"""``cam00.mp4``, ``cam01.mp4`` …: synchronised videos by cameras that stand still."""

from __future__ import annotations

import logging
import os
import re
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from devrf.scenes.footage import FilmHeader, Size, chosen, film_header
from devrf.scenes.images import workers
from devrf.scenes.memory import check_memory
from devrf.scenes.paths import entries
from devrf.scenes.resampling import shrink_pixels
from devrf.scenes.validation import reduced_size, scene_error

log = logging.getLogger(__name__)

_VIDEO = re.compile(r"cam(\d{1,6})\.mp4", re.IGNORECASE)


@dataclass(frozen=True)
class CameraVideos:
    """Videos of one length and one size.

    Attributes:
        paths: V files in the order of their names.
        numbers: V numbers in these names.
        frames: how many frames each has.
        size: width and height of the frames in pixels.
    """

    paths: tuple[Path, ...]
    numbers: tuple[int, ...]
    frames: int
    size: Size

    def name_of(self, video: int, frame: int) -> str:
        """What a frame is called in messages and tables."""
        return f"{self.paths[video].name} frame {frame}"


def camera_videos(folder: Path) -> CameraVideos:
    """The videos in a folder; their frames are not read yet.

    Raises:
        DevrfError: there are fewer than two, one cannot be read, or they differ in length or size.
    """
    found = [
        (path, int(match[1]))
        for path in entries(folder)
        if (match := _VIDEO.fullmatch(path.name)) and os.path.isfile(path)
    ]
    if len(found) < 2:
        raise scene_error(
            folder,
            f"{len(found)} videos cam00.mp4, cam01.mp4, …, expected at least 2: one to learn from, "
            "one to hold out; set data.root to the folder of poses_bounds.npy and the videos",
        )
    paths, numbers = (tuple(part) for part in zip(*found, strict=True))
    headers = [film_header(path) for path in paths]
    first = headers[0]
    for path, header in zip(paths, headers, strict=True):
        if header != first:
            raise scene_error(
                path,
                f"{_in_words(header)}, but {paths[0].name} has {_in_words(first)}; all videos show "
                "the same moments, in the same size: cut or convert them",
            )
    if first.frames < 2:
        raise scene_error(paths[0], f"{first.frames} frames, expected at least 2")
    return CameraVideos(paths, numbers, first.frames, first.size)


def _in_words(header: FilmHeader) -> str:
    return f"{header.frames} frames of {header.size[0]}x{header.size[1]} px"


def read_frames(
    videos: CameraVideos, wanted: Sequence[int], frames: Sequence[int], downscale: int
) -> Tensor:
    """The chosen frames of the chosen videos; of others nothing is kept in memory.

    Args:
        videos: where to read from.
        wanted: K of their positions.
        frames: T positions of frames, ascending.
        downscale: integer factor ≥ 1; each side becomes floor(side / downscale), by area averages.

    Returns:
        (T · K, H, W, 3) uint8: all videos at the first frame, then all at the next.

    Raises:
        DevrfError: a video is damaged, or they do not fit into memory.
    """
    start, (width, height) = time.perf_counter(), videos.size
    size = reduced_size(width, height, downscale, videos.paths[0])
    shape = (len(frames), len(wanted), size[1], size[0], 3)
    what = f"{len(frames)} frames of {len(wanted)} videos at {size[0]}x{size[1]} px"
    check_memory(int(np.prod(shape, dtype=object)), videos.paths[0].parent, what)
    pixels, row = np.empty(shape, dtype=np.uint8), {frame: t for t, frame in enumerate(frames)}

    def fill(column: int) -> None:
        path = videos.paths[wanted[column]]
        for frame, picture in chosen(path, frames):
            if picture.shape[:2] != (height, width):
                raise scene_error(
                    path, f"frame {frame} is not of {width}x{height} px; convert the video"
                )
            pixels[row[frame], column] = (
                picture if downscale == 1 else shrink_pixels(picture, *size)
            )

    with ThreadPoolExecutor(workers(width, height)) as pool:
        for _ in pool.map(fill, range(len(wanted))):
            pass
    log.info("read %s from %s in %.1f s", what, videos.paths[0].parent, time.perf_counter() - start)
    return torch.from_numpy(pixels.reshape(-1, *shape[2:]))
