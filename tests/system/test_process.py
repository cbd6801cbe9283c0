"""Settings of the C library and the system for a process that trains."""

from __future__ import annotations

import mmap
import os
import sys

import pytest

from devrf.artifacts.records import peak_host_memory
from devrf.system.process import forget_peak_memory, tune_for_cpu


@pytest.fixture(autouse=True)
def own_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("GOMP_SPINCOUNT", "OMP_WAIT_POLICY"):
        monkeypatch.setenv(name, "")
        monkeypatch.delenv(name)


def test_threads_spin_briefly() -> None:
    tune_for_cpu()
    assert os.environ["GOMP_SPINCOUNT"] == "1000"


@pytest.mark.parametrize("name", ["GOMP_SPINCOUNT", "OMP_WAIT_POLICY"])
def test_what_the_user_has_set_stays(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(name, "ACTIVE")
    tune_for_cpu()
    assert os.environ[name] == "ACTIVE"
    assert len({"GOMP_SPINCOUNT", "OMP_WAIT_POLICY"} & set(os.environ)) == 1


@pytest.mark.skipif(sys.platform != "linux", reason="the system cannot forget")
def test_a_peak_that_is_past_is_forgotten() -> None:
    size = 256 * 2**20
    with mmap.mmap(-1, size) as memory:
        for start in range(0, size, mmap.PAGESIZE):
            memory[start] = 1
    before = peak_host_memory()
    forget_peak_memory()
    after = peak_host_memory()
    assert before is not None and after is not None
    assert after < before
