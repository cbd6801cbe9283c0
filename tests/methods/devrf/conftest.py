"""A batch of rays by what a test cares about."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch

from devrf.data.batch import RayBatch
from devrf.geometry.rays import Rays


def batch_of(rays: Rays, **known: Any) -> RayBatch:
    """A batch of rays with what is ``known`` of them, and nothing else."""
    count = len(rays)
    usual: dict[str, Any] = {
        "color": torch.zeros(count, 3),
        "alpha": None,
        "background": torch.zeros(3),
        "time": torch.zeros(count),
        "frame": torch.zeros(count, dtype=torch.long),
        "image": torch.zeros(count, dtype=torch.long),
        "pixel": torch.zeros(count, 2),
        "flow": None,
        "flow_valid": None,
    }
    return RayBatch(rays, **{**usual, **known})


@pytest.fixture
def ray_batch() -> Callable[..., RayBatch]:
    """The function :func:`batch_of`."""
    return batch_of
