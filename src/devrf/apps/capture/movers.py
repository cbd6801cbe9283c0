"""What moves before a moving camera: optical flow that leaves the epipolar lines of its frames.

A point that stands still is seen, in any other frame, on a line that the two cameras alone tell
(Hartley and Zisserman, *Multiple View Geometry*, chapter 9). How far its optical flow ends from
that line is an error in pixels, small wherever nothing moves and the cameras are right. Nothing is
learned, and no weights are needed.
"""

from __future__ import annotations

import logging
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import torch

from devrf.apps.capture.images import Mask, shrunk
from devrf.scenes.optical_flow import consistent, estimator
from devrf.scenes.sparse_model import SparseModel
from devrf.system.progress import followed

log = logging.getLogger(__name__)

# Flow is estimated in images with so many pixels of the longer side.
LONGER_SIDE = 320
# Each frame is compared with those so many before and after it: the near ones give flow that can
# be trusted, the far ones enough motion.
STEPS = (1, 3)
# Errors below this many pixels are those of the flow itself.
NOISE = 0.15
# What moves is off by more than so many times the frame's median error.
TIMES_MEDIAN = 3.0
# Features at the rim of what moves see both sides: masks are so much wider, as a share of the
# image's longer side.
RIM = 0.02
# Masks that cover less than this share of the frames change no camera.
LEAST_SHARE = 0.02

Numbers = npt.NDArray[np.float64]


def masks_of_movers(images: Path, names: Sequence[str], model: SparseModel) -> dict[str, Mask]:
    """Where nothing moves, by the cameras of a model: 255, what moves and its rim: 0.

    Args:
        images: the folder of images.
        names: the moving camera's, in order of time, relative to the folder.
        model: structure from motion of these images; those it has not placed get no mask.

    Returns:
        (H, W) of each image, of the images' size; none where less moves than is worth masking.
    """
    place = {image.name: k for k, image in enumerate(model.images)}
    posed = [name for name in names if name in place]
    read = (cv2.imread(str(images / name), cv2.IMREAD_COLOR) for name in posed)
    pictures = [np.asarray(picture, np.uint8) for picture in read]
    height, width = pictures[0].shape[:2]
    small = [torch.from_numpy(shrunk(picture, LONGER_SIDE)) for picture in pictures]
    cameras = [_Camera(model, place[name], small[0].shape[1]) for name in posed]
    between = estimator("dis")
    masks = dict[str, Mask]()
    for k, name in enumerate(followed(posed, len(posed), "what moves")):
        errors = list[Numbers]()
        for other in (k + step * way for step in STEPS for way in (-1, 1)):
            if not 0 <= other < len(posed):
                continue
            there = between(small[k], small[other])
            back = between(small[other], small[k])
            error = cameras[k].error_of_flow(there.numpy(), cameras[other])
            error[~consistent(there, back).numpy()] = np.nan
            usual = max(float(np.nanmedian(error)), NOISE) if np.isfinite(error).any() else np.inf
            errors.append(error / usual)
        moves = _moves(np.stack(errors))
        rim = 2 * round(RIM * max(moves.shape)) + 1
        moves = cv2.dilate(moves, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (rim, rim)))
        still = cv2.resize(1 - moves, (width, height), interpolation=cv2.INTER_NEAREST)
        masks[name] = np.asarray(255 * still, np.uint8)
    share = float(np.mean([(mask == 0).mean() for mask in masks.values()]))
    log.info("structure from motion: %.0f %% of the pixels are of what moves", 100 * share)
    return masks if share >= LEAST_SHARE else {}


def _moves(errors: Numbers) -> Mask:
    """0 or 1 (H, W): where the median of some frames' errors (K, H, W) is large.

    Pixels whose flow no frame knows are as those around them.
    """
    with warnings.catch_warnings():  # of pixels that no frame knows
        warnings.simplefilter("ignore", RuntimeWarning)
        median = np.nanmedian(errors, axis=0)
    known = np.isfinite(median).astype(np.float32)
    large = np.where(known > 0, median > TIMES_MEDIAN, 0).astype(np.float32)
    # The majority of what is known around each pixel.
    around = (0, 0)
    deviation = 0.01 * max(errors.shape)
    votes = cv2.GaussianBlur(large, around, deviation)
    count = cv2.GaussianBlur(known, around, deviation)
    return np.asarray(votes > 0.5 * np.maximum(count, 1e-6), np.uint8)


class _Camera:
    """A placed camera, for images of another size."""

    def __init__(self, model: SparseModel, image: int, width: int) -> None:
        lens = model.cameras[model.images[image].camera]
        scale = width / lens["w"]
        self.focal = lens["fl_x"] * scale
        self.matrix = np.array(
            [
                [self.focal, 0, lens["cx"] * scale],
                [0, lens["fl_y"] * scale, lens["cy"] * scale],
                [0, 0, 1],
            ]
        )
        self.distortion = np.array([lens.get(key, 0.0) for key in ("k1", "k2", "p1", "p2")])
        pose = model.poses[image].numpy()
        # OpenCV's axes: y points down, z ahead.
        self.axes = pose[:, :3] * np.array([1, -1, -1])
        self.position = pose[:, 3]

    def error_of_flow(self, flow: npt.NDArray[Any], other: _Camera) -> Numbers:
        """(H, W): pixels from where flow (H, W, 2) ends to the epipolar line in ``other``.

        Sampson's distance, to first order in both images: Hartley and Zisserman, (11.9).
        """
        height, width = flow.shape[:2]
        y, x = np.mgrid[:height, :width] + 0.5
        here = self._rays(np.stack([x, y], axis=-1))
        there = other._rays(np.stack([x, y], axis=-1) + flow)
        turn = other.axes.T @ self.axes
        a, b, c = other.axes.T @ (self.position - other.position)
        essential = np.array([[0, -c, b], [c, 0, -a], [-b, a, 0]]) @ turn
        lines = here @ essential.T
        lines_back = there @ essential
        product = (there * lines).sum(axis=1)
        slope = np.hypot(np.hypot(lines[:, 0], lines[:, 1]), np.hypot(*lines_back.T[:2]))
        error: Numbers = np.abs(product) / np.maximum(slope, 1e-12) * self.focal
        return error.reshape(height, width)

    def _rays(self, pixels: Numbers) -> Numbers:
        """(M, 3): undistorted x, y and 1 of pixels (..., 2)."""
        flat = pixels.reshape(-1, 1, 2).astype(np.float64)
        plane = cv2.undistortPoints(flat, self.matrix, self.distortion).reshape(-1, 2)
        return np.concatenate([plane, np.ones((len(plane), 1))], axis=1)
