"""Forward-facing scenes on disk: LLFF's folder alone, and DeVRF's with folders of fixed views."""

from __future__ import annotations

import logging
import os
from dataclasses import KW_ONLY, replace
from pathlib import Path
from typing import Annotated

import torch
from pydantic import Field
from pydantic.dataclasses import dataclass
from torch import Tensor

from devrf.geometry.clock import FrameClock
from devrf.scenes.files import Positive, existing_folder, scene_folder
from devrf.scenes.flow_files import FlowDirection, stacked_flow
from devrf.scenes.formats.llff_poses import POSES, PosedSet, read_dynamic_poses, read_static_poses
from devrf.scenes.image_folders import Downscale, folder_factor, image_folder, listed_images
from devrf.scenes.images import Size, image_size, load_images
from devrf.scenes.layout import refuse_at_rest
from devrf.scenes.reader import Count, Holdout, SceneReader, Time
from devrf.scenes.scene import Capture, OpticalFlow, Scene, Views
from devrf.scenes.space import forward_facing_scene
from devrf.scenes.splits import evenly_spread, every_nth, first_of_every
from devrf.scenes.validation import scene_error
from devrf.scenes.view_folders import (
    ViewFolder,
    chosen_dynamic,
    chosen_views,
    dynamic_folders,
    flow_files,
    view_folders,
)

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class LlffReader(SceneReader):
    """Reads a scene that cameras face from one side.

    Three layouts: ``static/`` and ``dynamic_<V>views/``; LLFF's ``poses_bounds.npy`` and images in
    ``root`` itself, or in ``static/`` alone: a scene at rest; or the same as a video by one camera
    (NR-NeRF), each image a time of its own, in the order of their names.

    The world's unit is 0.75 of the least depth of the static cameras, their average pose its
    origin and axes (x right, y up, −z forward). The scene's space is NDC of that camera. Images
    come from ``images_<downscale>`` where it is there; else larger ones are made smaller.

    Attributes:
        dynamic: which ``dynamic_*views`` folder, where there are several.
        test_view: the fixed view to hold out: 4 is ``view4``, −1 the last, −2 the last but one.
        holdout: every ``holdout``-th static image is held out, the first one included.
        near: distance of the near plane from the average camera, in the world's unit; the
            nearest point of the static scene is at 1/0.75.
        train_views: train on the first so many of the views that are not held out; None: all.
        monocular: whether LLFF's images are a video; None: where NR-NeRF's ``precomputed.json`` is.
        static_until: of a video, the latest time of an image that counts as static.
    """

    _: KW_ONLY
    dynamic: str | None = None
    downscale: Downscale = "up_to_4"
    test_view: Annotated[int, Field(strict=True)] = -1
    holdout: Holdout = 8
    near: Positive = 1.0
    train_views: Count | None = None
    monocular: bool | None = None
    static_until: Time = 1.0

    def read(self) -> Scene:
        """See :meth:`devrf.scenes.reader.SceneReader.read`."""
        folder = scene_folder(self.root)
        static, dynamic = self._captures(folder)
        name = self.name_of(folder)
        return forward_facing_scene(name, static, dynamic, self.near, self.background)

    def forward_flow(self, views: Views) -> OpticalFlow | None:
        """See :meth:`devrf.scenes.reader.SceneReader.forward_flow`."""
        folder = scene_folder(self.root)
        if not (dynamic_folders(folder) or self.dynamic):
            return None
        moving = chosen_dynamic(folder, self.dynamic)
        folders = view_folders(moving, folder_factor(static_folder(folder), self.downscale))
        if self.frames is not None and self.frames < len(folders[0].images):
            return None
        _, train = chosen_views(moving, len(folders), self.test_view, self.train_views)
        sizes = read_dynamic_poses(moving).last(len(folders)).sizes
        return _flow(views, [folders[v] for v in train], sizes[train[0]], "fwd")

    def _captures(self, folder: Path) -> tuple[Capture, Capture]:
        """The static and the dynamic capture; of a scene at rest the same twice."""
        posed, moving = static_folder(folder), bool(dynamic_folders(folder)) or self.dynamic
        if moving and self.monocular:
            raise scene_error(
                "data.monocular", f"{folder} has fixed views, so it is no video; leave it null"
            )
        video = self.monocular
        if video is None:
            video = not moving and os.path.isfile(posed / VIDEO)
        factor = folder_factor(posed, self.downscale)
        images = _posed_images(posed, folder, factor)
        if video:
            if self.train_views is not None:
                raise scene_error(
                    posed, "data.train_views needs fixed cameras, and this one moves; leave it null"
                )
            return video_captures(images, posed, self.holdout, self.frames, self.static_until)
        static = _held_out(images, self.holdout)
        if moving:
            return static, _dynamic(self, chosen_dynamic(folder, self.dynamic), folder, factor)
        log.info("%s: no times: all images show one moment, the scene is at rest", posed)
        for key in ("train_views", "frames"):
            refuse_at_rest(posed, f"data.{key}", getattr(self, key))
        return static, static


def static_folder(root: Path) -> Path:
    """Where a scene's static cameras and images are: ``static/``, or ``root`` itself.

    Raises:
        DevrfError: neither is there.
    """
    static = root / "static"
    if not os.path.isdir(static) and os.path.isfile(root / POSES) and not dynamic_folders(root):
        return root
    return existing_folder(static)


