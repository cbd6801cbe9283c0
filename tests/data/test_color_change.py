"""How much colours change along the flow, on images whose motion and colours are known."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from devrf.data.color_change import color_change, color_drift
from devrf.geometry.cameras import Cameras
from devrf.scenes.scene import OpticalFlow, Views

SIDE, FRAMES, SPEED = 48, 7, 2


def moving_wave(fade: int = 0) -> Views:
    """One view of a smooth wave that moves SPEED pixels to the right and darkens each frame."""
    x = torch.arange(SIDE).float()
    rows = [
        128 + 60 * torch.sin((x - SPEED * k) * 2 * torch.pi / 24) - fade * k for k in range(FRAMES)
    ]
    pixels = torch.stack(rows)[:, None, :, None].expand(FRAMES, SIDE, SIDE, 3)
    vectors = torch.zeros(FRAMES, SIDE, SIDE, 2)
    vectors[1:, ..., 0] = -SPEED
    valid = torch.zeros(FRAMES, SIDE, SIDE, dtype=torch.bool)
    valid[1:, :, SPEED:] = True
    size = torch.full((FRAMES, 2), float(SIDE))
    cameras = Cameras(torch.eye(4)[:3].repeat(FRAMES, 1, 1), size, size / 2, SIDE, SIDE)
    return Views(
        pixels.round().to(torch.uint8).clone(),
        cameras,
        torch.linspace(0, 1, FRAMES),
        torch.zeros(FRAMES, dtype=torch.long),
        tuple(f"{k}" for k in range(FRAMES)),
        OpticalFlow(vectors, valid),
    )


def test_colours_that_move_do_not_change() -> None:
    assert color_change(moving_wave()) == pytest.approx(0.0, abs=2e-3)


def test_four_frames_of_fading_are_told() -> None:
    assert color_change(moving_wave(fade=5)) == pytest.approx(4 * 5 / 255, abs=2e-3)


def test_what_fades_drifts_in_proportion_to_the_recordings_length() -> None:
    # From four frames to the six that there are, 5 grey levels a frame, over six steps.
    assert color_drift(moving_wave(fade=5)) == pytest.approx(6 * 5 / 255, abs=4e-3)


def test_change_that_does_not_grow_with_time_is_no_drift() -> None:
    views = moving_wave()
    views.pixels[::2] += 10  # flickers: even frames are lighter
    assert color_change(views) == pytest.approx(0.0, abs=2e-3)
    assert color_drift(views) == pytest.approx(0.0, abs=4e-3)


def test_flow_that_is_not_valid_is_not_followed() -> None:
    views = moving_wave(fade=5)
    assert views.flow is not None
    views.pixels[:, : SIDE // 2] = 0  # this half does not fade, and its flow is unknown
    views.flow.valid[:, : SIDE // 2 + 8] = False
    views.flow.vectors[:, : SIDE // 2 + 8] = torch.nan
    assert color_change(views) == pytest.approx(4 * 5 / 255, abs=4e-3)


def test_without_flow_nothing_is_told() -> None:
    assert color_change(replace(moving_wave(), flow=None)) is None
    assert color_drift(replace(moving_wave(), flow=None)) is None
    still = moving_wave()
    assert still.flow is not None
    still.flow.valid[:] = False
    assert color_change(still) is None
