"""Metrics inside a mask, and errors of depth and motion, by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from devrf.metrics.geometric import depth_error, end_point_error
from devrf.metrics.image import psnr_masked, ssim, ssim_masked, ssim_partial, ssim_within


def test_masked_psnr_counts_the_masked_pixels_alone():
    truth = torch.zeros(2, 2, 3)
    seen = torch.tensor([[0.1, 0.9], [0.3, 0.9]])[..., None].expand(2, 2, 3)
    mask = torch.tensor([[True, False], [True, False]])
    # Mean square of 0.1 and 0.3.
    assert psnr_masked(seen, truth, mask) == pytest.approx(-10 * np.log10(0.05), abs=1e-4)
    assert psnr_masked(seen, truth, torch.zeros(2, 2, dtype=torch.bool)) is None


def test_masked_ssim_is_the_mean_over_windows_centred_in_the_mask(rng):
    a, b = torch.rand(2, 16, 14, 3, generator=rng)
    mask = torch.zeros(16, 14, dtype=torch.bool)
    mask[7, 8] = True
    # The window around (7, 8) is rows 2 to 12 and columns 3 to 13.
    alone = ssim(a[2:13, 3:14], b[2:13, 3:14])
    assert ssim_masked(a, b, mask) == pytest.approx(alone, abs=1e-5)
    assert ssim_masked(a, b, mask | True) == pytest.approx(ssim(a, b), abs=1e-6)
    mask[7, 8], mask[0, 0] = False, True  # no whole window lies around a corner
    assert ssim_masked(a, b, mask) is None


def test_ssim_within_a_mask_knows_nothing_of_what_is_beyond(rng):
    a, b = torch.rand(2, 20, 18, 3, generator=rng)
    mask = torch.zeros(20, 18, dtype=torch.bool)
    mask[3:16, 2:14] = True
    inside = ssim(a[3:16, 2:14], b[3:16, 2:14])
    assert ssim_within(a, b, mask) == pytest.approx(inside, abs=1e-5)
    a[~mask] = 0
    assert ssim_within(a, b, mask) == pytest.approx(inside, abs=1e-5)
    mask[9, 7] = False  # no window of 11 x 11 is without it
    assert ssim_within(a, b, mask) is None


def test_ssim_by_partial_convolutions(rng):
    a, b = torch.rand(2, 11, 31, 3, generator=rng)
    whole = ssim_partial(a, b, torch.ones(11, 31, dtype=torch.bool))
    assert whole == pytest.approx(ssim(a, b), abs=1e-5)
    assert ssim_partial(a, b, torch.zeros(11, 31, dtype=torch.bool)) is None
    # One pixel counts, in the middle of the first of 21 windows and at the left of the sixth.
    mask = torch.zeros(11, 31, dtype=torch.bool)
    mask[5, 5], a[5, 5], b[5, 5] = True, 0.2, 0.6
    weight = torch.softmax(-0.5 * ((torch.arange(11.0) - 5) / 1.5) ** 2, dim=0)
    expected = 15.0  # no pixel counts in the others
    for place in range(6):
        scale = 121 * float(weight[5] * weight[5 - place])  # down the column, and along the row
        spread = max(scale - scale**2, 0.0)  # E x² − (E x)², in units of the values' squares
        parts = (scale**2, 1e-4), (spread, 9e-4)
        expected += math.prod((0.24 * part + floor) / (0.4 * part + floor) for part, floor in parts)
    assert ssim_partial(a, b, mask) == pytest.approx(expected / 21, rel=1e-4)


def test_depth_error_by_hand():
    inf = math.inf
    truth = torch.tensor([[2.0, inf, 3.0], [4.0, 5.0, 6.0]])
    depth = torch.tensor([[2.5, 1.0, 2.0], [9.0, inf, 6.0]])
    opacity = torch.tensor([[0.9, 1.0, 0.6], [0.5, 1.0, 1.0]])
    # Off by 0.5, 1 and 0; not counted: nothing there, half transparent, seen at infinity.
    assert depth_error(depth, opacity, truth) == pytest.approx(0.5)
    assert depth_error(depth, 0 * opacity, truth) is None
    assert depth_error(depth, opacity, torch.full((2, 3), inf)) is None


def test_end_point_error_by_hand():
    truth = torch.tensor([[1.0, 1.0], [0.0, -2.0]])
    assert end_point_error(torch.zeros(2, 2), truth) == pytest.approx((2**0.5 + 2) / 2)
    assert end_point_error(truth[:0], truth[:0]) is None
