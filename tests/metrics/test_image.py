"""PSNR, SSIM and MS-SSIM against hand values and an independent implementation in float64."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from devrf.metrics.image import ms_ssim, psnr, ssim

EXPONENTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)


def blurred(values):
    """Gaussian means, 11×11, σ 1.5, of the windows inside (H, W, 3)."""
    along = np.exp(-((np.arange(11) - 5.0) ** 2) / (2 * 1.5**2))
    along /= along.sum()
    for axis in (0, 1):
        windows = np.lib.stride_tricks.sliding_window_view(values, 11, axis=axis)
        values = windows @ along
    return values


def slow_terms(a, b):
    """Wang et al. 2004, K = (0.01, 0.03): similarity at each pixel, and its contrast term."""
    ma, mb = blurred(a), blurred(b)
    va, vb = blurred(a * a) - ma**2, blurred(b * b) - mb**2
    contrast = (2 * (blurred(a * b) - ma * mb) + 0.03**2) / (va + vb + 0.03**2)
    return (2 * ma * mb + 0.01**2) / (ma**2 + mb**2 + 0.01**2) * contrast, contrast


def slow_ssim(prediction, truth):
    return float(slow_terms(prediction.double().numpy(), truth.double().numpy())[0].mean())


def slow_ms_ssim(prediction, truth):
    """Wang et al. 2003: contrast and structure at five scales, luminance at the last."""
    product, pair = 1.0, [prediction.double().numpy(), truth.double().numpy()]
    for scale, exponent in enumerate(EXPONENTS):
        similar, contrast = slow_terms(*pair)
        product *= max((similar if scale == 4 else contrast).mean(), 0.0) ** exponent
        height, width = (n // 2 for n in pair[0].shape[:2])
        pair = [
            x[: height * 2, : width * 2].reshape(height, 2, width, 2, 3).mean(axis=(1, 3))
            for x in pair
        ]
    return product


@pytest.fixture
def image(rng):
    """A smooth 20×16 image with some noise."""
    y, x = torch.meshgrid(torch.linspace(0, 1, 20), torch.linspace(0, 1, 16), indexing="ij")
    smooth = torch.stack([x, y, (x + y) / 2], dim=-1)
    return (0.8 * smooth + 0.1 * torch.rand(20, 16, 3, generator=rng)).clamp(0, 1)


@pytest.fixture
def large(rng):
    """Waves of several lengths, 178×190, with some noise."""
    y, x = torch.meshgrid(torch.arange(178.0), torch.arange(190.0), indexing="ij")
    waves = torch.stack([(x / 5).sin(), (y / 11).cos(), ((x + y) / 23).sin()], dim=-1)
    return (0.5 + 0.35 * waves + 0.1 * torch.rand(178, 190, 3, generator=rng)).clamp(0, 1)


@pytest.mark.parametrize(("offset", "decibels"), [(0.1, 20), (0.0, 120)])
def test_psnr_of_a_constant_offset(offset, decibels):
    truth = torch.zeros(5, 4, 3)
    assert psnr(truth + offset, truth) == pytest.approx(decibels, abs=1e-4)


def test_ssim_agrees_with_an_independent_implementation(image, rng):
    noisy = (image + 0.1 * torch.randn(20, 16, 3, generator=rng)).clamp(0, 1)
    one_window = image[:11, :11], torch.rand(11, 11, 3, generator=rng)
    for prediction, truth in ((noisy, image), (1 - image, image), one_window):
        expected = slow_ssim(prediction, truth)
        assert expected < 0.95
        assert ssim(prediction, truth) == pytest.approx(expected, abs=1e-5)


def test_ms_ssim_agrees_with_an_independent_implementation(large, rng):
    noisy = (large + 0.2 * torch.randn(large.shape, generator=rng)).clamp(0, 1)
    framed = large.clone()
    framed[:24], framed[:, :24] = 0.0, 0.0  # windows beyond the image would count it twice
    for prediction in (noisy, framed):
        expected = slow_ms_ssim(prediction, large)
        assert 0.1 < expected < 0.98
        assert ms_ssim(prediction, large) == pytest.approx(expected, abs=1e-5)
    assert slow_ms_ssim(1 - large, large) == ms_ssim(1 - large, large) == 0


def test_ms_ssim_of_images_without_five_scales_is_unknown(large):
    assert ms_ssim(large[:176, :176], large[:176, :176]) == pytest.approx(1.0, abs=1e-6)
    assert ms_ssim(large[:175], large[:175]) is None
