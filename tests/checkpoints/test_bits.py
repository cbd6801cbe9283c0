"""Masks as bits."""

from __future__ import annotations

import pytest
import torch

from devrf.checkpoints.bits import pack_bits, unpack_bits


def test_masks_are_packed_to_bits() -> None:
    mask = torch.rand(3, 5, 7) > 0.5
    assert pack_bits(mask).numel() == 14  # 105 bits
    assert torch.equal(unpack_bits(pack_bits(mask), mask.shape), mask)


def test_too_few_bits_are_refused() -> None:
    with pytest.raises(ValueError, match="not as long"):
        unpack_bits(torch.zeros(2, dtype=torch.uint8), (17,))


def test_the_first_cell_is_the_lowest_bit() -> None:
    mask = torch.tensor([True, False, False, True, False, False, False, False, True])
    assert pack_bits(mask).tolist() == [0b1001, 1]
