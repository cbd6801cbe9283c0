"""Grids in half precision, in full detail only near occupied space."""

from __future__ import annotations

import pytest
import torch

from devrf.checkpoints.stored_grids import pack, pack_bits, unpack, unpack_bits


@pytest.fixture
def keep() -> torch.Tensor:
    mask = torch.zeros(2, 9, 7, 6, dtype=torch.bool)
    mask[0, 2:5, 1:4, 3] = True
    mask[1, 8, 6, 5] = True
    return mask


def test_what_is_kept_comes_back_in_half_precision(keep):
    torch.manual_seed(0)
    grids = torch.randn(2, 9, 7, 6, 3)
    back = unpack(pack(grids, keep, smooth=True))
    assert back.shape == grids.shape and back.dtype == torch.float32
    assert torch.equal(back[keep], grids[keep].half().float())


def test_elsewhere_a_smooth_grid_is_interpolated(keep):
    # A linear ramp is what trilinear interpolation reproduces, however thin it was stored.
    x, y, z = torch.meshgrid(*[torch.linspace(0, 1, n) for n in (9, 7, 6)], indexing="ij")
    ramp = torch.stack([x, 2 * y, x - z], dim=-1)
    back = unpack(pack(torch.stack([ramp, -ramp]), keep, smooth=True))
    torch.testing.assert_close(back[0], ramp, atol=2e-3, rtol=0)
    torch.testing.assert_close(back[1], -ramp, atol=2e-3, rtol=0)


def test_elsewhere_the_mean_of_what_is_left_out(keep):
    grids = torch.full((2, 9, 7, 6, 2), -4.0)
    grids[keep] = torch.tensor([100.0, 7.0])
    assert torch.equal(unpack(pack(grids, keep, smooth=False)), grids)


def test_the_size_is_two_bytes_a_kept_value():
    grids = torch.zeros(4, 40, 40, 40, 3)
    keep = torch.zeros(4, 40, 40, 40, dtype=torch.bool)
    keep[:, 10:20, 10:20, 10:20] = True
    packed = pack(grids, keep, smooth=True)
    detail, thin, bits = 4 * 1000 * 6, 4 * 11**3 * 6, 4 * 40**3 // 8
    assert sum(packed[name].nbytes for name in ("kept", "elsewhere", "keep")) == (
        detail + thin + bits
    )


def test_one_grid_comes_back_as_one():
    grid = torch.randn(9, 7, 6, 2).half().float()
    keep = torch.ones(1, 9, 7, 6, dtype=torch.bool)
    assert torch.equal(unpack(pack(grid, keep, smooth=False)), grid)


def test_a_value_beyond_half_precision_is_kept_as_it_is():
    grids = torch.full((1, 2, 2, 2, 1), 7e4)
    stored = pack(grids, torch.ones(1, 2, 2, 2, dtype=torch.bool), smooth=False)
    assert unpack(stored) is grids


def test_masks_are_packed_to_bits() -> None:
    mask = torch.rand(3, 5, 7) > 0.5
    assert pack_bits(mask).numel() == 14  # 105 bits
    assert torch.equal(unpack_bits(pack_bits(mask), mask.shape), mask)
