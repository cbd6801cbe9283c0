"""How lists of samples follow what is needed."""

from __future__ import annotations

import torch

from devrf.rendering.sample_capacity import SampleCapacity


def test_it_grows_by_half_at_least_and_shrinks_only_from_great_waste() -> None:
    capacity = SampleCapacity(64, torch.device("cpu"))
    capacity.visible, capacity.significant = 4096, 1024

    def needing(visible: int, significant: int) -> tuple[int, int]:
        capacity.note(torch.tensor(visible), torch.tensor(significant))
        capacity.poll(), capacity.poll()
        return capacity.visible, capacity.significant

    assert needing(4097, 800) == (6144, 1024)
    assert needing(20000, 1024) == (25088, 1024)  # 1.25 times what was needed, in 256s
    assert needing(14000, 600) == (25088, 1024)  # less than 1.5 times what fits
    assert needing(13000, 400) == (16384, 512)
    assert capacity.num_short == 2
    capacity.note(torch.tensor(12000), torch.tensor(300))
    assert capacity.measure() and (capacity.visible, capacity.significant) == (15104, 512)
    assert needing(4000, 4000) == (5120, 5120)
    assert capacity.num_short == 3
