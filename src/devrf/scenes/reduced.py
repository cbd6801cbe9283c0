"""A scene of smaller images, for rehearsals."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from devrf.geometry.ndc import NormalizedDevice
from devrf.scenes.resampling import shrink_flow, shrink_pixels
from devrf.scenes.scene import OpticalFlow, Scene, Views, both_mapped
from devrf.scenes.validation import MIN_SIDE


def reduced(scene: Scene, longest: int) -> Scene:
    """The scene with images of at most ``longest`` pixels a side; bounds and times stay.

    Sides keep their proportion, but are at least as long as readers require.
    """
    space = scene.space
    if isinstance(space, NormalizedDevice):
        width, height = _size(space.width, space.height, longest)
        focal = (space.focal[0] * width / space.width, space.focal[1] * height / space.height)
        space = replace(space, width=width, height=height, focal=focal)
    static, dynamic = both_mapped(
        scene.static, scene.dynamic, lambda views: _reduced_views(views, longest)
    )
    return replace(scene, static=static, dynamic=dynamic, space=space)


def _size(width: int, height: int, longest: int) -> tuple[int, int]:
    """Width and height in pixels, the longer one at most ``longest``."""
    scale = min(1.0, longest / max(width, height))
    return max(round(width * scale), MIN_SIDE), max(round(height * scale), MIN_SIDE)


def _reduced_views(views: Views, longest: int) -> Views:
    width, height = _size(views.width, views.height, longest)
    if (width, height) == (views.width, views.height):
        return views
    further: dict[str, Any] = {}
    for name in ("flow", "forward_flow"):
        if (flow := getattr(views, name)) is not None:
            further[name] = _reduced_flow(flow, width, height)
    # Masks and depths are not averaged: those of the middle pixel count.
    rows = ((torch.arange(height) + 0.5) * views.height / height).long()
    columns = ((torch.arange(width) + 0.5) * views.width / width).long()
    for name in ("depth", "valid_mask", "exposure_mask", "motion_mask"):
        if (of_pixels := getattr(views, name)) is not None:
            further[name] = of_pixels[:, rows[:, None], columns]
    cameras = views.cameras.resized(width, height)
    if cameras.sizes is not None:
        sizes = cameras.sizes.clamp(min=MIN_SIDE)
        cameras = replace(cameras, sizes=sizes)
        across = torch.arange(width) < sizes[:, :1, None]
        # Pixels that are partly beside an image are left out.
        further["valid_mask"] &= across & (torch.arange(height) < sizes[:, 1:])[..., None]
    return replace(
        views,
        pixels=_stacked([shrink_pixels(p.numpy(), width, height) for p in views.pixels]),
        cameras=cameras,
        **further,
    )


def _reduced_flow(flow: OpticalFlow, width: int, height: int) -> OpticalFlow:
    both = zip(flow.vectors, flow.valid, strict=True)
    shrunk = [shrink_flow(v.numpy(), valid.numpy(), width, height) for v, valid in both]
    return OpticalFlow(_stacked([v for v, _ in shrunk]), _stacked([valid for _, valid in shrunk]))


def _stacked(arrays: list[np.ndarray]) -> Tensor:
    return torch.from_numpy(np.stack(arrays))
