"""From drawn pixels to their rays and what the images show there; and the steps of a ray."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor


class GatheredPixels(NamedTuple):
    """R pixels of images, with the world rays through them.

    Attributes:
        origins: (R, 3) the cameras' centres, world units.
        directions: (R, 3) unit directions in world space.
        color: (R, 3) RGB in [0, 1], composited on the background.
        alpha: (R,) alpha mask in [0, 1]; None for images without one.
        time: (R,) the images' times.
        frame: (R,) int64, the images' frames.
        pixel: (R, 2) x, y of the pixels' centres.
        flow: (R, 2) observed flow in pixels, 0 where it is not valid; None without flow.
        flow_valid: (R,) bool; None without flow.
    """

    origins: Tensor
    directions: Tensor
    color: Tensor
    alpha: Tensor | None
    time: Tensor
    frame: Tensor
    pixel: Tensor
    flow: Tensor | None
    flow_valid: Tensor | None


def gather_pixels(
    image: Tensor,
    flat: Tensor,
    pixels: Tensor,
    poses: Tensor,
    focal: Tensor,
    center: Tensor,
    background: Tensor,
    times: Tensor,
    frames: Tensor,
    flow: tuple[Tensor, Tensor] | None = None,
) -> GatheredPixels:
    """Rays and truth of R pixels; nothing is differentiable.

    A ray's direction is the camera's rotation of ((x − c_x) / f_x, −(y − c_y) / f_y, −1), of
    length 1; its colour is ``background + alpha · (rgb − background)``.

    Args:
        image: (R,) int64, the image of each pixel.
        flat: (R,) int64, its row-major number in the image.
        pixels: (N, H, W, 3 or 4) uint8.
        poses: (N, 3, 4) camera to world, OpenGL axes.
        focal: (N, 2) in pixels.
        center: (N, 2) principal points in pixels.
        background: (3,) or (R, 3) RGB.
        times: (N,) of the images.
        frames: (N,) int64, of the images.
        flow: vectors (N, H, W, 2) and whether they are valid (N, H, W), or None.
    """
    _, height, width, channels = pixels.shape
    pixel = torch.stack([flat % width, flat // width], dim=-1) + 0.5
    row = image * (height * width) + flat
    value = pixels.reshape(-1, channels)[row].float() / 255
    color, alpha = value[:, :3], value[:, 3] if channels == 4 else None
    if alpha is not None:
        color = background + alpha[:, None] * (color - background)
    x, y = ((pixel - center[image]) / focal[image]).unbind(-1)
    local = torch.stack([x, -y, -torch.ones_like(x)], dim=-1)
    pose = poses[image]
    directions = (pose[:, :, :3] * local[:, None, :]).sum(dim=-1)
    directions = torch.nn.functional.normalize(directions, dim=-1)
    vectors = valid = None
    if flow is not None:
        valid = flow[1].reshape(-1)[row]
        # What was observed where it is not valid may be anything, NaN included.
        vectors = torch.where(valid[:, None], flow[0].reshape(-1, 2)[row], 0.0)
    return GatheredPixels(
        pose[:, :, 3], directions, color, alpha, times[image], frames[image], pixel, vectors, valid
    )


def steps_between(entry: Tensor, leave: Tensor, step: float) -> Tensor:
    """Number (R,) int64 of samples every ``step`` from ``entry`` (R,) up to ``leave`` (R,).

    A sample exactly at the exit counts: in NDC it is the last plane, behind the whole scene.
    """
    return torch.where(leave >= entry, ((leave - entry) / step + 1e-3).floor() + 1, 0.0).long()
