"""MS-SSIM against an implementation of its own, in NumPy and float64."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from devrf.metrics.image import ms_ssim

EXPONENTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)


def blurred(values: np.ndarray) -> np.ndarray:
    """Gaussian means, 11×11, σ 1.5, of the windows inside (H, W)."""
    along = np.exp(-((np.arange(11) - 5.0) ** 2) / (2 * 1.5**2))
    along /= along.sum()
    for axis in (0, 1):
        windows = np.lib.stride_tricks.sliding_window_view(values, 11, axis=axis)
        values = windows @ along
    return values


def slow_ms_ssim(a: np.ndarray, b: np.ndarray) -> float:
    """Wang et al. 2003: contrast and structure at five scales, luminance at the last."""
    product = 1.0
    for scale, exponent in enumerate(EXPONENTS):
        similar, contrast = [], []
        for p, q in zip(np.moveaxis(a, 2, 0), np.moveaxis(b, 2, 0), strict=True):
            mp, mq = blurred(p), blurred(q)
            vp, vq = blurred(p * p) - mp**2, blurred(q * q) - mq**2
            cov = blurred(p * q) - mp * mq
            contrast.append((2 * cov + 0.03**2) / (vp + vq + 0.03**2))
            light = (2 * mp * mq + 0.01**2) / (mp**2 + mq**2 + 0.01**2)
            similar.append(light * contrast[-1])
        last = scale == len(EXPONENTS) - 1
        product *= max(np.mean(similar if last else contrast), 0.0) ** exponent
        height, width = (n // 2 * 2 for n in a.shape[:2])
        a, b = (
            x[:height, :width].reshape(height // 2, 2, width // 2, 2, 3).mean(axis=(1, 3))
            for x in (a, b)
        )
    return float(product)


@pytest.fixture
def image(rng: torch.Generator) -> Tensor:
    """Waves of several lengths, 178×190, with some noise."""
    y, x = torch.meshgrid(torch.arange(178.0), torch.arange(190.0), indexing="ij")
    waves = torch.stack([(x / 5).sin(), (y / 11).cos(), ((x + y) / 23).sin()], dim=-1)
    return (0.5 + 0.35 * waves + 0.1 * torch.rand(178, 190, 3, generator=rng)).clamp(0, 1)


def test_of_equal_images_is_one(image: Tensor) -> None:
    assert ms_ssim(image, image) == pytest.approx(1.0, abs=1e-6)


def test_agrees_with_an_independent_implementation(image: Tensor, rng: torch.Generator) -> None:
    for other in (
        (image + 0.2 * torch.randn(image.shape, generator=rng)).clamp(0, 1),
        0.6 * image,
        image.roll(3, dims=1),
    ):
        truth = slow_ms_ssim(other.double().numpy(), image.double().numpy())
        assert 0.1 < truth < 0.98
        assert ms_ssim(other, image) == pytest.approx(truth, abs=2e-4)


def test_what_is_opposite_counts_as_nothing(image: Tensor) -> None:
    assert slow_ms_ssim((1 - image).double().numpy(), image.double().numpy()) == 0
    assert ms_ssim(1 - image, image) == 0


def test_of_images_without_five_scales_is_unknown(image: Tensor) -> None:
    assert ms_ssim(image[:176, :176], image[:176, :176]) == pytest.approx(1.0, abs=1e-6)
    assert ms_ssim(image[:175], image[:175]) is None
    assert ms_ssim(image[:, :175], image[:, :175]) is None
