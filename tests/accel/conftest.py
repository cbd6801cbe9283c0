"""Where kernels are tested: in Triton's interpreter on a CPU, or on a GPU."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence

import pytest
import torch
from torch import Tensor

from devrf.ops.check import Draw
from devrf.ops.dispatch import using

Both = Callable[[Callable[[], Sequence[Tensor]]], None]

collect_ignore = ["compile_launches.py"]


@pytest.fixture(scope="session")
def device() -> torch.device:
    """The device that the kernels run on."""
    pytest.importorskip("triton", reason="Triton is not installed")
    if os.environ["TRITON_INTERPRET"] == "1":
        return torch.device("cpu")
    if not torch.cuda.is_available():
        pytest.skip("TRITON_INTERPRET is not 1, and there is no GPU")
    return torch.device("cuda")


@pytest.fixture
def draw(device: torch.device) -> Draw:
    """``draw(*shape)``: numbers in [−1, 1] on the device."""
    return Draw(device, 1)


@pytest.fixture
def agree(device: torch.device) -> Both:
    """``agree(work)``: work gives the same tensors with both implementations."""

    def compare(work: Callable[[], Sequence[Tensor]]) -> None:
        with using("torch"):
            expected = work()
        with using("triton"):
            found = work()
        assert len(expected) == len(found)
        for ours, theirs in zip(found, expected, strict=True):
            torch.testing.assert_close(ours, theirs, rtol=1e-5, atol=2e-6)

    return compare
