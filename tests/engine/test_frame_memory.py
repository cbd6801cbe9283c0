"""Memory of displacements, counted by hand."""

from __future__ import annotations

import pytest

from devrf.engine.frame_store import (
    active_bytes,
    fits_on_device,
    resident_bytes,
)

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
