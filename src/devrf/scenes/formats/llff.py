"""Forward-facing scenes on disk: LLFF's folder alone, and DeVRF's with folders of fixed views."""

from __future__ import annotations

import logging
import os
from dataclasses import KW_ONLY, replace
from pathlib import Path

from pydantic.dataclasses import dataclass

from devrf.scenes.files import Positive, existing_folder, scene_folder
from devrf.scenes.flow_files import FlowDirection, stacked_flow
from devrf.scenes.formats.llff_poses import (
    POSES,
    PRECOMPUTED,
    PosedSet,
    read_dynamic_poses,
    read_precomputed_poses,
    read_static_poses,
)
from devrf.scenes.image_folders import folder_size, image_folder, listed_images
from devrf.scenes.layout import Layout, fewer, load_layout, static_alone, without_static_set
from devrf.scenes.names import in_order
from devrf.scenes.reader import FixedViewsReader, Time
from devrf.scenes.scene import OpticalFlow, Scene, Views
from devrf.scenes.space import forward_facing_scene
from devrf.scenes.splits import (
    Split,
    at_rest,
    at_times,
    evenly_spread,
    every_nth,
    file_sizes,
    in_motion,
)
from devrf.scenes.transforms import Transforms
from devrf.scenes.validation import scene_error
from devrf.scenes.view_folders import (
    ViewFolder,
    chosen_dynamic,
    dynamic_folders,
    fixed_views,
    flow_files,
    held_out_view,
    view_folders,
)

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class LlffReader(FixedViewsReader):
    """Reads a scene that cameras face from one side.

    Three layouts: ``static/`` and ``dynamic_<V>views/``; LLFF's ``poses_bounds.npy`` and images in
    ``root`` itself, or in ``static/`` alone: a scene at rest; or the same as a video by one camera
    (NR-NeRF's, with ``precomputed.json``), each image a time of its own, in the order of names.

    The world's unit is 0.75 of the least depth of the static cameras, their average pose its origin
    and axes (x right, y up, −z forward). The scene's space is NDC of that camera.

    Attributes:
        near: distance of the near plane from the average camera, in the world's unit; the nearest
            point of the static scene is at 1/0.75. None: 1; of a video, whose camera comes nearer,
            :meth:`~devrf.scenes.formats.llff_poses.PosedSet.near_plane`.
        monocular: whether LLFF's images are a video; None: where NR-NeRF's ``precomputed.json`` is.
        static_until: in a video, the latest time of an image that counts as static.
    """

    _: KW_ONLY
    near: Positive | None = None
    monocular: bool | None = None
    static_until: Time = 1.0

    def read(self) -> Scene:
        """See :meth:`devrf.scenes.reader.SceneReader.read`."""
        folder = scene_folder(self.root)
        layout, downscale, views, near = self._layout(folder)
        layout, thinned = fewer(layout, self.train_views, self.frames)
        smaller = views[0].downscale if views else None
        static, dynamic = load_layout(layout, folder, downscale, dynamic_downscale=smaller)
        if views and self.wants_flow_files and thinned:
            log.info("flow files dropped: data.frames=%s leaves out neighbours", self.frames)
        elif views and self.wants_flow_files:
            flow = _flow(dynamic.train, layout.dynamic_train, views, "bwd")
            dynamic = replace(dynamic, train=replace(dynamic.train, flow=flow))
        name = self.name_of(folder)
        return forward_facing_scene(name, static, dynamic, self.near or near, self.background)

    def forward_flow(self, views: Views) -> OpticalFlow | None:
        """See :meth:`devrf.scenes.reader.SceneReader.forward_flow`."""
        layout, _, folders, _ = self._layout(scene_folder(self.root))
        layout, thinned = fewer(layout, self.train_views, self.frames)
        if not folders or thinned:
            return None
        return _flow(views, layout.dynamic_train, folders, "fwd")

    def _layout(self, folder: Path) -> tuple[Layout, int, list[ViewFolder], float]:
        """The splits, by what static images are made smaller, the fixed views learned from, near.

        The last is the distance of the near plane unless :attr:`near` says it.
        """
        static = static_folder(folder)
        moving = bool(dynamic_folders(folder)) or self.dynamic
        if moving and self.monocular:
            raise scene_error(
                "data.monocular", f"{folder} has fixed views, so it is no video; leave it null"
            )
        factor = self.choose_factor(folder_size(static))
        source = image_folder(static, factor)
        # The cameras of fixed views are in LLFF's own unit, and the static ones have to be, too.
        posed = _read_cameras(static, with_strays=bool(moving))
        images = _posed_images(posed, source.path)
        video = self.monocular
        if video is None:
            video = not moving and os.path.isfile(static / PRECOMPUTED)
        near = posed.near_plane() if video else 1.0
        if video:
            return self._video(images), source.downscale, [], near
        train, test = (images[part] for part in every_nth(len(images.images), self.holdout, 0))
        if not moving:
            return static_alone(train, test, "there are no times"), source.downscale, [], near
        folder = chosen_dynamic(folder, self.dynamic)
        views = view_folders(folder, factor)
        cameras = read_dynamic_poses(folder)
        count = len(views)
        if len(cameras) < count:
            raise scene_error(
                cameras.file,
                f"has {len(cameras)} cameras, but there are {count} folders view1 …; add some",
            )
        unseen = held_out_view(count, self.test_view)
        moving_train, moving_test = fixed_views(
            views, cameras.file, cameras.poses[-count:], cameras.intrinsics[-count:], unseen
        )
        layout = Layout(
            static_train=at_rest(train),
            static_test=at_rest(test),
            dynamic_train=moving_train,
            dynamic_test=moving_test,
        )
        return layout, source.downscale, views[:unseen] + views[unseen + 1 :], near

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
    """Where the static cameras and images are: ``static/`` or ``root`` itself; else DevrfError."""
    static = root / "static"
    here = (root / POSES, root / PRECOMPUTED)
    if not os.path.isdir(static) and any(map(os.path.isfile, here)) and not dynamic_folders(root):
        return root
    return existing_folder(static)


def _read_cameras(folder: Path, *, with_strays: bool) -> PosedSet:
    """The cameras of ``poses_bounds.npy``, or NR-NeRF's file, normalised."""
    alone = os.path.isfile(folder / PRECOMPUTED) and not os.path.isfile(folder / POSES)
    read = read_precomputed_poses if alone else read_static_poses
    return read(folder).normalised(with_strays=with_strays)


def _posed_images(posed: PosedSet, source: Path) -> Transforms:
    """All images in ``source`` with their cameras."""
    images = listed_images(source, by_characters=True)
    if len(images) != len(posed):
        raise scene_error(
            posed.file,
            f"has {len(posed)} cameras, but {source} has {len(images)} images; remove some",
        )
    if len(images) < 2:
        raise scene_error(source, "holds one image, expected at least one more to hold out")
    return Transforms(posed.file, posed.intrinsics, tuple(images), posed.poses.float(), None)


def _flow(
    views: Views, split: Split, folders: list[ViewFolder], direction: FlowDirection
) -> OpticalFlow | None:
    """The flow in the folders of the first views, as many as the split has."""
    folders = folders[: int(views.view.max()) + 1]
    files = flow_files(folders, direction)
    if not files:
        where = folders[0].flow
        log.info("no optical flow: no <frame>_%s.npz in %s and its like", direction, where)
        return None
    rows = {frame * len(folders) + view: path for (view, frame), path in sorted(files.items())}
    return stacked_flow(rows, file_sizes(split, views), views.cameras)
