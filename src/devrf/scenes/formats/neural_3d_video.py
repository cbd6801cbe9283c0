"""Scenes of Neural 3D Video: synchronised videos by cameras that face a scene from one side."""

from __future__ import annotations

import logging
import math
import os
import re
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pydantic
import torch
from torch import Tensor

from devrf.scenes.files import Positive, entries, scene_folder
from devrf.scenes.footage import VIDEOS, FootageHeader, Size, footage_header, frames_at, is_folder
from devrf.scenes.formats.llff_poses import PosedSet, read_static_poses
from devrf.scenes.image_folders import shot_together
from devrf.scenes.images import in_threads
from devrf.scenes.names import in_order
from devrf.scenes.reader import SceneReader
from devrf.scenes.resampling import shrink_pixels
from devrf.scenes.scene import Capture, Scene, Views
from devrf.scenes.space import earliest, forward_facing_scene
from devrf.scenes.splits import pinholes
from devrf.scenes.validation import check_memory, reduced_size, scene_error
from devrf.system.options import Count, Several, Whole

log = logging.getLogger(__name__)

# A video, or a folder.
_NAME = re.compile(rf"cam(\d{{1,6}})({'|'.join(map(re.escape, VIDEOS))})?", re.IGNORECASE)


@dataclass(frozen=True)
class CameraVideos:
    """Videos, or their frames as folders of images, of one length and one size.

    Attributes:
        names: V names, in their order, of the files or folders.
        numbers: V numbers in these names.
        paths: V files, or folders of images.
        header: the stated properties of each.
    """

    names: tuple[str, ...]
    numbers: tuple[int, ...]
    paths: tuple[Path, ...]
    header: FootageHeader


def camera_videos(folder: Path) -> CameraVideos:
    """The videos in a folder, or folders of their frames; no frames of videos are read yet.

    If there are both of one number, the video is read: the folder may hold fewer, or smaller,
    frames. DevrfError if they are fewer than two, one cannot be read, or they differ in length or
    size.
    """
    paths = [
        path
        for path in entries(folder)
        if _NAME.fullmatch(path.name)
        and (os.path.isfile(path) if path.suffix.lower() in VIDEOS else os.path.isdir(path))
    ]
    ordered = in_order(paths, name=lambda path: path.name, where=folder, by_characters=True)
    named = {path: int(path.stem[len("cam") :]) for path in ordered}
    filmed = {number for path, number in named.items() if path.suffix}
    numbers = {p: number for p, number in named.items() if p.suffix or number not in filmed}
    times = Counter(numbers.values())
    twice = [path for path, number in numbers.items() if times[number] > 1]
    if twice:
        raise scene_error(twice[1], f"has the number of {twice[0].name}, too; remove one of them")
    if len(numbers) < 2:
        raise scene_error(
            folder,
            f"{len(numbers)} videos cam00.mp4, cam01.mp4, …, or folders cam00, cam01, … of their "
            "frames, expected 2 or more; set data.root",
        )
    paths = [path / "images" if os.path.isdir(path / "images") else path for path in numbers]
    headers = [footage_header(path) for path in paths]
    header = headers[0]
    for path, other in zip(paths, headers, strict=True):
        if other != header or other.frames < 2:
            raise scene_error(
                path,
                f"{_in_words(other)}, but {paths[0].relative_to(folder)} has {_in_words(header)}; "
                "cut or convert it",
            )
    shot_together([path for path in paths if is_folder(path)])  # warns of images of other numbers
    names = tuple(path.name for path in numbers)
    return CameraVideos(names, tuple(numbers.values()), tuple(paths), header)


def _in_words(header: FootageHeader) -> str:
    return f"{header.frames} frames of {header.size[0]}x{header.size[1]} px"


def read_frames(paths: Sequence[Path], frames: Sequence[int], size: Size, downscale: int) -> Tensor:
    """The ``frames`` (T, ascending) of K videos; other frames are not kept in memory.

    ``size`` is their (width, height); sides become floor(side / ``downscale``), by area averages.

    Returns:
        (T · K, H, W, 3) uint8: all videos at the first frame, then all at the next.

    Raises:
        DevrfError: a video is damaged, or they do not fit into memory.
    """
    start = time.perf_counter()
    folder = paths[0].parent
    width, height = reduced_size(*size, downscale, paths[0])
    shape = (len(frames), len(paths), height, width, 3)
    what = f"{len(frames)} frames of {len(paths)} videos at {width}x{height} px"
    check_memory(math.prod(shape), folder, what)
    pixels = np.empty(shape, dtype=np.uint8)

    def fill(column: int) -> None:
        for row, (frame, picture) in enumerate(frames_at(paths[column], frames)):
            if picture.shape[1::-1] != size:
                raise scene_error(
                    paths[column],
                    f"frame {frame} is not of {size[0]}x{size[1]} px; convert the video",
                )
            if downscale != 1:
                picture = shrink_pixels(picture, width, height)
            pixels[row, column] = picture

    in_threads(fill, range(len(paths)), size)
    log.info("read %s from %s in %.1f s", what, folder, time.perf_counter() - start)
    return torch.from_numpy(pixels.reshape(-1, *shape[2:]))


