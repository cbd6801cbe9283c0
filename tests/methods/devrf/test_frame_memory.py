"""Memory of displacements, counted by hand."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from devrf.methods.devrf.deformation_schedule import DeformationSchedule, Level
from devrf.methods.devrf.frame_memory import (
    active_bytes,
    fits_on_device,
    resident_bytes,
    rest_on_host,
)
from devrf.methods.devrf.model import DeVRFModel
from devrf.methods.devrf.settings import MotionSettings

PAPER = (160, 160, 160)


def test_fifty_frames_of_the_paper() -> None:
    # 50 x 160^3 displacements of 12 bytes: 2.46 GB in each direction.
    assert resident_bytes(50, PAPER, False) == 2 * 50 * 160**3 * 12 == 2 * 2_457_600_000
    assert resident_bytes(50, PAPER, True) == 2_457_600_000


def test_a_frame_that_is_learned() -> None:
    # Values 3, gradients 2, moments 4, copy 2.
    assert active_bytes((2, 3, 4)) == 11 * 24 * 12


@pytest.mark.parametrize(
    ("gigabytes", "half", "parallel", "fits"),
    [(6, False, 1, False), (8, False, 1, True), (6, True, 1, True), (8, False, 3, False)],
)
def test_a_quarter_of_the_gpu_is_left(
    gigabytes: int, half: bool, parallel: int, fits: bool
) -> None:
    # 4.9 GB of frames, or 2.5 in half precision, and 0.54 for each that is learned.
    free = gigabytes * 10**9
    assert fits_on_device(free, 50, PAPER, half=half, parallel=parallel) is fits


# Of three frames in two directions, at most 20^3 voxels of 12 bytes: 0.58 MB.
SCHEDULE = DeformationSchedule(levels=(Level(4, 1), Level(20, 1)))


@pytest.fixture
def rests(moving: DeVRFModel, monkeypatch: pytest.MonkeyPatch) -> Callable[..., bool]:
    """``rests(store, device, free, …)``: whether frames rest on the host."""

    def found(store: Any, device: str, free: int = 0, *, processes: int = 1, half: Any = "auto"):
        monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: (free, 2 * free))
        strategy = SimpleNamespace(root_device=torch.device(device))
        trainer: Any = SimpleNamespace(strategy=strategy, world_size=processes)
        motion = MotionSettings(store=store, store_half=half)
        return rest_on_host(trainer, moving, SCHEDULE, motion)

    return found


def test_where_it_was_asked_for(rests: Callable[..., bool]) -> None:
    assert rests("host", "cpu") and rests("host", "cuda", 10**9)
    assert not rests("device", "cuda", 0) and not rests("auto", "cpu")
    # Each of several processes keeps them on its device.
    assert not rests("host", "cuda", 0, processes=2)


def test_on_the_device_if_there_is_room(rests: Callable[..., bool]) -> None:
    assert not rests("auto", "cuda", 2_600_000)
    assert rests("auto", "cuda", 1_900_000, half=False)
    assert not rests("auto", "cuda", 1_900_000, half=True)
    # Half precision is a GPU's default.
    assert not rests("auto", "cuda", 1_900_000)
