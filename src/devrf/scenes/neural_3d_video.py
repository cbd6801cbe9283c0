"""Scenes of Neural 3D Video: synchronised videos by cameras that face a scene from one side."""

from __future__ import annotations

import logging
from dataclasses import KW_ONLY
from typing import Annotated

import torch
from pydantic import Field
from pydantic.dataclasses import dataclass
from torch import Tensor

from devrf.scenes.camera_videos import CameraVideos, camera_videos, read_frames
from devrf.scenes.downscale import Downscale, whole_factor
from devrf.scenes.json_files import Positive
from devrf.scenes.llff_poses import PosedSet, read_static_poses
from devrf.scenes.one_sided import one_sided_scene
from devrf.scenes.paths import scene_folder
from devrf.scenes.reader import Count, EstimatedFlow, SceneReader, SeveralFrames
from devrf.scenes.scene import Capture, Scene, Views
from devrf.scenes.validation import scene_error

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Neural3DVideoReader(SceneReader):
    """Reads ``poses_bounds.npy`` and ``cam00.mp4``, ``cam01.mp4`` … of one length.

    Row k of the poses is the camera of the k-th video in the order of names: numbers may be left
    out. No camera moves. The static set is the first frame of every camera, the dynamic set the
    chosen frames. World, near plane and space are those of LLFF's scenes
    (:class:`devrf.scenes.llff.LlffReader`).

    Attributes:
        test_view: the number in the name of the video to hold out: 0 is ``cam00.mp4``.
        length: the first so many frames of each video are the recording; None: all.
        frames: keep so many of them, evenly spread, first and last included; None: all.
        near: distance of the near plane from the average camera, in the world's unit; the
            nearest point of the scene is at 1/0.75.
        train_views: train on the first so many of the cameras that are not held out; None: all.
    """

    _: KW_ONLY
    downscale: Downscale = "up_to_4"
    flow: EstimatedFlow = "auto"
    test_view: Annotated[int, Field(strict=True, ge=0)] = 0
    near: Positive = 1.0
    train_views: Count | None = None
    length: SeveralFrames | None = None
    frames: SeveralFrames | None = 50

    def read(self) -> Scene:
        """See :meth:`devrf.scenes.reader.SceneReader.read`."""
        folder = scene_folder(self.root)
        posed, videos = read_static_poses(folder), camera_videos(folder)
        if len(posed) != len(videos.paths):
            raise scene_error(
                posed.file,
                f"has {len(posed)} cameras, but there are {len(videos.paths)} videos "
                f"{videos.paths[0].name} … {videos.paths[-1].name}; remove the videos without a "
                "camera, or write the cameras again",
            )
        posed = posed.normalised()
        test, train = self._split(videos)
        frames, times = self._moments(videos)
        factor = whole_factor(self.downscale, lambda factor: min(videos.size) // factor)
        moving = Capture(
            *(_views(videos, posed, chosen, frames, times, factor) for chosen in (train, [test]))
        )
        still = Capture(_at_rest(moving.train), _at_rest(moving.test))
        return one_sided_scene(self.name_of(folder), still, moving, self.near, self.background)

    def _split(self, videos: CameraVideos) -> tuple[int, list[int]]:
        """Positions of the held-out video and of those to learn from."""
        if self.test_view not in videos.numbers:
            names = ", ".join(path.name for path in videos.paths)
            raise scene_error(
                "data.test_view",
                f"{self.test_view} is the number of none of the videos ({names}); give one of them",
            )
        test = videos.numbers.index(self.test_view)
        train = [k for k in range(len(videos.paths)) if k != test]
        if self.train_views is not None and self.train_views > len(train):
            raise scene_error(
                "data.train_views",
                f"{self.train_views} were asked for, but there are {len(train)} videos next to "
                "the held-out one; ask for fewer",
            )
        return test, train[: self.train_views]

    def _moments(self, videos: CameraVideos) -> tuple[list[int], Tensor]:
        """The frames that are read, ascending, and their times in [0, 1]."""
        total = videos.frames if self.length is None else self.length
        if total > videos.frames:
            raise scene_error(
                "data.length", f"{total} is more than the {videos.frames} frames of each video"
            )
        count = total if self.frames is None else min(self.frames, total)
        frames = torch.linspace(0, total - 1, count, dtype=torch.float64).round().long()
        return frames.tolist(), (frames / (total - 1)).float()


def _views(
    videos: CameraVideos,
    posed: PosedSet,
    chosen: list[int],
    frames: list[int],
    times: Tensor,
    factor: int,
) -> Views:
    """All chosen videos at the first frame, then all at the next."""
    pixels = read_frames(videos, chosen, frames, factor)
    height, width = pixels.shape[1:3]
    view = torch.arange(len(chosen)).repeat(len(frames))
    return Views(
        pixels,
        posed.cameras(width, height)[torch.tensor(chosen)][view],
        times.repeat_interleave(len(chosen)),
        view,
        tuple(videos.name_of(video, frame) for frame in frames for video in chosen),
    )


def _at_rest(views: Views) -> Views:
    """The first frame of each view."""
    return views[(views.times == 0).nonzero()[:, 0]]
