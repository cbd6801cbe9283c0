"""Pictures by the plain renderer, and whether two pictures are alike."""

from __future__ import annotations

import torch

from devrf.geometry.rays import Rays
from devrf.methods.devrf.model import DeVRFModel
from devrf.methods.devrf.volume_rendering import render
from devrf.rendering.output import RenderedImage


def plain_picture(
    model: DeVRFModel, rays: Rays, time: float, background: torch.Tensor
) -> RenderedImage:
    """What rays in the fields' space see of a model at ``time``, by the plain renderer."""
    scene = model.canonical, model.occupancy_at(time), model.settings
    with torch.no_grad():
        warp, colors = model.backward_warp(time), model.color_residual_at(time)
        return RenderedImage.of(render(rays, *scene, background, warp, color_residual=colors))


def assert_same_picture(picture: RenderedImage, other: RenderedImage) -> None:
    """Compare colour, depth and opacity, up to 1e-5."""
    for name in ("color", "depth", "opacity"):
        torch.testing.assert_close(
            getattr(picture, name), getattr(other, name), atol=1e-5, rtol=1e-5
        )
