"""The search for visible samples, by hand."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from devrf.geometry.box import Box
from devrf.ops.search import PackedSamples, Thresholds, find_samples

LINE = Box((0.0, 0.0, 0.0), (4.0, 1.0, 1.0))
# Opacities of five grid points along x: empty, half, half, opaque, half.
ALPHA = torch.tensor([0.0, 0.5, 0.5, 1 - 1e-6, 0.5])


def along_x(**changed: Any) -> PackedSamples:
    """Two rays along x, the second of which has no samples; one sample at each grid point."""
    tau = (-torch.log1p(-ALPHA.double())).clamp(min=1e-9)
    raw = torch.log(torch.expm1(tau)).float().view(5, 1, 1, 1).expand(5, 2, 2, 1)
    arguments: dict[str, Any] = {
        "origins": torch.zeros(2, 3),
        "directions": torch.tensor([[1.0, 0, 0], [0, 1.0, 0]]),
        "entry": torch.zeros(2),
        "count": torch.tensor([5, 0]),
        "mask": torch.ones(5, 2, 2, dtype=torch.bool),
        "density": raw.contiguous(),
        "step": 1.0,
        "longest": 5,
        "capacity": 6,
        "mask_box": LINE,
        "box": LINE,
        "shift": 0.0,
        "delta": 1.0,
        "thresholds": Thresholds(alpha=0.01, stop=1e-4, weight=0.3),
    }
    return find_samples(**(arguments | changed))


def test_by_hand() -> None:
    found = along_x()
    # The empty sample and the one behind the opaque one are dropped.
    assert found.ray.tolist() == [0, 0, 0, 2, 2, 2]
    assert found.distance.tolist() == [1, 2, 3, 0, 0, 0]
    assert found.points[:3].tolist() == [[1, 0, 0], [2, 0, 0], [3, 0, 0]]
    # Weights 0.5, 0.25, 0.25.
    assert found.significant.tolist() == [True, False, False, False, False, False]
    assert found.first.tolist() == [0, 3, 3]
    assert found.total == 3 and not found.overflow


def test_unoccupied_samples_do_not_hide_others() -> None:
    # Without the opaque cell the last sample is visible, at a transmittance of 1/4.
    mask = torch.ones(5, 2, 2, dtype=torch.bool)
    mask[3] = False
    found = along_x(mask=mask, thresholds=Thresholds(alpha=0.01, stop=0.25, weight=0.125))
    assert found.distance[:3].tolist() == [1, 2, 4]
    assert found.significant[:3].all()


def test_densities_are_read_at_displaced_points() -> None:
    # Each point is moved by 1 along x.
    ahead = torch.tensor([1.0, 0.0, 0.0]).expand(2, 2, 2, 3).contiguous()
    assert along_x(slices=[ahead]).distance[:3].tolist() == [0, 1, 2]
    halves = [torch.zeros(2, 2, 2, 3), 2 * ahead]
    assert along_x(slices=halves, weight=0.5).distance[:3].tolist() == [0, 1, 2]


@pytest.mark.parametrize("capacity", [0, 2])
def test_what_does_not_fit_is_dropped_with_overflow(capacity: int) -> None:
    found = along_x(capacity=capacity)
    assert found.distance.tolist() == [1, 2, 3][:capacity]
    assert found.first.tolist() == [0, capacity, capacity]
    assert found.total == 3 and found.overflow
    longer = along_x(longest=2)
    assert longer.total == 1 and longer.overflow
