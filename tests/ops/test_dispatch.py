"""Which implementation runs, and which error is raised where Triton cannot."""

from __future__ import annotations

import ast
import logging
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from devrf.errors import DevrfError
from devrf.ops import dispatch
from devrf.ops.dispatch import passes_check, triton_runs, using

CPU = torch.zeros(1)


@pytest.fixture(autouse=True)
def unchecked(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """No device has been checked yet, and Triton's interpreter is off."""
    monkeypatch.delenv("TRITON_INTERPRET")
    passes_check.cache_clear()
    yield
    passes_check.cache_clear()


class OnGpu:
    """The attributes of a tensor on a GPU that the dispatch reads."""

    is_cuda = True
    device = torch.device("cuda", 0)

    def __init__(self, dtype: torch.dtype = torch.float32) -> None:
        self.dtype = dtype


def test_on_a_gpu_it_is_triton_where_the_check_passes(monkeypatch: pytest.MonkeyPatch) -> None:
    looked: list[torch.device] = []
    monkeypatch.setattr(dispatch, "_checks", [looked.append])
    gpu = OnGpu()
    assert triton_runs(gpu) and triton_runs(gpu)  # type: ignore[arg-type]
    assert looked == [gpu.device]
    assert not triton_runs(OnGpu(torch.float64))  # type: ignore[arg-type]


def test_where_the_order_of_sums_must_be_fixed_it_is_pytorch(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(dispatch, "passes_check", lambda device: True)
    assert triton_runs(OnGpu())  # type: ignore[arg-type]
    monkeypatch.setattr(torch, "are_deterministic_algorithms_enabled", lambda: True)
    assert not triton_runs(OnGpu())  # type: ignore[arg-type]
    with using("triton"), pytest.raises(DevrfError, match="no fixed order.*deterministic=false"):
        triton_runs(OnGpu())  # type: ignore[arg-type]


def test_a_failed_check_is_logged_once(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def broken(device: torch.device) -> None:
        raise RuntimeError("no compiler\nmany lines")

    monkeypatch.setattr(dispatch, "_checks", [broken])
    with caplog.at_level(logging.WARNING):
        assert not any(triton_runs(OnGpu()) for _ in range(3))  # type: ignore[arg-type]
    (record,) = caplog.records
    assert "plain PyTorch runs on cuda:0" in record.getMessage()
    assert record.getMessage().endswith("(RuntimeError: no compiler)")


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


def test_nothing_loads_triton_before_it_is_needed() -> None:
    modules = sorted(Path(dispatch.__file__).parent.glob("*.py"))
    assert len(modules) > 5
    for module in modules:
        for statement in ast.parse(module.read_text()).body:
            if isinstance(statement, ast.Import):
                assert not any("triton" in name.name for name in statement.names), module
            if isinstance(statement, ast.ImportFrom):
                assert "kernels" not in str(statement.module), module
