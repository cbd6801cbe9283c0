"""Which implementation runs, and which error is raised where Triton cannot."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from typing import Any

import pytest
import torch

from devrf.errors import DevrfError
from devrf.ops import dispatch
from devrf.ops.dispatch import accelerated, rejected, triton_runs, using

CPU = torch.zeros(1)


@pytest.fixture(autouse=True)
def unchecked(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """No device has been checked yet, and Triton's interpreter is off."""
    monkeypatch.delenv("TRITON_INTERPRET")
    rejected.cache_clear()
    yield
    rejected.cache_clear()


class OnGpu:
    """The attributes of a tensor on a GPU that the dispatch reads."""

    is_cuda = True
    device = torch.device("cuda", 0)

    def __init__(self, dtype: torch.dtype = torch.float32) -> None:
        self.dtype = dtype


def test_on_a_gpu_it_is_triton_where_the_check_passes(monkeypatch: pytest.MonkeyPatch) -> None:
    checked: list[torch.device] = []
    monkeypatch.setattr(dispatch, "_checks", [lambda device: checked.append(device) or {}])
    gpu: Any = OnGpu()
    assert triton_runs(gpu) and triton_runs(gpu)
    assert checked == [gpu.device]
    assert not triton_runs(OnGpu(torch.float64))  # type: ignore[arg-type]


def test_where_the_order_of_sums_must_be_fixed_it_is_pytorch(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(dispatch, "_checks", [])
    gpu: Any = OnGpu()
    assert triton_runs(gpu)
    monkeypatch.setattr(torch, "are_deterministic_algorithms_enabled", lambda: True)
    assert not triton_runs(gpu)
    with using("triton"), pytest.raises(DevrfError, match="no fixed order.*deterministic=false"):
        triton_runs(gpu)


def test_what_fails_its_check_runs_in_pytorch_with_one_warning(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    # Nothing is imported: with the interpreter off the kernels would stay compiled.
    monkeypatch.setattr(dispatch, "import_module", lambda name: name)
    reasons = {"motion": "off by 1", "photometric": "off by 1"}
    monkeypatch.setattr(dispatch, "_checks", [lambda device: reasons])
    gpu: Any = OnGpu()
    with caplog.at_level(logging.WARNING):
        assert not any(accelerated("motion", gpu) for _ in range(3))
    (record,) = caplog.records
    assert "plain PyTorch runs on cuda:0 for motion, photometric" in record.getMessage()
    assert accelerated("trilinear", gpu) == "devrf.accel.trilinear"
    # Lists of fixed length need the search and Adam.
    assert triton_runs(gpu)
    rejected.cache_clear()
    reasons["search"] = "off by 2"
    assert not triton_runs(gpu)


def test_the_chosen_implementation_holds_inside_the_context_only(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(dispatch, "reaches", lambda device: True)
    monkeypatch.setattr(dispatch, "find_spec", lambda name: True)
    with using("triton"):
        assert triton_runs(CPU)
        with using("torch"):
            assert not triton_runs(OnGpu())  # type: ignore[arg-type]
        assert triton_runs(CPU)
    assert not triton_runs(CPU)
    with pytest.raises(DevrfError, match="kernels: expected auto, torch or triton, not 'cuda'"):
        using("cuda").__enter__()  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("tensor", "installed", "expected"),
    [
        (CPU, True, "needs a CUDA device, and these tensors are on the cpu: choose kernels=auto"),
        (OnGpu(torch.float64), True, "float32, not on torch.float64"),
        (CPU, None, "triton is not installed: pip install triton"),
    ],
)
def test_triton_that_cannot_run_is_refused_with_the_reason(
    monkeypatch: pytest.MonkeyPatch, tensor: torch.Tensor, installed: bool | None, expected: str
) -> None:
    monkeypatch.setattr(dispatch, "find_spec", lambda name: installed)
    with using("triton"), pytest.raises(DevrfError, match=f"kernels: .*{expected}"):
        triton_runs(tensor)
