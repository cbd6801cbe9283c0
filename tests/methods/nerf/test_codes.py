"""Codes of frames."""

from __future__ import annotations

import torch

from devrf.methods.nerf.networks import TimeCodes


def test_a_frame_has_its_own_code_and_a_time_between_two_a_mixture() -> None:
    codes = TimeCodes((0.0, 0.5, 1.0), 2)
    table = codes.table.weight.detach()
    found = codes(torch.tensor([0.0, 0.5, 1.0, 0.6]))
    torch.testing.assert_close(found[:3], table)
    torch.testing.assert_close(found[3], 0.8 * table[1] + 0.2 * table[2])
    assert (table >= 0).all() and (table < 0.05).all()


def test_a_frame_learns_its_own_code_alone() -> None:
    codes = TimeCodes((0.0, 0.5, 1.0), 2)
    codes(torch.tensor([0.5])).sum().backward()
    assert codes.table.weight.grad is not None
    assert codes.table.weight.grad.tolist() == [[0.0, 0.0], [1.0, 1.0], [0.0, 0.0]]
