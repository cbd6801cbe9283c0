"""Moving objects before a moving camera: optical flow leaves the epipolar lines of its frames.

Any other frame shows a static point on a line that the two cameras alone determine (Hartley and
Zisserman, *Multiple View Geometry*, chapter 9). The distance of its optical flow's end from that
line is an error in pixels, small wherever nothing moves and the cameras are right. Nothing is
learned, and no weights are needed.
"""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from devrf.apps.capture.images import Mask, shrunk
from devrf.scenes.optical_flow import consistent, estimator
from devrf.scenes.sparse_model import SparseModel
from devrf.system.progress import followed

log = logging.getLogger(__name__)

# Flow is estimated in images with so many pixels of the longer side.
LONGER_SIDE = 320
# Each frame is compared with those so many before and after it: in nearer ones little has moved,
# and of farther ones there is no flow.
STEPS = (2, 4)
# Errors below this many pixels are those of the flow itself.
NOISE = 0.15
# The error of a moving pixel is more than so many times the frame's median.
TIMES_MEDIAN = 3.0
# Root mean square of Sobel's slopes, 8 for a grey level a pixel, below which flow is a guess.
TEXTURE = 16.0
# Standard deviation, in pixels, of the neighbourhood in which pixels vote.
AROUND = 6.0
# The weight of a frame's vote in the next one.
MEMORY = 0.9
# A pixel moves if so large a share of the frames vote so.
MOVES = 0.25
# Features at the rim of a moving object see both sides: masks are so much wider, as a share of the
# image's longer side.
RIM = 0.02
# Masks that cover less than this share of the frames change no camera.
LEAST_SHARE = 0.02

Numbers = npt.NDArray[np.float64]


class MonocularVideo:
    """A moving camera's images, and the optical flow between any two, estimated once.

    Attributes:
        textured: masks (H, W) of each image's texture, at the size that flow is estimated in.
    """

    def __init__(self, images: Path, names: Sequence[str]) -> None:
        """Read images.

        Args:
            images: the folder of images.
            names: the moving camera's, in order of time, relative to the folder.
        """
        self._names = names
        read = (cv2.imread(str(images / name), cv2.IMREAD_COLOR) for name in names)
        pictures = [np.asarray(picture, np.uint8) for picture in read]
        self._size = pictures[0].shape[1::-1]
        self._small = [shrunk(picture, LONGER_SIDE) for picture in pictures]
        self.textured = [_textured(picture) for picture in self._small]
        self._estimator = estimator("dis")
        self._estimated = cache(self._estimate)

    def motion_masks(self, model: SparseModel) -> dict[str, Mask]:
        """Masks of static pixels, by the cameras of a model: 255; moving objects and their rim: 0.

        Args:
            model: structure from motion of these images; those it has not placed get no mask.

        Returns:
            (H, W) of each image, of the images' size; none if too little moves to be worth masking.
        """
        shots = self._placed(model)
        rim = 2 * round(RIM * LONGER_SIDE) + 1
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (rim, rim))
        votes = [shots.votes(k) for k in followed(range(len(shots)), len(shots), "moving pixels")]
        masks = dict[str, Mask]()
        for number, agreed in zip(shots.numbers, shots.agreed(votes), strict=True):
            moves = cv2.dilate(np.asarray(agreed > MOVES, np.uint8), disc)
            static = cv2.resize(1 - moves, self._size, interpolation=cv2.INTER_NEAREST)
            masks[self._names[number]] = np.asarray(255 * static, np.uint8)
        share = float(np.mean([(mask == 0).mean() for mask in masks.values()]))
        log.info("structure from motion: %.0f %% of the pixels move", 100 * share)
        return masks if share >= LEAST_SHARE else {}

    def static_error(self, model: SparseModel, masks: Mapping[str, Mask]) -> float:
        """The epipolar error of the flow of static pixels, by ``masks``, in pixels.

        It is the median over the images that a model has placed of each one's median.
        """
        shots = self._placed(model)
        medians = list[float]()
        for k, number in enumerate(shots.numbers):
            mask = masks.get(self._names[number])
            if mask is None:
                continue
            height, width = self._small[number].shape[:2]
            static = cv2.resize(mask, (width, height), interpolation=cv2.INTER_NEAREST) > 0
            of_pairs = [error[static & np.isfinite(error)] for error in shots.errors(k)]
            finite = np.concatenate([*of_pairs, np.empty(0)])
            if len(finite):
                medians.append(float(np.median(finite)))
        return float(np.median(medians)) if medians else np.inf

    def between(self, one: int, other: int) -> tuple[Numbers, Mask]:
        """Flow (H, W, 2) from one image to another, and whether (H, W) the way back agrees."""
        there = self._estimated(one, other)
        return there.numpy(), consistent(there, self._estimated(other, one)).numpy()

    def _estimate(self, one: int, other: int) -> Tensor:
        pictures = (torch.from_numpy(self._small[number]) for number in (one, other))
        return self._estimator(*pictures)

    def _placed(self, model: SparseModel) -> _Shots:
        index = {image.name: k for k, image in enumerate(model.images)}
        numbers = [number for number, name in enumerate(self._names) if name in index]
        width = self._small[0].shape[1]
        cameras = [_Camera(model, index[self._names[number]], width) for number in numbers]
        return _Shots(self, numbers, cameras)


