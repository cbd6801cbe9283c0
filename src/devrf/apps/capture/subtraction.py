"""What moves before cameras that stand still, and the box that holds it."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from devrf.errors import DevrfError
from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras
from devrf.scenes.footage import Picture
from devrf.scenes.scene import Views
from devrf.scenes.silhouettes import motion_box

log = logging.getLogger(__name__)

# Silhouettes are found in images of so many pixels of the longer side: a box needs no more.
LONGER_SIDE = 320
# Squared distance from the background, in its variances, from which a pixel moves; and the
# variance that a pixel has at least, in grey levels squared (compression).
_FAR, _LEAST_VARIANCE = 25.0, 16.0
# What a pixel shows for this share of the pictures is background; of less, it moves.
_MOST_OF_THE_TIME = 0.5
# Connected pixels that are a smaller share of the image are noise.
_SPECK = 5e-4

Mask = npt.NDArray[np.uint8]


def silhouettes(pictures: Sequence[Picture]) -> list[Mask]:
    """Where each picture of a camera that stands still differs from what stays, (H, W): 0 or 255.

    The background is learned from all pictures (Zivkovic's mixtures of Gaussians, OpenCV's MOG2).
    What comes to rest for most of the time is background.

    Args:
        pictures: at least two, of one size.
    """
    model = cv2.createBackgroundSubtractorMOG2(len(pictures), _FAR, detectShadows=False)
    model.setVarMin(_LEAST_VARIANCE)
    model.setVarInit(_LEAST_VARIANCE)
    model.setBackgroundRatio(_MOST_OF_THE_TIME)
    for picture in pictures:
        # Of equal weight, whatever their order.
        model.apply(picture, learningRate=1 / len(pictures))
    return [_cleaned(np.asarray(model.apply(one, learningRate=0), np.uint8)) for one in pictures]


def _cleaned(mask: Mask) -> Mask:
    """The mask without specks."""
    opened = cv2.morphologyEx(mask, cv2.MORPH_OPEN, np.ones((2, 2), np.uint8))
    _, labels, stats, _ = cv2.connectedComponentsWithStats(opened)
    large = stats[:, cv2.CC_STAT_AREA] >= _SPECK * mask.size
    large[0] = False
    return np.where(large[labels], 255, 0).astype(np.uint8)


def box_of_motion(
    images: Path,
    names: Sequence[Sequence[str]],
    poses: Tensor,
    lenses: Sequence[dict[str, float]],
    around: Box,
) -> Box:
    """The box of all that moves, carved from the silhouettes of the fixed views.

    Args:
        images: the folder of images.
        names: of each of V ≥ 2 views its T images, relative to the folder.
        poses: (V, 3, 4) camera-to-world, OpenGL axes, world units.
        lenses: of each view its ``fl_x``, ``cx`` … in pixels; a distortion is left alone, being
            less than a cell of the carved grid at the middle.
        around: where it is looked for, half as far again.

    Raises:
        DevrfError: nothing moves in what two views see.
    """
    shown: list[Mask] = []
    for one in names:
        shown += silhouettes([_small(images / name) for name in one])
    count = len(names[0])
    height, width = shown[0].shape
    shares = [width / lens["w"] for lens in lenses]
    focal, center = (
        torch.tensor(
            [[lens[x] * s, lens[y] * s] for lens, s in zip(lenses, shares, strict=True)],
            dtype=torch.float32,
        )
        for x, y in (("fl_x", "fl_y"), ("cx", "cy"))
    )
    view = torch.arange(len(names)).repeat_interleave(count)
    alpha = torch.from_numpy(np.stack(shown))[..., None]
    views = Views(
        alpha.expand(-1, -1, -1, 4),
        Cameras(poses.float(), focal, center, width, height)[view],
        torch.linspace(0, 1, count).repeat(len(names)),
        view,
        tuple(name for one in names for name in one),
    )
    # Coarsely where it is, then with a finer grid.
    coarse = motion_box(views, around)
    found = None if coarse is None else motion_box(views, coarse)
    if found is None:
        raise DevrfError(
            "capture.mattes: subtract needs at least 2 fixed views that see something move at one "
            "time; leave capture.mattes out"
        )
    log.info("what moves is in %s", found)
    return found


def _small(path: Path) -> Picture:
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    assert image is not None  # the step before has written it
    factor = min(1.0, LONGER_SIDE / max(image.shape[:2]))
    size = (round(image.shape[1] * factor), round(image.shape[0] * factor))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
