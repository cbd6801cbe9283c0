"""Inward-facing scenes on disk: DeVRF's folders, and D-NeRF's or NeRF-synthetic's single folder."""

from __future__ import annotations

import logging
import os
from dataclasses import KW_ONLY, replace
from pathlib import Path

from pydantic.dataclasses import dataclass

from devrf.geometry.offset import Offset
from devrf.scenes.files import existing_folder, scene_folder
from devrf.scenes.flow_files import FlowDirection, read_flow
from devrf.scenes.layout import Layout, fewer, load_layout, one_capture, static_alone
from devrf.scenes.names import Missing
from devrf.scenes.reader import InwardReader, Time
from devrf.scenes.scene import OpticalFlow, Scene, Views
from devrf.scenes.splits import (
    at_rest,
    check_timed_alike,
    distinct_poses,
    every_nth,
    file_sizes,
    in_motion,
    stand_still,
)
from devrf.scenes.transforms import Transforms, any_image, read_transforms
from devrf.scenes.view_folders import chosen_dynamic, dynamic_folders
from devrf.system.options import Count

log = logging.getLogger(__name__)

# The scene of D-NeRF's whose test images show it otherwise than those that are learned from.
SCORED_ON_VAL = "lego"
# One training image in so many is held out where no held-out image is there.
HOLDOUT = 8


@dataclass(frozen=True)
class BlenderReader(InwardReader):
    """Reads ``transforms_{train,test}.json`` and images.

    Two layouts: ``static/``, next to ``dynamic_<V>views/`` unless the scene is at rest; or the
    JSON files in ``root`` itself: with times (D-NeRF) the static capture is taken from the training
    images, without them (NeRF-synthetic) the scene is at rest. Without ``transforms_test.json``
    ``transforms_val.json`` is held out; beside it, it is the validation split. Where none of the
    held-out images is there, some of the others are held out: one in :data:`HOLDOUT`, or the last
    of three fixed cameras or more.

    Attributes:
        dynamic: which ``dynamic_*views`` folder, where there are several.
        train_views: train on the first so many dynamic views; None: all.
        static_until: without a static set, the latest time of an image that counts as static.
        alpha_weighted: whether colours are weighted by their alpha where images are made smaller;
            DeVRF's authors average each channel by itself.
    """

    _: KW_ONLY
    dynamic: str | None = None
    train_views: Count | None = None
    static_until: Time = 1.0
    alpha_weighted: bool = True

    def read(self) -> Scene:
        """See :meth:`devrf.scenes.reader.SceneReader.read`."""
        folder = scene_folder(self.root)
        layout, thinned, flow_folder = self._layout(folder)
        factor = self.choose_factor(layout.size_at)
        static, dynamic = load_layout(layout, folder, factor, alpha_weighted=self.alpha_weighted)
        if layout.moves and self.wants_flow_files:
            flow = self._flow(dynamic.train, layout, thinned, flow_folder, "bwd")
            dynamic = replace(dynamic, train=replace(dynamic.train, flow=flow))
        return self.scene(folder, static, dynamic, layout.offset)

    def forward_flow(self, views: Views) -> OpticalFlow | None:
        """See :meth:`devrf.scenes.reader.SceneReader.forward_flow`."""
        layout, thinned, flow_folder = self._layout(scene_folder(self.root))
        return self._flow(views, layout, thinned, flow_folder, "fwd") if layout.moves else None

    def _layout(self, root: Path) -> tuple[Layout, bool, Path]:
        """The splits, whether times were left out, and the folder where flow files would lie."""
        static = root / "static"
        flow_folder = root / "train_flow"
        if not os.path.isdir(static) and not dynamic_folders(root):
            train, test = _train_and_test(root, root, self.missing)
            layout = one_capture(train, test, self.static_until)
            val = root / "transforms_val.json"
            if layout.moves and root.name == SCORED_ON_VAL and os.path.isfile(val):
                log.info("%s: scored on its val split: its test split shows another scene", root)
                _, test = read_transforms(val, root, missing=self.missing, offset=train.offset)
                check_timed_alike(train, test)
                layout = one_capture(train, test, self.static_until)
        elif self.dynamic is None and not dynamic_folders(root):
            train, test = _train_and_test(static, root, self.missing)
            layout = static_alone(train, test, "there is no folder dynamic_<V>views")
        else:
            moving = chosen_dynamic(root, self.dynamic)
            train, test = _train_and_test(existing_folder(static), root, self.missing)
            moving_train, moving_test = _train_and_test(moving, root, self.missing, train.offset)
            layout = Layout(
                static_train=at_rest(train),
                static_test=at_rest(test),
                dynamic_train=in_motion(moving_train),
                dynamic_test=in_motion(moving_test),
            )
            flow_folder = moving / "train_flow"
        test_file = layout.dynamic_test.transforms.file
        val = test_file.with_name("transforms_val.json")
        if self.validation and val != test_file and os.path.isfile(val):
            _, validation = read_transforms(val, root, missing=self.missing, offset=layout.offset)
            check_timed_alike(layout.dynamic_train.transforms, validation)
            layout = layout.with_validation(validation)
        return *fewer(layout, self.train_views, self.frames), flow_folder

    def _flow(
        self, views: Views, layout: Layout, thinned: bool, folder: Path, direction: FlowDirection
    ) -> OpticalFlow | None:
        """The flow files of the dynamic training views, if they are of these images."""
        split = layout.dynamic_train
        if thinned:
            log.info("flow files dropped: data.frames=%s leaves out neighbours", self.frames)
            return None
        if split.transforms.skipped:
            log.info("flow files dropped: they are numbered by images of which some are left out")
            return None
        if any(not known.distortion.none for known in split.transforms.intrinsics):
            log.warning("flow files in %s left out: they are of images before undistortion", folder)
            return None
        first = split.times.min()
        last = split.times.max()
        expected = views.times > first + 1e-6 if direction == "bwd" else views.times < last - 1e-6
        return read_flow(
            folder,
            split.index.tolist(),
            expected.tolist(),
            file_sizes(split, views),
            views.cameras,
            direction,
        )


def _train_and_test(
    folder: Path, root: Path, missing: Missing, offset: Offset | None = None
) -> tuple[Transforms, Transforms]:
    """The images of a capture to learn from, and those held out; ``offset``: another capture's."""
    file = folder / "transforms_train.json"
    _, train = read_transforms(file, root, missing=missing, offset=offset)
    test, val = (folder / f"transforms_{split}.json" for split in ("test", "val"))
    held_out = next((listing for listing in (test, val) if any_image(listing, root)), None)
    parts = None if held_out else _held_out_of(train)
    if parts is None:
        _, tested = read_transforms(held_out or test, root, missing=missing, offset=train.offset)
        check_timed_alike(train, tested)
        return train, tested
    learned, scored = parts
    log.warning(
        "%s: no image of it is there; %d of the %d of %s are held out in their place",
        test,
        len(scored),
        len(train.images),
        file.name,
    )
    # Flow files are numbered by the images of the whole list.
    return replace(train[learned], skipped=train.skipped + len(scored)), train[scored]


def _held_out_of(train: Transforms) -> tuple[list[int], list[int]] | None:
    """Positions to learn from and to hold out: the last of three fixed cameras or more, or some."""
    camera = distinct_poses(train.poses)
    if not stand_still(camera):
        return every_nth(len(camera), HOLDOUT) if len(camera) > 1 else None
    last = camera == camera.max()
    parts = ((~last).nonzero()[:, 0].tolist(), last.nonzero()[:, 0].tolist())
    return parts if int(camera.max()) >= 2 else None
