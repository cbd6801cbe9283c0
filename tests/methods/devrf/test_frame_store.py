"""The store of all frames' displacements: read, write, resize, offload; its memory by hand."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from devrf.methods.devrf.frame_store import FrameStore, fits_on_device

SHAPE = (3, 2, 4)
OTHERS = [0, 1, 3]


@pytest.fixture
def store() -> FrameStore:
    """Four frames; 1 to 3 filled at random, frame 0 as it was built."""
    store = FrameStore(4, SHAPE)
    store.backward_slices[1:].normal_()
    store.forward_slices[1:].normal_()
    return store


def both(store: FrameStore) -> tuple[Tensor, Tensor]:
    """Copies of all frames in both directions."""
    return store.backward_slices.clone(), store.forward_slices.clone()


def pair() -> tuple[Tensor, Tensor]:
    """Memory for a frame in both directions."""
    return torch.empty(*SHAPE, 3), torch.empty(*SHAPE, 3)


def test_a_frame_is_read_changed_and_written_back(store):
    (backward, forward), frame = both(store), pair()
    store.read(2, frame)
    assert torch.equal(frame[0], backward[2]) and torch.equal(frame[1], forward[2])
    frame[0].add_(1)
    assert torch.equal(store.backward_slices, backward)  # a copy, until it is written back
    store.write(2, frame)
    assert torch.equal(store.backward_slices[2], backward[2] + 1)
    assert torch.equal(store.backward_slices[OTHERS], backward[OTHERS])
    assert torch.equal(store.forward_slices, forward)


def test_a_frame_starts_from_the_one_before_it_in_both_directions(store):
    before = both(store)
    store.copy_previous(2)
    for now, was in zip(both(store), before, strict=True):
        assert torch.equal(now[2], was[1])
        assert torch.equal(now[OTHERS], was[OTHERS])
    # A copy, not a view.
    store.backward_slices[2] += 1
    assert torch.equal(store.backward_slices[1], before[0][1])


@pytest.mark.parametrize("half", [False, True])
def test_offloaded_frames_stay_as_they_are_and_are_read_in_single_precision(store, half):
    exact, frame = both(store), pair()
    store.offload(on_host=True, half=half)
    dtype = torch.float16 if half else torch.float32
    assert store.forward_slices.dtype == store.backward_slices.dtype == dtype
    store.read(3, frame)
    for found, whole in zip(frame, exact, strict=True):
        assert found.dtype == torch.float32
        torch.testing.assert_close(found, whole[3], rtol=1 / 2048 if half else 0, atol=1e-7)
    resting = store.forward_slices
    store.to(torch.float64)
    assert store.forward_slices is resting and store.here.dtype == torch.float64
    store.float().resize((5, 5, 5))
    assert store.forward_slices.shape == (4, 5, 5, 5, 3) and store.forward_slices.dtype == dtype


def test_a_stored_state_of_another_shape_is_taken(store):
    other = FrameStore(2, (5, 5, 5))
    other.load_state_dict(store.state_dict())
    assert torch.equal(other.forward_slices, store.forward_slices)
    assert torch.equal(other.backward_slices, store.backward_slices)


PAPER = (160, 160, 160)


@pytest.mark.parametrize(
    ("gigabytes", "half", "learned", "fits"),
    [
        (6, False, False, False),
        (7, False, False, True),
        (7, False, True, False),
        (4, True, True, True),
    ],
)
def test_a_quarter_of_the_gpu_is_left(gigabytes, half, learned, fits):
    # 2 · 50 · 160³ displacements of 12 bytes: 4.9 GB, or 2.5 in half precision. Of a frame that is
    # learned 11 grids (values 3, gradients 2, Adam's 4, a copy 2): 0.54 GB.
    free = int(gigabytes * 10**9)
    assert fits_on_device(free, 50, PAPER, half=half, learned=learned) is fits


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
@pytest.mark.parametrize("half", [False, True])
def test_frames_on_the_host_come_back_as_they_were(half):
    device = torch.device("cuda", 0)
    store = FrameStore(3, (4, 5, 6)).to(device)
    store.offload(on_host=True, half=half)
    assert store.forward_slices.device.type == store.backward_slices.device.type == "cpu"
    written = tuple(torch.rand(4, 5, 6, 3, device=device) for _ in range(2))
    store.write(1, written)  # type: ignore[arg-type]
    found = torch.empty(4, 5, 6, 3, device=device), torch.empty(4, 5, 6, 3, device=device)
    store.read(1, found)
    for ours, theirs in zip(found, written, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1 / 2048 if half else 0, atol=1e-7)
    store.resize((6, 6, 6))
    assert store.forward_slices.shape == (3, 6, 6, 6, 3)
    assert store.forward_slices.device.type == "cpu"
