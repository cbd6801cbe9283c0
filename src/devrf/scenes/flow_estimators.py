"""Two ways to estimate the optical flow between two images: DIS (OpenCV), RAFT (torchvision)."""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from devrf.scenes.resampling import area_average
from devrf.scenes.validation import scene_error

# Both methods work on coarse levels of an image pyramid and see nothing in smaller images.
LEAST_SIDE = 128
RAFT_MULTIPLE = 8

Estimator = Callable[[Tensor, Tensor], Tensor]


def estimator(method: str) -> Estimator:
    """A function (image, other) → flow between two images of one size.

    Images are (H, W, 3) uint8 on the CPU; the flow is (H, W, 2) float32 on the CPU, pixels, x
    then y: a point at x of ``image`` is at x + flow in ``other``.

    Args:
        method: "dis" or "raft".

    Raises:
        DevrfError: RAFT's library is not installed, or its weights cannot be downloaded.
    """
    return _dis() if method == "dis" else _raft()


def _dis() -> Estimator:
    dis: Any = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)

    def flow(image: Tensor, other: Tensor) -> Tensor:
        height, width = image.shape[:2]
        factor = max(1.0, LEAST_SIDE / min(height, width))
        size = math.ceil(width * factor), math.ceil(height * factor)
        grey = [cv2.cvtColor(i.numpy(), cv2.COLOR_RGB2GRAY) for i in (image, other)]
        if size != (width, height):
            grey = [cv2.resize(g, size, interpolation=cv2.INTER_CUBIC) for g in grey]
        vectors = area_average(dis.calc(grey[0], grey[1], None), width, height)
        return torch.from_numpy(vectors * np.array([width / size[0], height / size[1]], np.float32))

    return flow


def _raft() -> Estimator:
    try:
        models: Any = importlib.import_module("torchvision.models.optical_flow")
    except ImportError:
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
        # Edge pixels are repeated to the right and below, so that positions stay as they are.
        margin = 0, _padded(width) - width, 0, _padded(height) - height
        pair = torch.stack([image, other]).to(device).permute(0, 3, 1, 2).float() / 127.5 - 1
        first, second = pad(pair, margin, mode="replicate").chunk(2)
        with torch.no_grad():
            vectors: Tensor = model(first, second)[-1][0]
        return vectors[:, :height, :width].permute(1, 2, 0).float().cpu()

    return flow


def _padded(side: int) -> int:
    """The least multiple of 8, at least 128, that holds ``side`` pixels."""
    return max(LEAST_SIDE, math.ceil(side / RAFT_MULTIPLE) * RAFT_MULTIPLE)
