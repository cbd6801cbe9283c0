"""Similarity of two images, as a whole or inside a mask."""

from __future__ import annotations

import torch
from kornia.metrics import ssim as kornia_ssim
from torch import Tensor
from torch.nn.functional import avg_pool2d, conv2d, max_pool2d
from torchmetrics.functional.image import structural_similarity_index_measure

# SSIM's window, its side and Gaussian deviation in pixels; SSIM's constants for a range of 1.
WINDOW = 11
SIGMA = 1.5
C1 = 0.01**2
C2 = 0.03**2
# The exponents of MS-SSIM's scales. The coarsest, 1/16 of the image, must hold a whole window.
FINER_SCALES = (0.0448, 0.2856, 0.3001, 0.2363)
COARSEST_SCALE = 0.1333
MS_SSIM_SMALLEST = 2 ** len(FINER_SCALES) * WINDOW


def psnr(prediction: Tensor, truth: Tensor) -> float:
    """Peak signal-to-noise ratio −10 log₁₀ MSE in dB of images in [0, 1], of any one shape."""
    error = torch.nn.functional.mse_loss(prediction.float(), truth.float())
    return float(-10 * torch.log10(error.clamp(min=1e-12)))


def ssim(prediction: Tensor, truth: Tensor) -> float:
    """Mean structural similarity of two (H, W, 3) images in [0, 1] (Wang et al. 2004).

    Gaussian window of 11×11, σ 1.5; only pixels whose window lies inside the image count, if the
    image is large enough to have any.
    """
    return float(ssim_map(prediction, truth).mean())


def ssim_map(prediction: Tensor, truth: Tensor) -> Tensor:
    """Structural similarity at each pixel that :func:`ssim` counts: (H − 10, W − 10, 3).

    It is (H, W, 3) for images smaller than a window, with mirrored borders.
    """
    a = _batched(prediction)
    b = _batched(truth)
    padding = "valid" if min(a.shape[-2:]) >= WINDOW else "same"
    similarity: Tensor = kornia_ssim(a, b, window_size=WINDOW, max_val=1.0, padding=padding)
    return similarity[0].permute(1, 2, 0)


def ms_ssim(prediction: Tensor, truth: Tensor) -> float | None:
    """Multi-scale structural similarity of two (H, W, 3) images in [0, 1] (Wang et al. 2003).

    Five scales with the paper's exponents; each is the mean over all windows inside the image
    and all channels, negative ones counting as 0. None where a side is under 176 pixels.
    """
    a = _batched(prediction)
    b = _batched(truth)
    if min(a.shape[-2:]) < MS_SSIM_SMALLEST:
        return None
    value = 1.0
    for exponent in FINER_SCALES:
        _, contrast = structural_similarity_index_measure(
            a, b, data_range=1.0, return_contrast_sensitivity=True
        )
        value *= float(contrast.clamp(min=0)) ** exponent
        a, b = avg_pool2d(a, 2), avg_pool2d(b, 2)
    # torchmetrics counts windows beyond the image here, of which the coarsest scale has most.
    whole: Tensor = kornia_ssim(a, b, window_size=WINDOW, max_val=1.0, padding="valid").mean()
    return float(value * float(whole.clamp(min=0)) ** COARSEST_SCALE)


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

    Pixels outside the mask do not count. None where no window lies inside.
    """
    values = ssim_map(prediction, truth)
    # Images smaller than a window have mirrored borders, which are not beyond the mask.
    padding = (WINDOW - 1) // 2 if values.shape[:2] == mask.shape else 0
    touched = max_pool2d((~mask).float()[None], WINDOW, 1, padding)[0] > 0
    return None if bool(touched.all()) else float(values[~touched].mean())


def ssim_partial(prediction: Tensor, truth: Tensor, mask: Tensor) -> float | None:
    """DyCheck's masked SSIM (mSSIM) of two (H, W, 3) images in [0, 1], within ``mask`` (H, W).

    Windows are partial convolutions (Liu et al. 2018): along rows, then along columns, pixels
    beyond the mask count 0, and the sum is scaled by 11 over the number of pixels that count. The
    mean is over all windows inside the image; one without any such pixel has the similarity 1. None
    for images smaller than a window, or if the mask is empty.
    """
    if min(mask.shape) < WINDOW or not bool(mask.any()):
        return None
    a = _batched(prediction)
    b = _batched(truth)
    mean_a = _partial_blur(a, mask)
    mean_b = _partial_blur(b, mask)
    variance_a = (_partial_blur(a * a, mask) - mean_a.square()).clamp(min=0)
    variance_b = (_partial_blur(b * b, mask) - mean_b.square()).clamp(min=0)
    max_covariance = (variance_a * variance_b).sqrt()
    covariance = _partial_blur(a * b, mask) - mean_a * mean_b
    covariance = covariance.clamp(-max_covariance, max_covariance)
    alike = (2 * mean_a * mean_b + C1) * (2 * covariance + C2)
    energy = (mean_a.square() + mean_b.square() + C1) * (variance_a + variance_b + C2)
    return float((alike / energy).mean())


def _partial_blur(image: Tensor, mask: Tensor) -> Tensor:
    """Gaussian means (1, 3, H − 10, W − 10) of an image (1, 3, H, W) within ``mask`` (H, W)."""
    away = torch.arange(WINDOW) - WINDOW // 2
    kernel = torch.softmax(-0.5 * (away / SIGMA).square(), dim=0)
    valid = mask[None, None].float()
    for shape in ((1, 1, 1, WINDOW), (1, 1, WINDOW, 1)):
        total = conv2d(image * valid, kernel.view(shape).repeat(3, 1, 1, 1), groups=3)
        count = conv2d(valid, torch.ones(shape))
        image = WINDOW * total / count.clamp(min=1)
        valid = (count > 0).float()
    return image


def _batched(image: Tensor) -> Tensor:
    return image.permute(2, 0, 1)[None].float()