def _posed_images(folder: Path, root: Path, downscale: int) -> Views:
    """All images of a folder, with the cameras of its ``poses_bounds.npy``, at time 0."""
    posed = read_static_poses(folder).normalised()
    source = image_folder(folder, downscale)
    images = listed_images(source.path)
    if len(images) != len(posed):
        raise scene_error(
            posed.file,
            f"has {len(posed)} cameras, but {source.path} has {len(images)} images; "
            "remove the images without a camera, or write the cameras again",
        )
    if len(images) < 2:
        raise scene_error(source.path, "holds one image, expected at least one more to hold out")
    loaded = load_images(images, source.downscale, posed.sizes)
    count, height, width = loaded.pixels.shape[:3]
    return Views(
        loaded.pixels,
        posed.cameras(width, height),
        torch.zeros(count),
        torch.arange(count),
        _names(images, root),
        ambiguous_orientation=loaded.ambiguous_orientation,
    )


def _held_out(views: Views, holdout: int) -> Capture:
    """A static capture of which one image in ``holdout`` is held out, the first included."""
    train, test = (views[torch.tensor(part)] for part in first_of_every(len(views), holdout))
    return Capture(_numbered(train), _numbered(test))


def _numbered(views: Views) -> Views:
    """Static views with their own positions as view numbers."""
    return replace(views, view=torch.arange(len(views)))


def _dynamic(options: LlffReader, folder: Path, root: Path, downscale: int) -> Capture:
    views = view_folders(folder, downscale)
    posed = read_dynamic_poses(folder)
    if len(posed) < len(views):
        raise scene_error(
            posed.file,
            f"has {len(posed)} cameras, but there are {len(views)} folders view1 … "
            f"view{len(views)}; the last rows are those of the fixed cameras",
        )
    posed = posed.last(len(views))
    test, train = chosen_views(folder, len(views), options.test_view, options.train_views)
    total, frames = len(views[0].images), options.frames
    kept = torch.arange(total)
    if frames is not None and frames < total:
        kept = torch.linspace(0, total - 1, frames).round().long()
    train_set, test_set = (
        _moving([views[v] for v in chosen], posed, chosen, kept, root) for chosen in (train, [test])
    )
    if options.wants_flow_files and len(kept) < total:
        log.info("flow files dropped: data.frames=%s leaves out neighbours", frames)
    elif options.wants_flow_files:
        flow = _flow(train_set, [views[v] for v in train], posed.sizes[train[0]], "bwd")
        train_set = replace(train_set, flow=flow)
    return Capture(train_set, test_set)


def _moving(
    folders: list[ViewFolder], posed: PosedSet, chosen: list[int], kept: Tensor, root: Path
) -> Views:
    """All views at the first frame, then all at the next, and so on."""
    images = [folder.images[k] for k in kept.tolist() for folder in folders]
    sizes = [posed.sizes[v] for v in chosen] * len(kept)
    loaded = load_images(images, folders[0].downscale, sizes)
    count, height, width = loaded.pixels.shape[:3]
    view = torch.arange(len(folders)).repeat(len(kept))
    times = kept / (len(folders[0].images) - 1)
    cameras = posed.cameras(width, height)[torch.tensor(chosen)][view]
    return Views(
        loaded.pixels,
        cameras,
        times.float().repeat_interleave(len(folders)),
        view,
        _names(images, root),
        ambiguous_orientation=loaded.ambiguous_orientation,
    )


def _flow(
    views: Views, folders: list[ViewFolder], camera: Size, direction: FlowDirection
) -> OpticalFlow | None:
    files = flow_files(folders, direction)
    if not files:
        where = folders[0].flow
        log.info("no optical flow: no <frame>_%s.npz in %s and its like", direction, where)
        return None
    rows = {frame * len(folders) + view: path for (view, frame), path in sorted(files.items())}
    source = image_size(folders[0].images[0], camera)
    return stacked_flow(rows, len(views), source, (views.width, views.height))


def _names(images: list[Path], root: Path) -> tuple[str, ...]:
    return tuple(str(image.relative_to(root)) for image in images)


# NR-NeRF's file of the cameras: where it lies, the images follow one another in time.
VIDEO = "precomputed.json"


def video_captures(
    images: Views, folder: Path, holdout: int, frames: int | None, static_until: float
) -> tuple[Capture, Capture]:
    """The static and the dynamic capture of a video.

    Args:
        images: N images in the order of their times.
        folder: where they are from, for messages.
        holdout: every ``holdout``-th is held out.
        frames: learn from so many times, evenly spread; None: from all.
        static_until: the latest time of an image that counts as static.

    Raises:
        DevrfError: fewer than three images, or none that early.
    """
    if len(images) < 3:
        raise scene_error(folder, f"a video of {len(images)} images; expected at least 3")
    timed = replace(images, times=torch.arange(len(images)) / (len(images) - 1))
    train, test = (timed[torch.tensor(part)] for part in every_nth(len(timed), holdout))
    kept = None if frames is None else evenly_spread(train.times, frames)
    if kept is not None:
        gap = (train.times[:, None] - kept).abs().amin(dim=1)
        train = train[(gap <= FrameClock.TOLERANCE).nonzero()[:, 0]]
    early, early_test = _until(train, static_until), _until(test, static_until)
    if len(early) == 0:
        raise scene_error(
            folder,
            f"no image at a time of data.static_until={static_until:g} or before to learn the "
            "static scene from; set it higher",
        )
    log.warning(
        "%s: a video by one camera, without a static set: the canonical field is learned from %d "
        "of the %d training images (times up to %g)",
        folder,
        len(early),
        len(train),
        static_until,
    )
    return Capture(early, early_test if len(early_test) else test), Capture(train, test)


def _until(views: Views, time: float) -> Views:
    """The views up to a time: all of them stay one object."""
    early = views.times <= time + FrameClock.TOLERANCE
    return views if bool(early.all()) else views[early.nonzero()[:, 0]]
