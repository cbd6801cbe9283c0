"""The check that a device must pass finds a broken kernel and leaves no trace."""

from __future__ import annotations

import logging

import pytest
import torch
from torch import Tensor

from devrf.errors import DevrfError
from devrf.ops import dispatch, selfcheck
from devrf.ops.dispatch import passes_check
from devrf.ops.selfcheck import check_kernels


@pytest.fixture(autouse=True)
def unchecked() -> None:
    passes_check.cache_clear()


def test_the_kernels_pass_and_random_numbers_go_on(device: torch.device) -> None:
    state = torch.get_rng_state()
    check_kernels(device)
    assert torch.equal(torch.get_rng_state(), state)


def test_it_passes_in_inference_mode(device: torch.device, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(selfcheck, "CASES", (selfcheck.interpolation,))
    with torch.inference_mode():
        check_kernels(device)


def test_a_broken_kernel_is_found_and_pytorch_runs_instead(
    device: torch.device, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    from devrf.ops.kernels import compositing

    def askew(depth: Tensor, first: Tensor) -> tuple[Tensor, Tensor]:
        weights, end = right(depth, first)
        return 1.01 * weights, end

    right = compositing.Composite.apply
    monkeypatch.setattr(compositing.Composite, "apply", askew)
    monkeypatch.setattr(selfcheck, "CASES", (selfcheck.compositing,))
    with pytest.raises(DevrfError, match="compositing: off by 0.00"):
        check_kernels(device)
    with caplog.at_level(logging.WARNING, logger=dispatch.__name__):
        assert not passes_check(device) and not passes_check(device)
    (record,) = caplog.records
    assert "compositing: off by" in record.getMessage()
