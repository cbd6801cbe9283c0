"""Settings of the C library and the system for a process that trains."""

from __future__ import annotations

import gc
import mmap
import os
import sys
from types import ModuleType

import pytest

from devrf.apps.records import peak_host_memory
from devrf.system.process import forget_peak_memory, importing, tune_for_cpu


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


@pytest.mark.parametrize("before", [True, False])
def test_while_modules_are_imported_no_garbage_is_looked_for(before: bool) -> None:
    enabled = gc.isenabled()
    try:
        (gc.enable if before else gc.disable)()
        with pytest.raises(ImportError), importing():
            assert not gc.isenabled()
            raise ImportError
        assert gc.isenabled() is before
    finally:
        (gc.enable if enabled else gc.disable)()


def test_new_modules_are_left_alone_by_later_looks(monkeypatch: pytest.MonkeyPatch) -> None:
    def kept(name: str) -> bool:
        return not any(one is sys.modules[name] for one in gc.get_objects())

    monkeypatch.setitem(sys.modules, "known", ModuleType("known"))
    with importing():
        pass
    assert not kept("known")
    with importing():
        monkeypatch.setitem(sys.modules, "new", ModuleType("new"))
    assert kept("new")
