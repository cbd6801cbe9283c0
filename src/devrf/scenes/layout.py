"""The four splits of a scene, in any layout."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import torch
from torch import Tensor

from devrf.geometry.offset import Offset
from devrf.scenes.images import Size, image_size
from devrf.scenes.scene import Capture, Views
from devrf.scenes.splits import (
    Split,
    at_one_moment,
    at_times,
    distinct_poses,
    distinct_times,
    evenly_spread,
    first_views,
    in_motion,
    load_views,
    one_moment,
    standing,
)
from devrf.scenes.transforms import TIME_TOLERANCE, SceneBounds, Transforms
from devrf.scenes.validation import scene_error

log = logging.getLogger(__name__)

# The least number of images at time 0 that make a static set.
SEVERAL = 3
# A capture's training images, and its held-out ones.
Pair = tuple[Transforms, Transforms]


@dataclass(frozen=True)
class Layout:
    """A scene's splits, ordered but not yet loaded.

    Attributes:
        static_train: training images of the static capture.
        static_test: its held-out images.
        dynamic_train: training images of the dynamic capture; ``static_train`` itself if the scene
            is static.
        dynamic_test: its held-out images.
        validation: further held-out images of it, for the choice of settings, or None.
        thinned: whether times were left out, so that frames have lost their neighbours.
        alpha_weighted: as for :func:`devrf.scenes.images.load_images`.
    """

    static_train: Split
    static_test: Split
    dynamic_train: Split
    dynamic_test: Split
    validation: Split | None = None
    thinned: bool = False
    alpha_weighted: bool = True

    @property
    def offset(self) -> Offset:
        """The offset that is subtracted from positions, one for all files of the scene."""
        return self.static_train.transforms.offset

    @property
    def bounds(self) -> SceneBounds | None:
        """The bounds that the scene's files state, if any."""
        return self.static_train.transforms.bounds

    @property
    def moves(self) -> bool:
        """Whether there are images of the scene in motion."""
        return self.dynamic_train is not self.static_train

    def size_at(self, factor: int) -> tuple[int, int]:
        """Width and height in pixels of the longest static image made smaller by ``factor``."""
        width, height = self._longest
        return width // factor, height // factor

    @cached_property
    def _longest(self) -> tuple[int, int]:
        transforms = self.static_train.transforms
        first: dict[Size | None, int] = {}
        for k in self.static_train.index.tolist():
            # Images of cameras of one size have one size, too.
            first.setdefault(transforms.intrinsics[k].size, k)
        sizes = [image_size(transforms.images[k], camera) for camera, k in first.items()]
        return max(sizes, key=max)

    def with_validation(self, transforms: Transforms) -> Layout:
        """The layout with a validation split, of images that are not in the other splits.

        An image with the pose and the time of one of theirs is that image under another name.
        """
        if not transforms.images:
            return self
        split = in_motion(transforms) if self.moves else at_one_moment(transforms)
        used = torch.cat(
            [_poses_and_times(self.dynamic_train), _poses_and_times(self.dynamic_test)]
        )
        own = _poses_and_times(split)
        split = split.where(torch.stack([(used != image).any(dim=1).all() for image in own]))
        return replace(self, validation=split) if len(split.index) else self


def _poses_and_times(split: Split) -> Tensor:
    """(N, 13): the pose of each image of the file, and its time."""
    return torch.cat([split.transforms.poses.flatten(1), split.times[:, None]], dim=1)


def static_alone(train: Transforms, test: Transforms, why: str) -> Layout:
    """The layout of a static scene, whose images all show one moment; ``why`` is for the log."""
    log.info("%s: %s: all images show one moment, the scene is at rest", train.file, why)
    if cameras := standing(torch.cat([train.poses, test.poses])):
        log.warning(
            "%s: %s, as if the scene moved, but is learned at rest; if it moves, give each "
            'frame its "time" in [0, 1], not "timestamp" or "timestep_index"',
            train.file,
            cameras,
        )
    train_set = at_one_moment(train)
    test_set = at_one_moment(test)
    return Layout(train_set, test_set, train_set, test_set)


def two_captures(static: Pair, dynamic: Pair) -> Layout:
    """The layout of a static and a dynamic capture, each with training and held-out images."""
    train, test = map(in_motion, dynamic)
    learned, held_out = (len(distinct_times(split.times)) for split in (train, test))
    untimed = dynamic[0].times is dynamic[1].times is None
    if untimed and learned != held_out and dynamic[0].file != dynamic[1].file:
        log.warning(
            "%s: %d frames without times, and %d to learn from: both are taken to begin and to end "
            'together; if they do not, give each frame its "time"',
            dynamic[1].file,
            held_out,
            learned,
        )
    return Layout(at_one_moment(static[0]), at_one_moment(static[1]), train, test)


