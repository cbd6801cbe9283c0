"""The search kernels against their PyTorch twin."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import astuple
from typing import Any

import pytest
import torch
from torch import Tensor

from devrf.geometry.box import Box
from devrf.ops.dispatch import using
from devrf.ops.search import PackedSamples, Thresholds, find_samples

Draw = Callable[..., Tensor]
Both = Callable[[Callable[[], tuple[Tensor, ...]]], None]

BOX = Box((-1.0, -0.8, -0.9), (0.9, 1.0, 0.7))
SMALLER = Box((-0.7, -0.8, -0.9), (0.9, 0.9, 0.5))


def search(
    draw: Draw, frames: int = 1, rays: int = 6, **changed: Any
) -> Callable[[], PackedSamples]:
    """A search along rays of up to 70 samples: none to three rounds of lanes."""
    arguments: dict[str, Any] = {
        "origins": 0.4 * draw(rays, 3),
        "directions": torch.nn.functional.normalize(draw(rays, 3), dim=1),
        "entry": -1 + 0.1 * draw(rays),
        "count": torch.tensor([32, 0, 70, 1, 40, 0]).to(draw(1).device)[:rays],
        "mask": draw(5, 4, 6) > -0.3,
        "density": 3 * draw(4, 3, 5, 1),
        "slices": [0.2 * draw(3, 4, 3, 3) for _ in range(frames)],
        "weight": 0.3,
        "step": 0.03,
        "longest": 70,
        "capacity": 200,
        "mask_box": SMALLER,
        "box": BOX,
        "shift": -1.0,
        "delta": 0.5,
        "thresholds": Thresholds(alpha=0.05, stop=1e-2, weight=0.1),
    }
    return lambda: find_samples(**(arguments | changed))


@pytest.mark.parametrize("frames", [0, 1, 2])
def test_the_same_samples(draw: Draw, agree: Both, frames: int) -> None:
    look = search(draw, frames)
    found = look()
    used, significant = int(found.first[-1]), int(found.significant.sum())
    assert 10 < used < 200 and 0 < significant < used and not found.overflow
    agree(lambda: astuple(look()))


@pytest.mark.parametrize("capacity", [0, 20])
def test_what_does_not_fit_is_dropped(draw: Draw, agree: Both, capacity: int) -> None:
    look = search(draw, 0, capacity=capacity)
    with using("triton"):
        found = look()
    assert found.overflow and found.total > capacity and found.first[-1] == capacity
    agree(lambda: astuple(look()))


def test_a_ray_longer_than_promised_is_cut(draw: Draw, agree: Both) -> None:
    look = search(draw, 0, 3, longest=40)
    with using("torch"):
        assert look().overflow
    agree(lambda: astuple(look()))


@pytest.mark.parametrize(
    ("rays", "occupied", "stop"),
    [(0, True, 0.01), (6, False, 0.01), (3, True, 0.0), (3, True, 1.0)],
    ids=["no rays", "nothing occupied", "rays never end", "rays end at once"],
)
def test_extremes(draw: Draw, agree: Both, rays: int, occupied: bool, stop: float) -> None:
    thresholds = Thresholds(alpha=0.02, stop=stop, weight=0.05)
    mask = draw(5, 4, 6) > (-0.3 if occupied else 2)
    look = search(draw, 1, rays, mask=mask, thresholds=thresholds)
    agree(lambda: astuple(look()))


def test_points_halfway_between_grid_points(draw: Draw, agree: Both, device: torch.device) -> None:
    # On a grid of unit cells the samples at 0.5, 1.5, … belong to the even grid point.
    cube = Box((0.0, 0.0, 0.0), (4.0, 4.0, 4.0))
    look = search(
        draw,
        0,
        1,
        mask_box=cube,
        box=cube,
        step=0.5,
        entry=torch.zeros(1, device=device),
        origins=torch.tensor([[0.5, 1.5, -1.0]], device=device),
        directions=torch.tensor([[0.0, 0.0, 1.0]], device=device),
        count=torch.tensor([14], device=device),
        mask=draw(5, 5, 5) > -0.2,
        thresholds=Thresholds(alpha=0.0, stop=0.0, weight=0.0),
    )
    agree(lambda: astuple(look()))
