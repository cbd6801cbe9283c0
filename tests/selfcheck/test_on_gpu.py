"""What only a device shows: ``TRITON_INTERPRET=0 pytest -m gpu`` on a machine with a GPU."""

from __future__ import annotations

import multiprocessing
import pickle
from pathlib import Path

import pytest
import torch

from devrf.engine.frame_store import FrameStore
from devrf.selfcheck.bench import ON_GPU, small_scene
from devrf.selfcheck.checks import CHECKS
from devrf.selfcheck.isolation import isolated
from devrf.selfcheck.runner import perform

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU"),
]


@pytest.fixture(scope="module")
def scene() -> bytes:
    """The small scene, pickled."""
    return pickle.dumps(small_scene(ON_GPU))


@pytest.fixture(scope="module")
def curves() -> dict[str, dict[str, object]]:
    """Figures of the checks so far, by name."""
    return {}


@pytest.mark.parametrize("name", [check.name for check in CHECKS])
def test_a_check_holds(
    name: str, scene: bytes, curves: dict[str, dict[str, object]], tmp_path: Path
) -> None:
    device = torch.device("cuda", 0)
    (check,) = [check for check in CHECKS if check.name == name]
    if reason := check.left_out(device):
        pytest.skip(reason)
    # This process may have called CUDA: one that was forked from it could not.
    spawn, log = multiprocessing.get_context("spawn"), tmp_path / "log"
    found = isolated(spawn, perform, (name, device, ON_GPU, scene, 0, curves), log, 300)
    curves[name] = found.figures
    assert found.held, f"{found.said}\n{log.read_text()}"


@pytest.mark.parametrize("half", [False, True])
def test_frames_on_the_host_are_page_locked_and_come_back_as_they_were(half: bool) -> None:
    device = torch.device("cuda", 0)
    store = FrameStore(3, (4, 5, 6)).to(device)
    store.offload(on_host=True, half=half)
    assert store.to_time.is_pinned() and store.to_canonical.is_pinned()
    written = tuple(torch.rand(4, 5, 6, 3, device=device) for _ in range(2))
    store.write(1, written)  # type: ignore[arg-type]
    store.synchronize()
    store.prefetch([1])
    found = torch.empty(4, 5, 6, 3, device=device), torch.empty(4, 5, 6, 3, device=device)
    store.read(1, found)
    for ours, theirs in zip(found, written, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1 / 2048 if half else 0, atol=1e-7)
    store.resize((6, 6, 6))
    assert store.to_time.shape == (3, 6, 6, 6, 3) and store.to_time.is_pinned()
