"""Scenes in nerfstudio's and instant-ngp's layout: one ``transforms.json`` for all images."""

from __future__ import annotations

import logging
import os
from dataclasses import KW_ONLY, replace
from pathlib import Path
from typing import Literal

import torch
from pydantic.dataclasses import dataclass
from torch import Tensor

from devrf.geometry.offset import Offset
from devrf.scenes.files import inside, scene_folder
from devrf.scenes.image_folders import Downscale
from devrf.scenes.layout import Layout, fewer, load_layout, one_capture, static_alone
from devrf.scenes.masks import Masks
from devrf.scenes.names import ImageFinder
from devrf.scenes.reader import EstimatedFlow, PosedReader, Time
from devrf.scenes.scene import Scene
from devrf.scenes.splits import at_rest, distinct_poses, every_nth, in_motion, one_moment
from devrf.scenes.transforms import TIME_TOLERANCE, Transforms, read_transforms
from devrf.scenes.validation import scene_error
from devrf.system.options import Count, Several, abbreviated

log = logging.getLogger(__name__)

FILE = "transforms.json"
# The least number of images at time 0 that make a static set: fewer teach no field.
_SEVERAL = 3


@dataclass(frozen=True)
class NerfstudioReader(PosedReader):
    """Reads ``transforms.json`` and images.

    The file may lie in ``root``, with a ``time`` in [0, 1] on every frame, or in ``root/static``
    and, with times, in ``root/dynamic``. Without times, or without ``root/dynamic``, the scene is
    at rest. Cameras may stand still or move. Held-out images are those in ``test_filenames`` (else
    ``val_filenames``), else every ``holdout``-th; beside ``test_filenames``, ``val_filenames`` are
    the validation split. Images are undistorted; the world is that of the file's poses.

    A frame's ``mask_path`` is a grey image of the size of the image or of its camera, black where
    pixels are left out.

    Attributes:
        train_views: train on the first so many dynamic views; None: all.
        holdout: without lists in the file, one of so many images is held out.
        times: ``file`` takes each frame's ``time``; ``order`` spreads times evenly over the images
            in the order of their names: of a film that another program has posed.
        static_until: in one file, the latest time of an image that counts as static; None: 0 where
            several images are of time 0, else 1.
        masks: what the masks are taken for. ``ignore``, nerfstudio's meaning: their pixels (people
            who walk by) are neither learned from nor scored. ``alpha``: they are background, as of
            a person who was cut out; that also shows where the scene is and where it moves.
            ``none``: they are left alone.
        space: as of :class:`~devrf.scenes.reader.PosedReader`; a file of ``stage=capture`` says
            itself (``scene_bounds``) what ``auto`` is.
    """

    _: KW_ONLY
    downscale: Downscale = "auto"
    flow: EstimatedFlow = "auto"
    train_views: Count | None = None
    holdout: Several = 8
    times: Literal["file", "order"] = "file"
    static_until: Time | None = None
    masks: Masks = "ignore"

    def read(self) -> Scene:
        """See :meth:`devrf.scenes.reader.SceneReader.read`."""
        folder = scene_folder(self.root)
        layout = _layout(folder, self)
        layout, _ = fewer(layout, self.train_views, self.frames)
        factor = self.choose_factor(layout.size_at)
        static, dynamic = load_layout(layout, folder, factor, self.masks)
        bounds = layout.static_train.transforms.bounds
        stater = f"scene_bounds in {FILE}"
        return self.placed(folder, static, dynamic, bounds, stater, layout.offset)


def _layout(root: Path, options: NerfstudioReader) -> Layout:
    if os.path.isfile(root / FILE):
        train, test, validation = _splits(root / FILE, root, options)
        layout = _one_file(train, test, options.static_until)
        if layout.static_train.transforms is not layout.dynamic_train.transforms:
            validation = validation[_seen_moving(validation)]
        return layout.with_validation(validation)
    still = root / "static" / FILE
    moving = root / "dynamic" / FILE
    train, test, validation = _splits(still, root, replace(options, times="file"))
    if not os.path.isfile(moving):
        layout = static_alone(train, test, f"there is no dynamic/{FILE}")
        return layout.with_validation(validation)
    static_train = at_rest(train)
    static_test = at_rest(test)
    train, test, validation = _splits(moving, root, options, train.offset)
    if train.times is None:
        raise scene_error(moving, 'its frames have no "time"; give every frame its time in [0, 1]')
    layout = Layout(
        static_train=static_train,
        static_test=static_test,
        dynamic_train=in_motion(train),
        dynamic_test=in_motion(test),
    )
    return layout.with_validation(validation)


