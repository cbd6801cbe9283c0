"""Optical flow where a scene brings none: estimated once between the frames of each view."""

from __future__ import annotations

import logging
import time
from pathlib import Path
from typing import Literal, get_args

import cv2
import numpy as np
import torch
from torch import Tensor

from devrf.geometry.clock import FrameClock
from devrf.scenes.flow_cache import content_key, load_flow, save_flow
from devrf.scenes.flow_estimators import estimator
from devrf.scenes.resampling import LONGEST_SIDE
from devrf.scenes.scene import OpticalFlow, Views
from devrf.scenes.validation import check_choice, scene_error

log = logging.getLogger(__name__)

FlowMethod = Literal["dis", "raft"]

# A vector is trusted when going there and back ends this near: 1 px, and 5 % of its length.
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
        cache: an npz to read the flow from, or to write it to; ignored and written again when
            it belongs to other images or is damaged.
        forward: the same with frames swapped: to the image a frame later.

    Raises:
        DevrfError: an unknown method, its library or weights are missing, the images have no
            two distinct times, or are too large.
    """
    check_choice("data.flow", method, get_args(FlowMethod))
    pairs = frame_pairs(views)
    if not pairs:
        raise scene_error(
            "data.flow", "no view has two consecutive frames to estimate flow between"
        )
    if max(views.width, views.height) > LONGEST_SIDE:
        raise scene_error(
            "data.flow",
            f"cannot be estimated between images of more than {LONGEST_SIDE} px a side; use a "
            "larger data.downscale, or set data.flow=none",
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
    for done, pair in enumerate(pairs):
        image, other = pair[::-1] if forward else pair
        now, then = _on_white(views.pixels[image]), _on_white(views.pixels[other])
        there, back = between(now, then), between(then, now)
        valid = consistent(there, back)
        if views.has_alpha:
            valid &= views.pixels[image, ..., 3].cpu() > ALPHA_THRESHOLD
        flow.valid[image] = valid
        flow.vectors[image] = there * valid[..., None]
        if (done + 1) % 100 == 0:
            log.info("optical flow: %d of %d pairs", done + 1, len(pairs))
    log.info(
        "estimated optical flow (%s) of %d pairs in %.1f s",
        method,
        len(pairs),
        time.perf_counter() - start,
    )
    if cache is not None:
        save_flow(cache, key, flow)
    return flow


def frame_pairs(views: Views) -> list[tuple[int, int]]:
    """(image, image one frame earlier in its view) for each image that has such a predecessor."""
    if float(views.times.max()) == 0:
        return []
    frame = FrameClock.from_times(views.times).frames_of(views.times)
    view = torch.zeros_like(views.view) if views.by_moving_camera else views.view
    at = {(v, f): i for i, (v, f) in enumerate(zip(view.tolist(), frame.tolist(), strict=True))}
    return sorted((i, at[v, f - 1]) for (v, f), i in at.items() if (v, f - 1) in at)


def camera_turn(views: Views) -> float:
    """Median angle in degrees between the optical axes of an image and the one before it."""
    pairs = frame_pairs(views)
    if not pairs:
        return 0.0
    image, earlier = torch.tensor(pairs).unbind(dim=1)
    axes = views.cameras.forwards
    cosine = (axes[image] * axes[earlier]).sum(dim=1).clamp(-1, 1)
    return float(torch.rad2deg(cosine.acos()).median())


def consistent(backward: Tensor, forward: Tensor) -> Tensor:
    """Where two flows agree.

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
    at_x, at_y = (np.ascontiguousarray(end[..., axis]) for axis in (0, 1))
    found = cv2.remap(
        forward.numpy(), at_x, at_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    back = torch.from_numpy(np.asarray(found, dtype=np.float32))
    miss: Tensor = torch.linalg.vector_norm(backward + back, dim=-1)
    length: Tensor = torch.linalg.vector_norm(backward, dim=-1)
    # NaN compares false: what is not a number is not trusted.
    return inside & (miss < CLOSED_PIXELS + CLOSED_SHARE * length)


def _on_white(image: Tensor) -> Tensor:
    """(H, W, 3) uint8 on the CPU: an RGBA image over white; an RGB image as it is."""
    image = image.cpu()
    if image.shape[2] == 3:
        return image
    alpha = image[..., 3:].float() / 255
    return (image[..., :3] * alpha + 255 * (1 - alpha)).round().to(torch.uint8)
