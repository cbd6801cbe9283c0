"""Numbers that are read one call late."""

from __future__ import annotations

import torch

from devrf.engine.late_reading import LateReading


def test_each_call_hands_over_what_the_one_before_was_given() -> None:
    late, values = LateReading(), torch.tensor([1.0, 2.0])
    assert late.exchange(values) is None
    values.fill_(3.0)  # what was given has been copied
    assert late.waiting == [1.0, 2.0]
    assert late.exchange(values) == [1.0, 2.0]
    assert late.exchange(values) == [3.0, 3.0]


def test_what_waits_can_be_kept_and_forgotten() -> None:
    late, again = LateReading(), LateReading()
    late.exchange(torch.tensor([0.25]))
    again.reset(late.waiting)
    assert again.exchange(torch.tensor([9.0])) == [0.25]
    again.reset()
    assert again.exchange(torch.tensor([1.0])) is None
