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
    assert needing(6000, 512) == (25088, 1024)
    assert needing(1000, 100) == (5120, 512)
    capacity.note(torch.tensor(900), torch.tensor(400))
    assert capacity.measure() and (capacity.visible, capacity.significant) == (1280, 512)
    assert needing(4000, 4000) == (5120, 5120)
