"""Free memory by the system and its control groups, how a lack shows."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from types import SimpleNamespace

import psutil
import pytest
import torch

from devrf.system.memory import (
    free_cache,
    free_host_memory,
    gib,
    is_oom,
    numbers,
    own_memory,
)
from devrf.system.process import tune_for_cpu

MIB = 2**20
GPU = "CUDA out of memory. Tried to allocate 20.00 MiB. GPU 0 has a total capacity of 23.68 GiB"
HOST = "DefaultCPUAllocator: can't allocate memory: you tried to allocate 1073741824 bytes. Error"


@pytest.fixture
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A machine with 900 MiB available, in no control group."""
    (tmp_path / "proc" / "self").mkdir(parents=True)
    monkeypatch.setattr(psutil, "virtual_memory", lambda: SimpleNamespace(available=900 * MIB))
    return tmp_path


def group(folder: Path, limit: str, used: int, cached: int) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "memory.max").write_text(f"{limit}\n")
    (folder / "memory.current").write_text(f"{used * MIB}\n")
    (folder / "memory.stat").write_text(f"anon 5\ninactive_file {cached * MIB}\n")


def test_a_control_group_leaves_less_than_the_system(root: Path) -> None:
    assert free_host_memory(root) == 900 * MIB
    (root / "proc" / "self" / "cgroup").write_text("0::/jobs/mine\n")
    mount = root / "sys" / "fs" / "cgroup"
    group(mount / "jobs" / "mine", "max", 100, 0)
    assert free_host_memory(root) == 900 * MIB
    # The limit of the group around it: 500 used, 200 of that only cached.
    group(mount / "jobs", str(800 * MIB), 500, 200)
    assert free_host_memory(root) == 500 * MIB
    group(mount / "jobs" / "mine", str(300 * MIB), 310, 0)
    assert free_host_memory(root) == 0


def test_a_container_sees_its_own_group_as_the_root(root: Path) -> None:
    (root / "proc" / "self" / "cgroup").write_text("0::/\n")
    group(root / "sys" / "fs" / "cgroup", str(400 * MIB), 100, 0)
    assert free_host_memory(root) == 300 * MIB


@pytest.mark.parametrize(
    ("error", "short"),
    [
        (torch.OutOfMemoryError(GPU), True),
        (MemoryError(), True),
        (RuntimeError("CUDA error: CUBLAS_STATUS_ALLOC_FAILED when calling"), True),
        (RuntimeError("could not create a primitive"), True),
        (RuntimeError("mat1 and mat2 shapes cannot be multiplied"), False),
        (ValueError("out of memory"), False),
    ],
)
def test_what_is_out_of_memory(error: BaseException, short: bool) -> None:
    assert is_oom(error) is short


def test_what_torch_itself_says_is_understood() -> None:
    with pytest.raises(RuntimeError) as caught:
        torch.empty(2**60, dtype=torch.uint8)
    assert is_oom(caught.value)
    assert numbers(str(caught.value), torch.device("cpu")).startswith("1073741824.0 GiB more asked")


@pytest.mark.parametrize(
    ("said", "asked"), [(GPU, "0.02 GiB more asked, "), (HOST, "1.0 GiB more asked, "), ("", "")]
)
def test_the_numbers_of_an_error(said: str, asked: str) -> None:
    words = numbers(said, torch.device("cpu"))
    assert re.fullmatch(rf"{asked}[\d.]+ GiB free on cpu", words)


def test_bytes_in_gib() -> None:
    assert [gib(n * 2**30) for n in (21.34, 1.16, 0.0342)] == ["21.3", "1.2", "0.034"]


@pytest.mark.skipif(sys.platform != "linux", reason="another C library")
def test_what_the_c_library_keeps_is_freed() -> None:
    tune_for_cpu()
    filled = [torch.ones(2**21) for _ in range(16)]  # of 8 MiB, in the heap
    last = torch.ones(2**18)  # so that what is freed is not the heap's end
    del filled
    kept = own_memory()
    free_cache(torch.device("cpu"))
    assert kept - own_memory() > 100 * MIB
    assert last.all()
