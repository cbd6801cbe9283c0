"""PSNR and SSIM against hand values and an independent implementation."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from devrf.metrics.image import psnr, ssim


def slow_ssim(a: np.ndarray, b: np.ndarray) -> float:
    """Wang et al. 2004, window by window, in float64: 11×11, σ 1.5, K = (0.01, 0.03)."""
    along = np.exp(-((np.arange(11) - 5.0) ** 2) / (2 * 1.5**2))
    window = np.outer(along, along)
    window /= window.sum()
    values = []
    for y in range(a.shape[0] - 10):
        for x in range(a.shape[1] - 10):
            for channel in range(3):
                p = a[y : y + 11, x : x + 11, channel]
                q = b[y : y + 11, x : x + 11, channel]
                mp, mq = (window * p).sum(), (window * q).sum()
                vp, vq = (window * (p - mp) ** 2).sum(), (window * (q - mq) ** 2).sum()
                cov = (window * (p - mp) * (q - mq)).sum()
                top = (2 * mp * mq + 0.01**2) * (2 * cov + 0.03**2)
                values.append(top / ((mp**2 + mq**2 + 0.01**2) * (vp + vq + 0.03**2)))
    return float(np.mean(values))


@pytest.fixture
def image(rng: torch.Generator) -> Tensor:
    """A smooth 20×16 image with some noise."""
    y, x = torch.meshgrid(torch.linspace(0, 1, 20), torch.linspace(0, 1, 16), indexing="ij")
    smooth = torch.stack([x, y, (x + y) / 2], dim=-1)
    return (0.8 * smooth + 0.1 * torch.rand(20, 16, 3, generator=rng)).clamp(0, 1)


@pytest.mark.parametrize(("offset", "decibels"), [(0.1, 20.0), (0.01, 40.0), (1.0, 0.0)])
def test_psnr_of_a_constant_offset(offset: float, decibels: float) -> None:
    truth = torch.zeros(5, 4, 3)
    assert psnr(truth + offset, truth) == pytest.approx(decibels, abs=1e-4)


def test_psnr_is_of_the_mean_square_not_the_mean_of_psnrs() -> None:
    truth, other = torch.zeros(2, 1, 3), torch.zeros(2, 1, 3)
    other[0] = 0.2
    assert psnr(other, truth) == pytest.approx(-10 * np.log10(0.02), abs=1e-4)


def test_psnr_of_equal_images_is_finite(image: Tensor) -> None:
    assert psnr(image, image) == pytest.approx(120)


def test_ssim_of_equal_images_is_one(image: Tensor) -> None:
    assert ssim(image, image) == pytest.approx(1.0, abs=1e-6)


def test_ssim_agrees_with_an_independent_implementation(
    image: Tensor, rng: torch.Generator
) -> None:
    for other in (
        (image + 0.1 * torch.randn(20, 16, 3, generator=rng)).clamp(0, 1),
        image.flip(0),
        1 - image,
        0.5 * image,
    ):
        truth = slow_ssim(other.double().numpy(), image.double().numpy())
        assert ssim(other, image) == pytest.approx(truth, abs=2e-4)
        assert truth < 0.95


def test_ssim_of_flat_images_by_hand() -> None:
    # No variance: (2·0.25·0.5 + C1) / (0.25² + 0.5² + C1).
    a, b = torch.full((15, 13, 3), 0.25), torch.full((15, 13, 3), 0.5)
    assert ssim(a, b) == pytest.approx(0.2501 / 0.3126, abs=1e-4)


def test_ssim_counts_a_single_whole_window(image: Tensor, rng: torch.Generator) -> None:
    a, b = image[:11, :11], torch.rand(11, 11, 3, generator=rng)
    truth = slow_ssim(a.double().numpy(), b.double().numpy())
    assert ssim(a, b) == pytest.approx(truth, abs=2e-4)


def test_ssim_of_an_image_smaller_than_the_window_is_still_a_number(image: Tensor) -> None:
    small = image[:8, :9]
    assert ssim(small, small) == pytest.approx(1.0, abs=1e-6)
    assert 0 < ssim(small.flip(0), small) < 0.99
