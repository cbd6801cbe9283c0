"""Optical flow of scenes without flow files, by DIS (OpenCV) or RAFT (torchvision)."""

from __future__ import annotations

import importlib
import logging
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from devrf.geometry.clock import FrameClock
from devrf.scenes.flow_files import content_key, load_flow, save_flow
from devrf.scenes.resampling import area_average
from devrf.scenes.scene import OpticalFlow, Views, on_background
from devrf.scenes.validation import scene_error

log = logging.getLogger(__name__)


# Both methods work on coarse levels of an image pyramid and fail on smaller images.
LEAST_SIDE = 128
RAFT_MULTIPLE = 8

Estimator = Callable[[Tensor, Tensor], Tensor]


def estimator(method: str, *, least_side: int = LEAST_SIDE) -> Estimator:
    """A function (image, other) → flow between two images of one size.

    Images are (H, W, 3) uint8 on the CPU; the flow is (H, W, 2) float32 on the CPU, pixels, x
    then y: a point at x of ``image`` is at x + flow in ``other``.

    Args:
        method: "dis" or "raft".
        least_side: DIS enlarges images whose shorter side has fewer pixels.

    Raises:
        DevrfError: RAFT's library is not installed, or its weights cannot be downloaded.
    """
    return _dis(least_side) if method == "dis" else _raft()


def _dis(least_side: int) -> Estimator:
    dis: Any = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)

    def flow(image: Tensor, other: Tensor) -> Tensor:
        height, width = image.shape[:2]
        factor = max(1.0, least_side / min(height, width))
        size = (math.ceil(width * factor), math.ceil(height * factor))
        grey = [cv2.cvtColor(i.numpy(), cv2.COLOR_RGB2GRAY) for i in (image, other)]
        if size != (width, height):
            grey = [cv2.resize(g, size, interpolation=cv2.INTER_CUBIC) for g in grey]
        vectors = area_average(dis.calc(grey[0], grey[1], None), width, height)
        return torch.from_numpy(vectors * np.array([width / size[0], height / size[1]], np.float32))

    return flow


def _raft() -> Estimator:
    try:
        models: Any = importlib.import_module("torchvision.models.optical_flow")
    except ModuleNotFoundError:
        raise scene_error(
            "data.flow=raft",
            'torchvision is not installed; run pip install "devrf[raft]", or set data.flow=dis',
        ) from None
    device = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        model = models.raft_large(weights=models.Raft_Large_Weights.DEFAULT, progress=False)
    except OSError as error:
        raise scene_error(
            "data.flow=raft",
            f"its weights cannot be downloaded ({error}); go online once, or set data.flow=dis",
        ) from None
    model = model.eval().requires_grad_(False).to(device)

    def flow(image: Tensor, other: Tensor) -> Tensor:
        height, width = image.shape[:2]
        # Edge pixels are repeated to the right and below, so that positions do not change.
        margin = (0, _padded(width) - width, 0, _padded(height) - height)
        pair = torch.stack([image, other]).to(device).permute(0, 3, 1, 2).float() / 127.5 - 1
        first, second = pad(pair, margin, mode="replicate").chunk(2)
        with torch.no_grad():
            vectors: Tensor = model(first, second)[-1][0]
        return vectors[:, :height, :width].permute(1, 2, 0).float().cpu()

    return flow


def _padded(side: int) -> int:
    """The least multiple of 8, at least 128, that holds ``side`` pixels."""
    return max(LEAST_SIDE, math.ceil(side / RAFT_MULTIPLE) * RAFT_MULTIPLE)


FlowMethod = Literal["dis", "raft"]

# A vector is trusted if the way there and back ends within 1 px + 5 % of its length.
CLOSED_PIXELS = 1.0
CLOSED_SHARE = 0.05
ALPHA_THRESHOLD = 127


