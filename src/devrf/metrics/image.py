"""How alike two images are."""

from __future__ import annotations

import torch
from kornia.metrics import ssim as ssim_map
from torch import Tensor


def psnr(prediction: Tensor, truth: Tensor) -> float:
    """Peak signal-to-noise ratio −10 log₁₀ MSE in dB of images in [0, 1], of any one shape."""
    error = torch.nn.functional.mse_loss(prediction.float(), truth.float())
    return float(-10 * torch.log10(error.clamp(min=1e-12)))


def ssim(prediction: Tensor, truth: Tensor) -> float:
    """Mean structural similarity of two (H, W, 3) images in [0, 1] (Wang et al. 2004).

    Gaussian window of 11×11, σ 1.5; only pixels whose window lies inside the image count where
    the image is large enough to have any.
    """
    a, b = (x.permute(2, 0, 1)[None].float() for x in (prediction, truth))
    padding = "valid" if min(a.shape[-2:]) >= 11 else "same"
    return float(ssim_map(a, b, window_size=11, max_val=1.0, padding=padding).mean())
