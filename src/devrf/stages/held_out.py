"""Held-out views: rendered, compared with the truth, scored."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from devrf.metrics.image import psnr, ssim
from devrf.rendering.model import Picture, SceneModel
from devrf.scenes.scene import Background, Views


@dataclass(frozen=True)
class HeldOutView:
    """A held-out image, what the model sees there, and how alike they are.

    Attributes:
        name: the image's name.
        time: its time in [0, 1].
        truth: (H, W, 3) RGB in [0, 1].
        prediction: (H, W, 3) RGB in [0, 1].
        psnr: dB.
        ssim: in [−1, 1].
        rest_pose_psnr: dB that the canonical field alone reaches there.
    """

    name: str
    time: float
    truth: Tensor
    prediction: Tensor
    psnr: float
    ssim: float
    rest_pose_psnr: float


def score(
    model: SceneModel, views: Views, index: int, background: Background, device: torch.device
) -> HeldOutView:
    """Render image ``index`` of held-out ``views`` and compare it with the truth."""
    time = float(views.times[index])
    truth = truth_image(views, index, background)
    prediction = _see(model, views, index, time, background, device)
    rest = prediction
    if model.warp(time) is not None:
        rest = _see(model, views, index, 0.0, background, device)
    return HeldOutView(
        name=views.names[index],
        time=time,
        truth=truth,
        prediction=prediction,
        psnr=psnr(prediction, truth),
        ssim=ssim(prediction, truth),
        rest_pose_psnr=psnr(rest, truth),
    )


def truth_image(views: Views, index: int, background: Background) -> Tensor:
    """A held-out image (H, W, 3) in [0, 1] on the background (white where that is random)."""
    value = views.pixels[index].float() / 255
    if not views.has_alpha:
        return value
    behind = background_value(background)
    return behind + value[..., 3:] * (value[..., :3] - behind)


def background_value(background: Background) -> float:
    """The grey level in [0, 1] behind held-out views."""
    return 0.0 if background == "black" else 1.0


def _see(
    model: SceneModel,
    views: Views,
    index: int,
    time: float,
    background: Background,
    device: torch.device,
) -> Tensor:
    rays = views.cameras.image_rays(index).to(device)
    behind = torch.full((3,), background_value(background), device=device)
    picture: Picture = model.picture(rays, time, behind)
    return picture.color.view(views.height, views.width, 3).clamp(0, 1).cpu()
