"""How alike two images are inside a mask, such as an alpha mask."""

from __future__ import annotations

from torch import Tensor
from torch.nn.functional import max_pool2d

from devrf.metrics.image import WINDOW, psnr, ssim_map


def psnr_masked(prediction: Tensor, truth: Tensor, mask: Tensor) -> float | None:
    """PSNR in dB of the pixels of two (H, W, 3) images in [0, 1] where ``mask`` (H, W) is True.

    None where the mask is empty.
    """
    return psnr(prediction[mask], truth[mask]) if bool(mask.any()) else None


def ssim_masked(prediction: Tensor, truth: Tensor, mask: Tensor) -> float | None:
    """Mean SSIM of the windows of two (H, W, 3) images whose centres ``mask`` (H, W) holds.

    The windows reach beyond the mask, as SSIM compares neighbourhoods. None where no window
    that counts has its centre there.
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
