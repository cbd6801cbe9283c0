"""Scenes in nerfstudio's and instant-ngp's layout: one ``transforms.json`` for all images."""

from __future__ import annotations

import logging
import os
from dataclasses import KW_ONLY, replace
from pathlib import Path
from typing import ClassVar, Literal

import torch
from pydantic.dataclasses import dataclass
from torch import Tensor

from devrf.scenes.image_folders import Downscale
from devrf.scenes.layout import Layout, fewer, one_capture, static_alone, two_captures
from devrf.scenes.masks import Masks
from devrf.scenes.reader import EstimatedFlow, PosedReader, Time
from devrf.scenes.splits import distinct_poses, one_moment, parted
from devrf.scenes.transforms import TIME_TOLERANCE, Transforms, TransformsFiles
from devrf.scenes.validation import scene_error
from devrf.system.options import Count, Several, abbreviated

log = logging.getLogger(__name__)

FILE = "transforms.json"
# The least number of images at time 0 that make a static set.
_SEVERAL = 3


@dataclass(frozen=True)
class NerfstudioReader(PosedReader):
    """Reads ``transforms.json`` and images.

    The file may lie in ``root``, with a ``time`` in [0, 1] on every frame, or in ``root/static``
    and, with times, in ``root/dynamic``. Without times, or without ``root/dynamic``, the scene is
    static. Cameras may be fixed or move. Held-out images are those in ``test_filenames`` (else
    ``val_filenames``), else every ``holdout``-th; beside ``test_filenames``, ``val_filenames`` are
    the validation split. Images are undistorted; the world is that of the file's poses.

    A frame's ``mask_path`` is a grey image of the size of the image or of its camera, with black
    pixels left out.

    Attributes:
        train_views: train on the first so many dynamic views; None: all.
        holdout: without lists in the file, one of so many images is held out.
        times: ``file`` takes each frame's ``time``; ``order`` spreads times evenly over the images
            in the order of their names, for a video that another program posed.
        static_until: in one file, the latest time of an image that counts as static; None: 0 if
            several images have time 0, else 1.
        masks: the meaning of black pixels. ``ignore``, nerfstudio's meaning: they (people who walk
            by) count neither in training nor in scores. ``alpha``: they are background, as around
            a person who was cut out; then masks also give the bounds of scene and motion.
            ``none``: masks are not read.
        space: as of :class:`~devrf.scenes.reader.PosedReader`; a file of ``stage=capture`` states
            the value of ``auto`` itself (``scene_bounds``).
    """

    stater: ClassVar[str] = f"scene_bounds in {FILE}"

    _: KW_ONLY
    downscale: Downscale = "auto"
    flow: EstimatedFlow = "auto"
    train_views: Count | None = None
    holdout: Several = 8
    times: Literal["file", "order"] = "file"
    static_until: Time | None = None
    masks: Masks = "ignore"

    def layout(self, folder: Path) -> Layout:
        """See :meth:`devrf.scenes.reader.LayoutReader.layout`."""
        files = TransformsFiles(folder, self.missing, self.masks)
        if os.path.isfile(folder / FILE):
            train, test, validation = self._splits(files, folder / FILE)
            layout = _one_file(train, test, self.static_until)
            if layout.static_train.transforms is not layout.dynamic_train.transforms:
                validation = validation[_dynamic_images(validation)]
        else:
            static = folder / "static" / FILE
            moving = folder / "dynamic" / FILE
            train, test, validation = replace(self, times="file")._splits(files, static)
            if os.path.isfile(moving):
                static_pair = (train, test)
                train, test, validation = self._splits(files, moving)
                if train.times is None:
                    raise scene_error(
                        moving, 'its frames have no "time"; give every frame its time in [0, 1]'
                    )
                layout = two_captures(static_pair, (train, test))
            else:
                layout = static_alone(train, test, f"there is no dynamic/{FILE}")
        layout = layout.with_validation(validation)
        return fewer(layout, self.train_views, self.frames)

    def _splits(
        self, files: TransformsFiles, file: Path
    ) -> tuple[Transforms, Transforms, Transforms]:
        """The training, held-out and validation images of a file, the last if ``validation``."""
        listing, transforms = files.read(file, times_by_order=self.times == "order")
        position = {image: k for k, image in enumerate(transforms.images)}

        def listed(key: str) -> set[int]:
            """Positions of the images in a list of the file."""
            positions = set[int]()
            for name in getattr(listing, key) or ():
                image = files.find(name, file)
                if image in position:
                    positions.add(position[image])
                elif image is not None or not transforms.skipped:
                    what = f"{key} lists {abbreviated(name)}, which is in no frame; correct it"
                    raise scene_error(file, what)
            return positions

        everyone = set(range(len(transforms.images)))
        train = listed("train_filenames")
        val = listed("val_filenames")
        test = listed("test_filenames") or val
        if train or test:
            test = test or everyone - train
            train = train or everyone - val - test
        else:
            train, test = map(set, parted(sorted(everyone), (), self.holdout, file))
        if not train or not test or train & test:
            raise scene_error(
                file,
                f"{len(train)} images to learn from, {len(test)} held out, {len(train & test)} of "
                "them both; correct train_filenames, test_filenames",
            )
        validation = val if self.validation else ()
        return transforms[sorted(train)], transforms[sorted(test)], transforms[sorted(validation)]


def _one_file(train: Transforms, test: Transforms, static_until: float | None) -> Layout:
    """The layout of a file of static and dynamic images."""
    if one_moment(train, test):
        return one_capture(train, test, 1.0)
    times = _times(train)
    at_zero = times <= TIME_TOLERANCE
    if static_until is None:
        static_until = 0.0 if int(at_zero.sum()) >= _SEVERAL else 1.0
    if static_until > 0 or not bool(at_zero.any()):
        return one_capture(train, test, static_until)
    static = at_zero.nonzero()[:, 0].tolist()
    static_test = (_times(test) <= TIME_TOLERANCE).nonzero()[:, 0].tolist()
    moving = _dynamic_images(train)
    moving_test = _dynamic_images(test)
    if not moving or not moving_test:
        raise scene_error(
            train.file,
            f"{len(moving)} images to learn motion from and {len(moving_test)} held out; expected "
            "one of each above time 0: correct the times, or train_filenames and test_filenames",
        )
    static_test_source = test
    if not static_test:
        log.warning("no held-out image at time 0: the static scene is tested on one in training")
        static_test = static[:1]
        static_test_source = train
    log.info("%d images at time 0 are the static set of %d", len(static), len(times))
    static_pair = (train[static], static_test_source[static_test])
    return two_captures(static_pair, (train[moving], test[moving_test]))


def _dynamic_images(transforms: Transforms) -> list[int]:
    """The images at later times, and those at time 0 by cameras that also have later ones.

    Other images at time 0 do not show motion, and their many cameras would hide that the others are
    fixed.
    """
    later = _times(transforms) > TIME_TOLERANCE
    camera = distinct_poses(transforms.poses)
    images: list[int] = (later | torch.isin(camera, camera[later])).nonzero()[:, 0].tolist()
    return images


def _times(transforms: Transforms) -> Tensor:
    assert transforms.times is not None  # else the scene is static
    return torch.tensor(transforms.times)
