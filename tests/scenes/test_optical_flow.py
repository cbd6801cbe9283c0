"""Estimated flow: a known shift is found again, and kept in a file."""

from __future__ import annotations

import pytest
import torch
from torch.nn.functional import interpolate

from devrf.geometry.cameras import Cameras
from devrf.scenes import optical_flow
from devrf.scenes.optical_flow import consistent, estimate_flow
from devrf.scenes.scene import Views

SHIFT = torch.tensor([3.0, -2.0])


def views_of(pixels: torch.Tensor, times: list[float], view: list[int]) -> Views:
    count, height, width = pixels.shape[:3]
    where = torch.tensor([[4.0, 0, 0]]).repeat(count, 1)
    cameras = Cameras.looking_at(where, where * 0, focal=50, width=width, height=height)
    names = tuple(str(i) for i in range(count))
    return Views(pixels, cameras, torch.tensor(times), torch.tensor(view), names)


def texture(height: int, width: int) -> torch.Tensor:
    """Smooth random colours (height, width, 3) uint8."""
    noise = torch.rand((1, 3, height // 6, width // 6), generator=torch.manual_seed(0))
    smooth = interpolate(noise, size=(height, width), mode="bicubic")[0].clamp(0, 1)
    return (smooth * 255).byte().permute(1, 2, 0)


def shifting(height: int, width: int, alpha: bool = False) -> Views:
    """A view of three frames: the texture moves by SHIFT (x, y) from one to the next."""
    canvas = texture(height + 20, width + 20)
    x, y = (int(v) for v in SHIFT)
    frames = [
        canvas[10 - k * y : 10 - k * y + height, 10 - k * x : 10 - k * x + width] for k in range(3)
    ]
    pixels = torch.stack(frames)
    if alpha:
        matte = torch.zeros((3, height, width, 1), dtype=torch.uint8)
        matte[:, 20:-20, 20:-20] = 255
        pixels = torch.cat([pixels, matte], dim=-1)
    return views_of(pixels, [0.0, 0.5, 1.0], [0, 0, 0])


def test_forward_flow_leads_to_the_next_frame_and_is_kept_apart(tmp_path):
    views = shifting(64, 96)
    flow = estimate_flow(views, "dis", tmp_path / "flow.npz", forward=True)
    assert not flow.valid[2].any() and bool((flow.vectors[2] == 0).all())
    inner = (slice(0, 2), slice(12, -12), slice(12, -12))
    assert float(flow.valid[inner].float().mean()) > 0.95
    assert float((flow.vectors[inner] - SHIFT)[flow.valid[inner]].norm(dim=-1).mean()) < 0.25
    # Backward flow does not take the file of the forward one for its own.
    assert estimate_flow(views, "dis", tmp_path / "flow.npz").valid[2].any()


def test_dis_recovers_a_known_shift():
    flow = estimate_flow(shifting(64, 96), "dis")
    assert not flow.valid[0].any() and bool((flow.vectors[0] == 0).all())
    inner = (slice(1, None), slice(12, -12), slice(12, -12))
    assert float(flow.valid[inner].float().mean()) > 0.95
    error = (flow.vectors[inner] + SHIFT)[flow.valid[inner]].norm(dim=-1)
    assert float(error.mean()) < 0.25


def test_what_left_the_image_or_the_matte_is_not_valid():
    flow = estimate_flow(shifting(130, 180), "dis")
    # Columns 0–2 came in from the left, the last 2 rows from below.
    assert float(flow.valid[1:, :, :2].float().mean()) < 0.05
    assert float(flow.valid[1:, -1:].float().mean()) < 0.05
    matted = shifting(130, 180, alpha=True)
    valid = estimate_flow(matted, "dis").valid
    assert not bool(valid[matted.pixels[..., 3] == 0].any())


def test_a_vector_is_trusted_when_the_way_back_closes():
    backward = torch.zeros((4, 9, 2))
    backward[..., 0] = 2.0
    forward = -backward
    forward[1, :, 0] += 1.05  # misses by 1.05 < 1 + 5 % of 2
    forward[2, :, 0] += 1.2
    valid = consistent(backward, forward)
    assert valid.tolist() == [
        [True] * 7 + [False] * 2,  # the last two columns end outside
        [True] * 7 + [False] * 2,
        [False] * 9,
        [True] * 7 + [False] * 2,
    ]


def fake(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """An estimator that counts its calls and finds no motion."""
    calls: list[int] = []

    def between(image: torch.Tensor, other: torch.Tensor) -> torch.Tensor:
        calls.append(1)
        return torch.zeros((*image.shape[:2], 2))

    monkeypatch.setattr(optical_flow, "estimator", lambda method: between)
    return calls


def test_the_cache_spares_a_second_estimate(tmp_path, monkeypatch):
    calls, cache = fake(monkeypatch), tmp_path / "run" / "flow.npz"
    views = shifting(16, 24)
    first = estimate_flow(views, "dis", cache)
    again = estimate_flow(views, "dis", cache)
    assert len(calls) == 4  # two pairs, both ways, once
    assert torch.equal(first.vectors, again.vectors) and torch.equal(first.valid, again.valid)
    assert [p.name for p in cache.parent.iterdir()] == ["flow.npz"]  # no temporary file left


def test_foreign_and_damaged_caches_are_replaced(tmp_path, monkeypatch):
    calls, cache = fake(monkeypatch), tmp_path / "flow.npz"
    views = shifting(16, 24)
    estimate_flow(views, "dis", cache)
    estimate_flow(views, "raft", cache)
    assert len(calls) == 8
    for content in (b"", cache.read_bytes()[:-40]):
        cache.write_bytes(content)
        calls.clear()
        estimate_flow(views, "raft", cache)
        assert len(calls) == 4