def one_capture(train: Transforms, test: Transforms, static_until: float) -> Layout:
    """The layout of one capture: static with one time or none, else without a static set."""
    if one_moment(train, test):
        times = "no time" if train.times is None else "one time"
        return static_alone(train, test, f"its frames have {times}")
    return without_static_set(in_motion(train), in_motion(test), static_until)


def without_static_set(train: Split, test: Split, static_until: float) -> Layout:
    """The layout of one capture in motion, whose images up to ``static_until`` count as static.

    DevrfError if no training image is that early.
    """
    early = train.where(train.times <= static_until + 1e-6)
    early_test = test.where(test.times <= static_until + 1e-6)
    if len(early.index) == 0:
        raise scene_error(
            train.transforms.file, "no image is as early as data.static_until; set it higher"
        )
    if len(early_test.index) == 0:
        early_test = test
    log.warning(
        "no static set: the canonical field is learned from %d of the %d training images "
        "(times up to %g), and tested on %d of %d",
        len(early.index),
        len(train.index),
        static_until,
        len(early_test.index),
        len(test.index),
    )
    return Layout(early, early_test, train, test)


def with_static_times(train: Transforms, test: Transforms, static_until: float | None) -> Layout:
    """The layout of images of all times, of which those at rest are told by their times.

    Several at time 0 are the static set; or else all up to ``static_until`` count as static. None:
    0 if there are several at time 0, else 1. DevrfError if no image shows motion.
    """
    if one_moment(train, test):
        return one_capture(train, test, 1.0)
    times = _times(train)
    at_zero = times <= TIME_TOLERANCE
    if static_until is None:
        static_until = 0.0 if int(at_zero.sum()) >= SEVERAL else 1.0
    if static_until > 0 or not bool(at_zero.any()):
        return one_capture(train, test, static_until)
    static = at_zero.nonzero()[:, 0].tolist()
    static_test = (_times(test) <= TIME_TOLERANCE).nonzero()[:, 0].tolist()
    moving = dynamic_images(train)
    moving_test = dynamic_images(test)
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


def dynamic_images(transforms: Transforms) -> list[int]:
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


def fewer(layout: Layout, train_views: int | None, frames: int | None) -> Layout:
    """The layout with fewer dynamic views and times.

    It keeps the first ``train_views`` dynamic views and ``frames`` times, evenly spread, first and
    last included; None: all. DevrfError if the dynamic images have one time only, or fewer views,
    or if there are none.
    """
    if not layout.moves:
        for key, count in (("train_views", train_views), ("frames", frames)):
            if count is not None:
                raise scene_error(
                    f"data.{key}",
                    f"{count} was asked for, but all images of "
                    f"{layout.static_train.transforms.file} show one moment; leave it null",
                )
        return layout
    train = first_views(layout.dynamic_train, train_views)
    if len(distinct_times(train.used_times)) < 2:
        raise scene_error(
            train.transforms.file, "all dynamic images have one time; give each frame its own"
        )
    times = None if frames is None else evenly_spread(train.used_times, frames)
    if times is None:
        return replace(layout, dynamic_train=train)

    known = distinct_times(train.used_times)

    def held_out(split: Split) -> Split:
        # Most held-out times (D-NeRF's) need not be among the training times: then all stay.
        among = len(at_times(split, known).index) > len(split.index) / 2
        return at_times(split, times) if among else split

    return replace(
        layout,
        dynamic_train=at_times(train, times),
        dynamic_test=held_out(layout.dynamic_test),
        validation=None if layout.validation is None else held_out(layout.validation),
        thinned=True,
    )


def load_layout(layout: Layout, root: Path, downscale: int) -> tuple[Capture, Capture]:
    """The static and the dynamic capture, images read from below the scene's folder ``root``.

    Images are made smaller by ``downscale``, or by their transforms' own factor, if they have one.
    """
    loaded: list[tuple[Split, Views]] = []

    def load(split: Split) -> Views:
        # Without a static set the captures share files: read them once.
        views = next((v for s, v in loaded if _same_images(s, split)), None)
        if views is None:
            views = load_views(split, root, downscale, alpha_weighted=layout.alpha_weighted)
            loaded.append((split, views))
        return views

    static = Capture(load(layout.static_train), load(layout.static_test))
    dynamic = Capture(load(layout.dynamic_train), load(layout.dynamic_test))
    if layout.validation is not None:
        dynamic = replace(dynamic, validation=load(layout.validation))
    return static, dynamic


def _same_images(a: Split, b: Split) -> bool:
    return a.transforms is b.transforms and torch.equal(a.index, b.index)
