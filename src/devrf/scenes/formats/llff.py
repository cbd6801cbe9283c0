"""Forward-facing scenes on disk: LLFF's folder alone, and DeVRF's with folders of fixed views."""

from __future__ import annotations

import logging
import os
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

from pydantic.dataclasses import dataclass

from devrf.scenes.files import Positive, existing_folder
from devrf.scenes.flow_files import FlowDirection
from devrf.scenes.formats.llff_poses import (
    POSES,
    PRECOMPUTED,
    PosedSet,
    read_dynamic_poses,
    read_precomputed_poses,
    read_static_poses,
)
from devrf.scenes.formats.llff_world import in_static_world
from devrf.scenes.image_folders import ImageFolder, folder_size, image_folder, listed_images
from devrf.scenes.layout import Layout, static_alone, without_static_set
from devrf.scenes.names import in_order
from devrf.scenes.reader import FixedViewsReader, FlowSource, Time
from devrf.scenes.scene import Capture, OpticalFlow, Scene, Views
from devrf.scenes.space import forward_facing_scene
from devrf.scenes.splits import Split, at_times, evenly_spread, every_nth, in_motion, parted
from devrf.scenes.transforms import SceneBounds, Transforms
from devrf.scenes.validation import scene_error
from devrf.scenes.view_folders import (
    dynamic_folder,
    dynamic_folders,
    flow_of_views,
    held_out_view,
    view_folders,
    with_fixed_views,
)

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class LlffReader(FixedViewsReader):
    """Reads a forward-facing scene.

    Three layouts: ``static/`` and ``dynamic_<V>views/``; LLFF's ``poses_bounds.npy`` and images in
    ``root`` itself, or in ``static/`` alone: a static scene; or the same as a video by one camera
    (NR-NeRF's, with ``precomputed.json``), each image with its own time, in the order of names.

    The world's unit is 0.75 of the least depth of the static cameras, their average pose its origin
    and axes (x right, y up, −z forward). The scene's space is NDC of that camera.

    Attributes:
        near: distance of the near plane from the average camera, in the world's unit; the nearest
            point of the static scene is at 1/0.75. None: 1; for a video, whose camera comes nearer,
            :meth:`~devrf.scenes.formats.llff_poses.PosedSet.near_plane`.
        monocular: whether LLFF's images are a video; None: if there is a ``precomputed.json``.
        static_until: in a video, the latest time of an image that counts as static.
    """

    has_flow_files: ClassVar[bool] = True

    flow: FlowSource = "auto"  # type: ignore[assignment]
    near: Positive | None = None
    monocular: bool | None = None
    static_until: Time = 1.0

    def layout(self, folder: Path) -> Layout:
        """See :meth:`devrf.scenes.reader.LayoutReader.layout`."""
        static = static_folder(folder)
        moving = dynamic_folder(folder, self.dynamic)
        if moving and self.monocular:
            raise scene_error(
                "data.monocular", f"{folder} has fixed views, so it is no video; leave it null"
            )
        factor = self.choose_factor(folder_size(static))
        # The cameras of fixed views may have LLFF's own unit: then the static ones need it, too.
        alone = os.path.isfile(static / PRECOMPUTED) and not os.path.isfile(static / POSES)
        read = read_precomputed_poses if alone else read_static_poses
        stated = read(static)
        posed = stated.normalised(with_strays=moving is not None)
        images = _posed_images(posed, image_folder(static, factor))
        video = self.monocular
        if video is None:
            video = moving is None and os.path.isfile(static / PRECOMPUTED)
        if video:
            near = SceneBounds(space="ndc", near=posed.near_plane())
            return self._video(replace(images, bounds=near))
        parts = parted(range(len(posed)), (), self.holdout, posed.file, start=0)
        train, test = (images[part] for part in parts)
        if moving is None:
            return static_alone(train, test, "there are no times")
        views = view_folders(moving, factor)
        cameras = read_dynamic_poses(moving)
        count = len(views)
        if len(cameras) < count:
            raise scene_error(
                cameras.file,
                f"has {len(cameras)} cameras, but there are {count} folders view1 …; add some",
            )
        return with_fixed_views(
            (train, test),
            views,
            posed_by=cameras.file,
            poses=in_static_world(cameras, count, stated, posed),
            lenses=cameras.intrinsics[-count:],
            test=held_out_view(count, self.test_view),
        )

    def placed(self, layout: Layout, static: Capture, dynamic: Capture) -> Scene:
        """See :meth:`devrf.scenes.reader.LayoutReader.placed`."""
        near = self.near or (layout.bounds and layout.bounds.near) or 1.0
        return forward_facing_scene(self.scene_name, static, dynamic, near, self.background)

    def flow_of(self, split: Split, views: Views, direction: FlowDirection) -> OpticalFlow | None:
        """See :meth:`devrf.scenes.reader.LayoutReader.flow_of`."""
        return flow_of_views(split, views, direction) if split.fixed else None

    def _video(self, images: Transforms) -> Layout:
        """The splits of images by one moving camera, in the order of their times."""
        count = len(images.images)
        if count < 3:
            raise scene_error(images.file, f"a video of {count} images; expected at least 3")
        order = in_order(
            range(count), name=lambda k: images.images[k].name, where=images.images[0].parent
        )
        timed = replace(images[order], times=tuple(k / (count - 1) for k in range(count)))
        train, test = (in_motion(timed[part]) for part in every_nth(count, self.holdout))
        times = None if self.frames is None else evenly_spread(train.times, self.frames)
        # The static set of a video is thinned out, too.
        train = train if times is None else at_times(train, times)
        return without_static_set(train, test, self.static_until)


def static_folder(root: Path) -> Path:
    """The folder of static cameras and images: ``static/`` or ``root`` itself; else DevrfError."""
    static = root / "static"
    here = (root / POSES, root / PRECOMPUTED)
    if not os.path.isdir(static) and any(map(os.path.isfile, here)) and not dynamic_folders(root):
        return root
    return existing_folder(static)


def _posed_images(posed: PosedSet, source: ImageFolder) -> Transforms:
    """All images in ``source`` with their cameras."""
    images = tuple(listed_images(source.path, by_characters=True))
    if len(images) != len(posed):
        raise scene_error(
            posed.file,
            f"has {len(posed)} cameras, but {source.path} has {len(images)} images; remove some",
        )
    poses = posed.poses.float()
    by = source.downscale
    return Transforms(posed.file, posed.intrinsics, images, poses, None, downscale=by)
