"""A scene without its priors, all that it has beside images: ``priors=none``."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import torch

from devrf.scenes.bounds import FALLBACK_BOUND_SCALE
from devrf.scenes.scene import Background, Scene, Views, background_value, on_background

Priors = Literal["all", "none"]


def without_priors(scene: Scene) -> Scene:
    """The scene as posed images before a known background, without priors.

    Training images lose optical flow, depth and alpha masks; the box loses the room for motion that
    masks, or an embedded scene, gave. Held-out images keep the maps that metrics use. The static
    box and the space stay: no method would know where to look without them.
    """
    plain: Background = "white" if scene.background == "random" else scene.background
    scale = max(scene.bounds.scale, FALLBACK_BOUND_SCALE)
    bounds = replace(scene.bounds, motion=None, scale=scale, source="priors=none")
    static = replace(scene.static, train=_bare(scene.static.train, plain))
    dynamic = replace(scene.dynamic, train=_bare(scene.dynamic.train, plain))
    return replace(scene, static=static, dynamic=dynamic, bounds=bounds, background=plain)


def _bare(views: Views, background: Background) -> Views:
    """Images (N, H, W, 3) on the background, with cameras and times."""
    pixels = views.pixels
    if views.has_alpha:
        color = on_background(pixels, background_value(background))
        pixels = (255 * color).round().to(torch.uint8)
    return replace(views, pixels=pixels, flow=None, forward_flow=None, depth=None)
