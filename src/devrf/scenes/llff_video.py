"""One camera's video in LLFF's layout, as NR-NeRF has it: each image a time of its own."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import torch

from devrf.geometry.clock import FrameClock
from devrf.scenes.holdout import every_nth
from devrf.scenes.scene import Capture, Views
from devrf.scenes.splits import evenly_spread
from devrf.scenes.validation import scene_error

log = logging.getLogger(__name__)

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
