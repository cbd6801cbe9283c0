"""Page-locked memory; CUDA's calls are stood in for."""

from __future__ import annotations

import pytest
import torch

from devrf.system.page_locked import page_locked


class Runtime:
    def __init__(self, status: int = 0) -> None:
        self.status = status
        self.locked: dict[int, int] = {}

    def cudaHostRegister(self, place: int, size: int, flags: int) -> int:  # noqa: N802
        if not self.status:
            self.locked[place] = size
        return self.status

    def cudaHostUnregister(self, place: int) -> int:  # noqa: N802
        del self.locked[place]
        return 0


@pytest.fixture
def runtime(monkeypatch: pytest.MonkeyPatch) -> Runtime:
    runtime = Runtime()
    monkeypatch.setattr(torch.cuda, "cudart", lambda: runtime)
    monkeypatch.setattr(torch.cuda, "synchronize", lambda: None)
    return runtime


@pytest.mark.parametrize("dtype", [torch.float32, torch.float16])
def test_as_much_is_locked_as_is_asked_for_until_the_last_view_goes(
    runtime: Runtime, dtype: torch.dtype
) -> None:
    tensor = page_locked((5, 7, 3), dtype)
    assert tensor.shape == (5, 7, 3) and tensor.dtype == dtype
    assert runtime.locked == {tensor.data_ptr(): 105 * dtype.itemsize}
    tensor[2] = 1.5
    view = tensor[2]
    del tensor
    assert len(runtime.locked) == 1 and bool((view == 1.5).all())
    del view
    assert runtime.locked == {}


def test_what_cannot_be_locked_is_an_error_and_given_back(runtime: Runtime) -> None:
    runtime.status = 2
    with pytest.raises(RuntimeError, match="CUDA does not lock 24 bytes \\(error 2\\)"):
        page_locked((2, 3), torch.float32)
    assert runtime.locked == {}


def test_nothing_locks_nothing(runtime: Runtime) -> None:
    assert page_locked((0, 3), torch.float32).shape == (0, 3)
    assert runtime.locked == {}
