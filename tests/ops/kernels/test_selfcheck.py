"""The check that a device must pass finds a broken kernel and leaves no trace."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from devrf.errors import DevrfError
from devrf.ops import selfcheck
from devrf.ops.dispatch import passes_check
from devrf.ops.selfcheck import check_kernels


@pytest.fixture(autouse=True)
def unchecked() -> None:
    passes_check.cache_clear()


@pytest.mark.parametrize("inference", [False, True])
def test_the_kernels_pass_and_random_numbers_go_on(device: torch.device, inference: bool) -> None:
    state = torch.get_rng_state()
    with torch.inference_mode(inference):
        check_kernels(device)
    assert torch.equal(torch.get_rng_state(), state)


def test_a_broken_kernel_is_found(device: torch.device, monkeypatch: pytest.MonkeyPatch) -> None:
    from devrf.ops.kernels import compositing

    def askew(depth: Tensor, first: Tensor) -> tuple[Tensor, Tensor]:
        weights, end = right(depth, first)
        return 1.01 * weights, end

    right = compositing.Composite.apply
    monkeypatch.setattr(compositing.Composite, "apply", askew)
    monkeypatch.setattr(selfcheck, "CASES", (selfcheck.compositing,))
    with pytest.raises(DevrfError, match="compositing: off by 0.00"):
        check_kernels(device)
    assert not passes_check(device)