@dataclass(frozen=True)
class _Shots:
    """The images of a video that a model has placed, by their order.

    Attributes:
        video: the video.
        numbers: of its images.
        cameras: of each.
    """

    video: MonocularVideo
    numbers: list[int]
    cameras: list[_Camera]

    def __len__(self) -> int:
        return len(self.numbers)

    def between(self, one: int, other: int) -> tuple[Numbers, Mask]:
        """As :meth:`MonocularVideo.between`."""
        return self.video.between(self.numbers[one], self.numbers[other])

    def errors(self, k: int) -> Iterator[Numbers]:
        """(H, W) of each near image: the epipolar error of the flow there; NaN: unknown."""
        textured = self.video.textured[self.numbers[k]]
        for other in (k + step * way for step in STEPS for way in (-1, 1)):
            if 0 <= other < len(self):
                there, agrees = self.between(k, other)
                error = self.cameras[k].error_of_flow(there, self.cameras[other])
                error[~(agrees & textured)] = np.nan
                yield error

    def votes(self, k: int) -> Numbers:
        """(H, W): the share of moving pixels among the known ones around each of image ``k``."""
        # A video may be too short to have an image near enough.
        shares: list[Numbers] = [np.full(self.video.textured[self.numbers[k]].shape, np.nan)]
        for error in self.errors(k):
            any_known = np.isfinite(error).any()
            usual = max(float(np.nanmedian(error)), NOISE) if any_known else np.inf
            shares.append(error / usual)
        with warnings.catch_warnings():  # of pixels that no frame knows
            warnings.simplefilter("ignore", RuntimeWarning)
            error = np.nanmedian(np.stack(shares), axis=0)
        finite = np.isfinite(error)
        moves = finite & (np.where(finite, error, 0) > TIMES_MEDIAN)
        count = cv2.GaussianBlur(finite.astype(np.float64), (0, 0), AROUND)
        return cv2.GaussianBlur(moves.astype(np.float64), (0, 0), AROUND) / np.maximum(count, 1e-3)

    def agreed(self, votes: Sequence[Numbers]) -> list[Numbers]:
        """The mean of all images' votes (H, W) along the flow, of near ones before others.

        A thing that moves along its epipolar lines for a while moved across them before, or will;
        single errors are outvoted.
        """
        share = [vote.copy() for vote in votes]
        count = [np.ones_like(vote) for vote in votes]
        numbers = range(len(votes))
        for order, way in ((numbers, -1), (numbers[::-1], 1)):
            # Sums of the votes, and of their weights, of the frame before in this order.
            total = weight = np.zeros_like(votes[0])
            for k in order:
                if k != order[0]:
                    there, agrees = self.between(k, k + way)
                    total = MEMORY * agrees * _at(total, there)
                    weight = MEMORY * agrees * _at(weight, there)
                    share[k] += total
                    count[k] += weight
                total = total + votes[k]
                weight = weight + 1
        return [a / b for a, b in zip(share, count, strict=True)]


def _textured(picture: npt.NDArray[Any]) -> Mask:
    """The mask (H, W) of a picture's texture: elsewhere its flow is a guess."""
    grey = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
    across = cv2.Sobel(grey, cv2.CV_32F, 1, 0)
    down = cv2.Sobel(grey, cv2.CV_32F, 0, 1)
    return np.asarray(cv2.blur(across**2 + down**2, (7, 7)) > TEXTURE**2)


def _at(image: Numbers, flow: Numbers) -> Numbers:
    """The image (H, W), sampled at the ends of flow (H, W, 2)."""
    y, x = np.mgrid[: image.shape[0], : image.shape[1]]
    at = (np.stack([x, y], axis=-1) + flow).astype(np.float32)
    return np.asarray(cv2.remap(image, at[..., 0], at[..., 1], cv2.INTER_LINEAR), np.float64)


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
