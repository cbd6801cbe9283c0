"""How alike two images are, as a whole or inside a mask."""

from __future__ import annotations

import torch
from kornia.metrics import ssim as kornia_ssim
from torch import Tensor
from torch.nn.functional import max_pool2d
from torchmetrics.functional.image import multiscale_structural_similarity_index_measure

WINDOW = 11
# The coarsest of MS-SSIM's five scales, 1/16 of the image, must hold a whole window.
MS_SSIM_SMALLEST = 16 * WINDOW


def psnr(prediction: Tensor, truth: Tensor) -> float:
    """Peak signal-to-noise ratio −10 log₁₀ MSE in dB of images in [0, 1], of any one shape."""
    error = torch.nn.functional.mse_loss(prediction.float(), truth.float())
    return float(-10 * torch.log10(error.clamp(min=1e-12)))


def ssim(prediction: Tensor, truth: Tensor) -> float:
    """Mean structural similarity of two (H, W, 3) images in [0, 1] (Wang et al. 2004).

    Gaussian window of 11×11, σ 1.5; only pixels whose window lies inside the image count where
    the image is large enough to have any.
    """
    return float(ssim_map(prediction, truth).mean())


def ssim_map(prediction: Tensor, truth: Tensor) -> Tensor:
    """Structural similarity at each pixel that :func:`ssim` counts: (H − 10, W − 10, 3).

    Of images smaller than a window (H, W, 3), with what is missing mirrored.
    """
    a, b = (_batched(image) for image in (prediction, truth))
    padding = "valid" if min(a.shape[-2:]) >= WINDOW else "same"
    similarity: Tensor = kornia_ssim(a, b, window_size=WINDOW, max_val=1.0, padding=padding)
    return similarity[0].permute(1, 2, 0)


def ms_ssim(prediction: Tensor, truth: Tensor) -> float | None:
    """Multi-scale structural similarity of two (H, W, 3) images in [0, 1] (Wang et al. 2003).

    Five scales with the paper's exponents; each is the mean over all windows inside the image
    and all channels, negative ones counting as 0. None where a side is under 176 pixels.
    """
    a, b = (_batched(image) for image in (prediction, truth))
    if min(a.shape[-2:]) < MS_SSIM_SMALLEST:
        return None
    return float(multiscale_structural_similarity_index_measure(a, b, data_range=1.0))


def psnr_masked(prediction: Tensor, truth: Tensor, mask: Tensor) -> float | None:
    """PSNR in dB of the pixels of two (H, W, 3) images in [0, 1] where ``mask`` (H, W) is True.

    None where the mask is empty.
    """
    return psnr(prediction[mask], truth[mask]) if bool(mask.any()) else None


def ssim_masked(prediction: Tensor, truth: Tensor, mask: Tensor) -> float | None:
    """Mean SSIM of the windows of two (H, W, 3) images whose centres ``mask`` (H, W) holds.

    The windows reach beyond the mask. None where none that counts has its centre there.
    """
    values = ssim_map(prediction, truth)
    edge = (mask.shape[0] - values.shape[0]) // 2
    inner = mask[edge : edge + values.shape[0], edge : edge + values.shape[1]]
    return float(values[inner].mean()) if bool(inner.any()) else None


def ssim_within(prediction: Tensor, truth: Tensor, mask: Tensor) -> float | None:
    """Mean SSIM of the windows of two (H, W, 3) images that lie inside ``mask`` (H, W).

    What is beyond the mask has no part in it. None where no window lies inside.
    """
    values = ssim_map(prediction, truth)
    # Of images smaller than a window, what is missing is mirrored, and so not beyond the mask.
    padding = (WINDOW - 1) // 2 if values.shape[:2] == mask.shape else 0
    touched = max_pool2d((~mask).float()[None], WINDOW, 1, padding)[0] > 0
    return None if bool(touched.all()) else float(values[~touched].mean())


def _batched(image: Tensor) -> Tensor:
    return image.permute(2, 0, 1)[None].float()
