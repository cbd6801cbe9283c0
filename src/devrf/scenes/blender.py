"""Inward-facing scenes on disk: DeVRF's static + dynamic folders, and D-NeRF's single folder."""

from __future__ import annotations

import logging
import os
from dataclasses import KW_ONLY, replace
from pathlib import Path

from pydantic.dataclasses import dataclass

from devrf.scenes.capture_folders import chosen_dynamic, dynamic_folders
from devrf.scenes.flow_files import read_flow
from devrf.scenes.image_files import image_size
from devrf.scenes.layout import Layout, fewer, load_layout, without_static_set
from devrf.scenes.paths import existing_folder, scene_folder
from devrf.scenes.reader import Count, InwardReader, Time
from devrf.scenes.scene import Scene, Views
from devrf.scenes.splits import Split, at_rest, in_motion
from devrf.scenes.transforms import read_transforms
from devrf.scenes.validation import scene_error

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class BlenderReader(InwardReader):
    """Reads ``transforms_{train,test}.json`` and images.

    Two layouts: ``static/`` next to ``dynamic_<V>views/``, or (D-NeRF) the JSON files in
    ``root`` itself, where the static capture is taken from the training images.

    Attributes:
        dynamic: which ``dynamic_*views`` folder, where there are several.
        train_views: train on the first so many dynamic views; None: all.
        static_until: without a static set, the latest time of an image that counts as static.
    """

    _: KW_ONLY
    dynamic: str | None = None
    train_views: Count | None = None
    static_until: Time = 1.0

    def read(self) -> Scene:
        """See :meth:`devrf.scenes.reader.SceneReader.read`."""
        folder = scene_folder(self.root)
        layout, flow_folder = _layout(folder, self.dynamic, self.static_until)
        layout, thinned = fewer(layout, self.train_views, self.frames)
        static, dynamic = load_layout(layout, folder, self.downscale)
        if self.wants_flow_files and thinned:
            log.info("flow files dropped: data.frames=%s leaves out neighbours", self.frames)
        elif self.wants_flow_files:
            train = _with_flow(dynamic.train, layout.dynamic_train, flow_folder)
            dynamic = replace(dynamic, train=train)
        return self.scene(folder, static, dynamic)


def _layout(root: Path, dynamic: str | None, static_until: float) -> tuple[Layout, Path]:
    """The splits, and the folder where flow files would lie."""
    static = root / "static"
    if not os.path.isdir(static) and not dynamic_folders(root):
        if not os.path.isfile(root / "transforms_train.json"):
            raise scene_error(
                root,
                "expected static/ and dynamic_<V>views/, or transforms_train.json; "
                "set data.root to the scene's folder",
            )
        train = in_motion(read_transforms(root / "transforms_train.json", root))
        test = in_motion(read_transforms(root / "transforms_test.json", root))
        return without_static_set(train, test, static_until), root / "train_flow"
    existing_folder(static)
    moving = chosen_dynamic(root, dynamic)
    at_rest_train, at_rest_test, moving_train, moving_test = (
        read_transforms(capture / f"transforms_{split}.json", root)
        for capture in (static, moving)
        for split in ("train", "test")
    )
    layout = Layout(
        at_rest(at_rest_train),
        at_rest(at_rest_test),
        in_motion(moving_train),
        in_motion(moving_test),
    )
    return layout, moving / "train_flow"


def _with_flow(views: Views, split: Split, folder: Path) -> Views:
    first = split.times.min()
    if any(not known.distortion.none for known in split.transforms.intrinsics):
        log.warning("flow files in %s left out: they are of images before undistortion", folder)
        return views
    used = int(split.index[0])
    flow = read_flow(
        folder,
        split.index.tolist(),
        (views.times > first + 1e-6).tolist(),
        image_size(split.transforms.images[used], split.transforms.intrinsics[used].size),
        (views.width, views.height),
    )
    return replace(views, flow=flow)