def estimate_flow(
    views: Views, method: FlowMethod, cache: Path | None = None, *, forward: bool = False
) -> OpticalFlow:
    """Backward optical flow of each image to the one a frame earlier in its view.

    A fixed camera's images follow one another by time; a moving camera's images (each its own
    view) are taken as one sequence. Images are compared on white. A vector is valid where the
    forward flow leads back, |b(x) + f(x + b(x))| < 1 px + 5 % · |b(x)|, where it stays in the
    image, and on the alpha mask where there is one.

    Args:
        views: N images of the scene in motion.
        method: "dis" (OpenCV, on the CPU) or "raft" (torchvision, on the GPU if there is one).
        cache: an npz to read the flow from, or to write it to; it is overwritten if it belongs to
            other images or is damaged.
        forward: estimate forward flow instead, to the image a frame later.

    Raises:
        DevrfError: the library or weights are missing, the images have no
            two distinct times.
    """
    pairs = frame_pairs(views)
    if not pairs:
        raise scene_error(
            "data.flow", "no view has two consecutive frames to estimate flow between"
        )
    key = content_key(views, f"{method} forward" if forward else method)
    if cache is not None:
        stored = load_flow(cache, key, (len(views), views.height, views.width))
        if stored is not None:
            log.info("read estimated optical flow from %s", cache)
            return stored
    start = time.perf_counter()
    between = estimator(method)
    count = (len(views), views.height, views.width)
    flow = OpticalFlow(torch.zeros((*count, 2)), torch.zeros(count, dtype=torch.bool))
    for number, pair in enumerate(pairs, 1):
        image, other = pair[::-1] if forward else pair
        vectors, valid = flow_between(views, image, other, between)
        height, width = valid.shape
        flow.valid[image, :height, :width] = valid
        flow.vectors[image, :height, :width] = vectors * valid[..., None]
        if number % 100 == 0:
            log.info("optical flow: %d of %d pairs", number, len(pairs))
    seconds = time.perf_counter() - start
    log.info("estimated optical flow (%s) of %d pairs in %.1f s", method, len(pairs), seconds)
    if cache is not None:
        save_flow(cache, key, flow)
    return flow


def flow_between(views: Views, image: int, other: int, between: Estimator) -> tuple[Tensor, Tensor]:
    """Flow (H, W, 2) of an image to another, in pixels, and its valid mask (H, W).

    For images of two sizes it is the flow of their common part at the top left.
    """
    whole = [views.single(k).pixels[0] for k in (image, other)]
    height = min(pixels.shape[0] for pixels in whole)
    width = min(pixels.shape[1] for pixels in whole)
    on_white = (on_background(pixels[:height, :width].cpu(), 1.0) for pixels in whole)
    now, then = ((255 * color).round().to(torch.uint8) for color in on_white)
    there = between(now, then)
    back = between(then, now)
    valid = consistent(there, back)
    if views.has_alpha:
        valid &= whole[0][:height, :width, 3].cpu() > ALPHA_THRESHOLD
    return there, valid


def frame_pairs(views: Views) -> list[tuple[int, int]]:
    """(image, image one frame earlier in its view) for each image that has such a predecessor."""
    if float(views.times.max()) == 0:
        return []
    frame = FrameClock.from_times(views.times).frames_of(views.times)
    view = torch.zeros_like(views.view) if views.by_moving_camera else views.view
    at = {(v, f): i for i, (v, f) in enumerate(zip(view.tolist(), frame.tolist(), strict=True))}
    return sorted((i, at[v, f - 1]) for (v, f), i in at.items() if (v, f - 1) in at)


def consistent(backward: Tensor, forward: Tensor) -> Tensor:
    """The mask of pixels on which two flows agree.

    Args:
        backward: (H, W, 2) from an image to the earlier one, pixels, x then y.
        forward: (H, W, 2) from the earlier image to this one.

    Returns:
        (H, W) bool: the end point is in the earlier image, and the way back leads to within
        1 px + 5 % of the vector's length.
    """
    height, width = backward.shape[:2]
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    end = torch.stack([x, y], dim=-1) + backward
    inside = ((end >= 0) & (end <= end.new_tensor([width - 1, height - 1]))).all(dim=-1)
    at_x = np.ascontiguousarray(end[..., 0])
    at_y = np.ascontiguousarray(end[..., 1])
    interpolated = cv2.remap(
        forward.numpy(), at_x, at_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    back = torch.from_numpy(np.asarray(interpolated, dtype=np.float32))
    miss: Tensor = torch.linalg.vector_norm(backward + back, dim=-1)
    length: Tensor = torch.linalg.vector_norm(backward, dim=-1)
    # NaN compares false: such vectors are not trusted.
    return inside & (miss < CLOSED_PIXELS + CLOSED_SHARE * length)
