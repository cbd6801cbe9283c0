"""A bench as small as learning allows."""

from __future__ import annotations

import pytest
import torch

from devrf.scenes.scene import Scene
from devrf.selfcheck.bench import Bench, Size, small_scene

TINY = Size(24, 8, 3, 16, (4, 6), 192, 16, iterations=20)


@pytest.fixture(scope="session")
def bench_scene() -> Scene:
    """What the bench learns."""
    return small_scene(TINY)


@pytest.fixture
def bench(bench_scene: Scene) -> Bench:
    """A bench on the CPU, of twenty iterations a stage."""
    return Bench(torch.device("cpu"), TINY, bench_scene)