def _splits(
    file: Path, root: Path, options: NerfstudioReader, offset: Offset | None = None
) -> tuple[Transforms, Transforms, Transforms]:
    """The images of a file to learn from, to test on, and in its validation list, if asked for.

    ``offset`` is that of the scene's other file, if it has been read.
    """
    listing, transforms = read_transforms(
        file,
        root,
        masked=options.masks != "none",
        missing=options.missing,
        times_by_order=options.times == "order",
        offset=offset,
    )
    count = len(transforms.images)
    if count == 1:
        raise scene_error(file, "lists one image; add more, one of them to hold out")
    listed = {
        split: _listed(getattr(listing, f"{split}_filenames"), split, transforms, root)
        for split in ("train", "val", "test")
    }
    test = listed["test"] or listed["val"]
    elsewhere = set(listed["val"] + listed["test"])
    train = listed["train"] or [i for i in range(count) if i not in elsewhere]
    if listed["train"] and not test:
        test = sorted(set(range(count)) - set(train))
    elif not test:
        train, test = every_nth(count, options.holdout)
    if not train or not test or set(train) & set(test):
        raise scene_error(
            file,
            f"{len(train)} images to learn from, {len(test)} held out, "
            f"{len(set(train) & set(test))} of them both; correct train_filenames, test_filenames",
        )
    validation = listed["val"] if options.validation else []
    return transforms[train], transforms[test], transforms[validation]


def _listed(names: list[str] | None, split: str, transforms: Transforms, root: Path) -> list[int]:
    """Positions in the file, ascending, of the images that it lists for a split."""
    position = {image: i for i, image in enumerate(transforms.images)}
    positions = list[int]()
    finder = ImageFinder(root)
    for name in names or []:
        image = finder.find(inside(root, transforms.file.parent, name, transforms.file))
        if image is None and transforms.skipped:
            continue
        if image not in position:
            raise scene_error(
                transforms.file,
                f"{split}_filenames lists {abbreviated(name)}, which is in no frame; correct it",
            )
        positions.append(position[image])
    return sorted(set(positions))


def _one_file(train: Transforms, test: Transforms, static_until: float | None) -> Layout:
    """The layout of a file that holds the scene at rest and in motion."""
    if one_moment(train, test):
        return one_capture(train, test, 1.0)
    times = _times(train)
    at_zero = times <= TIME_TOLERANCE
    if static_until is None:
        static_until = 0.0 if int(at_zero.sum()) >= _SEVERAL else 1.0
    if static_until > 0 or not bool(at_zero.any()):
        return one_capture(train, test, static_until)
    still = at_zero.nonzero()[:, 0].tolist()
    still_test = (_times(test) <= TIME_TOLERANCE).nonzero()[:, 0].tolist()
    moving = _seen_moving(train)
    moving_test = _seen_moving(test)
    if not moving or not moving_test:
        raise scene_error(
            train.file,
            f"{len(moving)} images to learn motion from and {len(moving_test)} held out; expected "
            "one of each above time 0: correct the times, or train_filenames and test_filenames",
        )
    rest_test = test
    if not still_test:
        log.warning("no held-out image at time 0: the static scene is tested on one in training")
        still_test = still[:1]
        rest_test = train
    log.info("%d images at time 0 are the static set of %d", len(still), len(times))
    return Layout(
        at_rest(train[still]),
        at_rest(rest_test[still_test]),
        in_motion(train[moving]),
        in_motion(test[moving_test]),
    )


def _seen_moving(transforms: Transforms) -> list[int]:
    """The images at later times, and those at time 0 by cameras that stay to see more.

    Other images at time 0 tell nothing of motion, and their many cameras would hide that the
    others stand still.
    """
    later = _times(transforms) > TIME_TOLERANCE
    camera = distinct_poses(transforms.poses)
    images: list[int] = (later | torch.isin(camera, camera[later])).nonzero()[:, 0].tolist()
    return images


def _times(transforms: Transforms) -> Tensor:
    assert transforms.times is not None  # else the scene is at rest
    return torch.tensor(transforms.times)
