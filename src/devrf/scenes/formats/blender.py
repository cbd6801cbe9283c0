"""Inward-facing scenes on disk: DeVRF's folders, and D-NeRF's or NeRF-synthetic's single folder."""

from __future__ import annotations

import logging
import os
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

from pydantic.dataclasses import dataclass

from devrf.errors import DevrfError
from devrf.scenes.files import existing_folder
from devrf.scenes.flow_files import FlowDirection, stacked_flow
from devrf.scenes.image_folders import Downscale
from devrf.scenes.layout import Layout, Pair, one_capture, static_alone, two_captures
from devrf.scenes.reader import FlowSource, InwardReader, Time
from devrf.scenes.scene import OpticalFlow, Views
from devrf.scenes.splits import (
    Split,
    are_fixed,
    check_timed_alike,
    distinct_poses,
    every_nth,
    file_sizes,
    one_moment,
)
from devrf.scenes.transforms import Transforms, TransformsFiles
from devrf.scenes.view_folders import dynamic_folder, dynamic_folders

log = logging.getLogger(__name__)

VAL = "transforms_val.json"
# The scene of D-NeRF's whose test images differ from its training images.
SCORED_ON_VAL = "lego"
# One training image in so many is held out if there are no held-out images.
HOLDOUT = 8


@dataclass(frozen=True, kw_only=True)
class BlenderReader(InwardReader):
    """Reads ``transforms_{train,test}.json`` and images.

    Two layouts: ``static/``, with ``dynamic_<V>views/`` unless the scene is static; or the JSON
    files in ``root`` itself: with times (D-NeRF) the static capture is taken from the training
    images, without them (NeRF-synthetic) the scene is static. ``transforms_val.json`` is the
    validation split, or held out if there is no ``transforms_test.json``. If no held-out image
    exists, some of the others are held out: one in :data:`HOLDOUT`, or the last of three fixed
    cameras or more.

    Attributes:
        dynamic: name of the ``dynamic_*views`` folder, if there are several.
        static_until: without a static set, the latest time of an image that counts as static.
        alpha_weighted: whether colours are weighted by their alpha when images are made smaller;
            DeVRF's authors average each channel by itself.
    """

    has_flow_files: ClassVar[bool] = True

    flow: FlowSource = "auto"  # type: ignore[assignment]
    downscale: Downscale = 1
    dynamic: str | None = None
    static_until: Time = 1.0
    alpha_weighted: bool = True

    def layout(self, folder: Path) -> Layout:
        """See :meth:`devrf.scenes.reader.LayoutReader.layout`."""
        files = TransformsFiles(folder, self.missing)
        static = folder / "static"
        if not os.path.isdir(static) and not dynamic_folders(folder):
            train, test = _train_and_test(files, folder)
            val = folder / VAL
            is_lego = Path(os.path.abspath(folder)).name == SCORED_ON_VAL
            if is_lego and not one_moment(train, test) and files.any_image(val):
                log.info("%s: scored on its val split: its test split shows another scene", folder)
                _, test = files.read(val)
                check_timed_alike(train, test)
            layout = one_capture(train, test, self.static_until)
        elif (moving := dynamic_folder(folder, self.dynamic)) is None:
            train, test = _train_and_test(files, static)
            layout = static_alone(train, test, "there is no folder dynamic_<V>views")
        else:
            static_pair = _train_and_test(files, existing_folder(static))
            layout = two_captures(static_pair, _train_and_test(files, moving))
        test_file = layout.dynamic_test.transforms.file
        val = test_file.with_name(VAL)
        if self.validation and val != test_file and files.any_image(val):
            _, validation = files.read(val)
            check_timed_alike(layout.dynamic_train.transforms, validation)
            layout = layout.with_validation(validation)
        return replace(layout, alpha_weighted=self.alpha_weighted)

    def flow_of(self, split: Split, views: Views, direction: FlowDirection) -> OpticalFlow | None:
        """See :meth:`devrf.scenes.reader.LayoutReader.flow_of`."""
        folder = split.transforms.file.with_name("train_flow")
        if split.transforms.skipped and any(folder.glob(f"*_{direction}.npz")):
            log.warning(
                "flow files in %s left out: they number images that are left out, too", folder
            )
            return None
        if any(not camera.distortion.none for camera in split.transforms.intrinsics):
            log.warning(
                "flow files in %s left out: they are for images before undistortion", folder
            )
            return None
        # The first times have no backward flow, the last ones no forward flow.
        end = split.times.min() if direction == "bwd" else split.times.max()
        rows = ((views.times - end).abs() > 1e-6).nonzero()[:, 0].tolist()
        numbers = split.index.tolist()
        files = {row: folder / f"{numbers[row]:03d}_{direction}.npz" for row in rows}
        present = {row: file for row, file in files.items() if os.path.isfile(file)}
        pattern = folder / f"NNN_{direction}.npz"
        return stacked_flow(present, len(files), pattern, file_sizes(split, views), views.cameras)


def _train_and_test(files: TransformsFiles, folder: Path) -> Pair:
    """The training and held-out images of the capture in a folder."""
    file = folder / "transforms_train.json"
    _, train = files.read(file)
    listings = (folder / "transforms_test.json", folder / VAL)
    held_out = next(filter(files.any_image, listings), None)
    parts = None if held_out else _held_out_of(train)
    if parts is None:
        if held_out is None:
            raise DevrfError(
                f"{listings[0]}: no image of it is there, and {file.name} has too few cameras to "
                "hold one out (one image, or one or two fixed cameras); list the images to score "
                "there, or copy that file to score what is learned from"
            )
        _, tested = files.read(held_out)
        check_timed_alike(train, tested)
        return train, tested
    learned, scored = parts
    log.warning(
        "%s: no image of it is there; %d of the %d of %s are held out in their place",
        listings[0],
        len(scored),
        len(train.images),
        file.name,
    )
    # Flow files are numbered by the images of the whole list.
    return replace(train[learned], skipped=train.skipped + len(scored)), train[scored]


def _held_out_of(train: Transforms) -> tuple[list[int], list[int]] | None:
    """Positions of training and held-out images: the last of three fixed cameras, or some."""
    camera = distinct_poses(train.poses)
    if not are_fixed(camera):
        return every_nth(len(camera), HOLDOUT) if len(camera) > 1 else None
    last = camera == camera.max()
    parts = ((~last).nonzero()[:, 0].tolist(), last.nonzero()[:, 0].tolist())
    return parts if int(camera.max()) >= 2 else None