@pydantic.dataclasses.dataclass(frozen=True, kw_only=True)
class Neural3DVideoReader(SceneReader):
    """Reads ``poses_bounds.npy`` and ``cam00.mp4``, ``cam01.mp4`` … of one length.

    A folder of frames, ``cam00/`` or ``cam00/images/``, may replace a video.

    Row k of the poses is the camera of the k-th video in the order of names: numbers may be left
    out. No camera moves. The static set is the first frame of every camera, the dynamic set all
    frames that are read. World, near plane and space are those of LLFF's scenes
    (:class:`devrf.scenes.formats.llff.LlffReader`).

    Attributes:
        test_view: the number in the name of the video to hold out: 0 is ``cam00.mp4``.
        length: read only so many first frames of each video; None: all.
        frames: keep so many of them, evenly spread, first and last included; None: all.
        near: distance of the near plane from the average camera, in the world's unit; the
            nearest point of the scene is at 1/0.75.
        train_views: train on the first so many of the cameras that are not held out; None: all.
    """

    test_view: Whole = 0
    near: Positive = 1.0
    train_views: Count | None = None
    length: Several | None = None
    frames: Several | None = 50

    def read(self) -> Scene:
        """See :meth:`devrf.scenes.reader.SceneReader.read`."""
        folder = scene_folder(self.root)
        posed = read_static_poses(folder)
        videos = camera_videos(folder)
        if len(posed) != len(videos.paths):
            raise scene_error(
                posed.file,
                f"has {len(posed)} cameras, but there are {len(videos.paths)} videos; remove some",
            )
        posed = posed.normalised(with_strays=False)
        test, train = self._split(videos)
        frames, times = self._moments(videos)
        width, height = videos.header.size
        factor = self.choose_factor(lambda factor: (width // factor, height // factor))
        moving = Capture(
            train=_views(videos, posed, train, frames, times, factor),
            test=_views(videos, posed, [test], frames, times, factor),
        )
        static = moving.mapped(earliest)
        return forward_facing_scene(self.scene_name, static, moving, self.near, self.background)

    def _split(self, videos: CameraVideos) -> tuple[int, list[int]]:
        """Positions of the held-out video and of the training videos."""
        if self.test_view not in videos.numbers:
            raise scene_error(
                "data.test_view",
                f"{self.test_view} is the number of none of the videos "
                f"({', '.join(videos.names)}); give one of them",
            )
        test = videos.numbers.index(self.test_view)
        train = [k for k in range(len(videos.paths)) if k != test]
        if self.train_views is not None and self.train_views > len(train):
            raise scene_error(
                "data.train_views",
                f"there are {len(train)} videos next to the held-out one; ask for fewer",
            )
        return test, train[: self.train_views]

    def _moments(self, videos: CameraVideos) -> tuple[list[int], Tensor]:
        """The frames that are read, ascending, and their times in [0, 1]."""
        recorded = videos.header.frames
        total = recorded if self.length is None else self.length
        if total > recorded:
            raise scene_error(
                "data.length", f"{total} is more than the {recorded} frames of a video"
            )
        count = total if self.frames is None else min(self.frames, total)
        frames = torch.linspace(0, total - 1, count, dtype=torch.float64).round().long()
        return frames.tolist(), (frames / (total - 1)).float()


def _views(
    videos: CameraVideos,
    posed: PosedSet,
    cameras: list[int],
    frames: list[int],
    times: Tensor,
    factor: int,
) -> Views:
    """The images of ``cameras`` at the first frame, then all at the next."""
    paths = [videos.paths[video] for video in cameras]
    pixels = read_frames(paths, frames, videos.header.size, factor)
    height, width = pixels.shape[1:3]
    view = torch.arange(len(cameras)).repeat(len(frames))
    lenses = [posed.intrinsics[video].lens(width, height, posed.file) for video in cameras]
    return Views(
        pixels,
        pinholes(posed.poses[cameras], lenses, [(width, height)] * len(cameras))[view],
        times.repeat_interleave(len(cameras)),
        view,
        tuple(f"{videos.names[video]} frame {frame}" for frame in frames for video in cameras),
    )
