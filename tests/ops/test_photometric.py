"""The photometric terms of pixels that are means of several rays."""

from __future__ import annotations

import pytest
import torch

from devrf.ops.photometric import alpha_mask_error, color_error, pixel_means


def test_what_a_pixel_shows_is_the_mean_of_its_rays_by_hand():
    # Two rays of a pixel: one meets something white, the other black background.
    image = torch.tensor([[1.0, 1.0, 1.0], [0.0, 0.0, 0.0]])
    truth = torch.full((2, 3), 0.5)
    assert color_error(image, truth, per_pixel=2).item() == 0.0
    assert color_error(image, truth).item() == 0.25
    half_covered = torch.tensor([0.5, 0.5])
    assert alpha_mask_error(torch.tensor([0.0, 1.0]), half_covered, per_pixel=2).item() == 0.0
    assert alpha_mask_error(torch.tensor([0.0, 0.6]), half_covered, per_pixel=2).item() == (
        pytest.approx(0.04)  # (0.3 − 0.5)²
    )
    assert pixel_means(torch.tensor([1.0, 3.0, 5.0, 9.0]), 2).tolist() == [2.0, 7.0]
