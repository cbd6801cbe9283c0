"""A process that trains: its settings, and signals, which the innermost block handles."""

from __future__ import annotations

import gc
import mmap
import os
import signal
import sys
from collections.abc import Iterator

import pytest

from devrf.apps.records import peak_host_memory
from devrf.system.process import (
    STOP_SIGNALS,
    Interrupted,
    end_at_once,
    forget_peak_memory,
    handle_signals,
    importing,
    tune_for_cpu,
)


@pytest.fixture(autouse=True)
def own_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("GOMP_SPINCOUNT", "OMP_WAIT_POLICY"):
        monkeypatch.setenv(name, "")
        monkeypatch.delenv(name)


def test_threads_spin_briefly_unless_the_user_has_set_something(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    tune_for_cpu()
    assert os.environ["GOMP_SPINCOUNT"] == "1000"
    monkeypatch.setenv("GOMP_SPINCOUNT", "ACTIVE")
    tune_for_cpu()
    assert os.environ["GOMP_SPINCOUNT"] == "ACTIVE"


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


@pytest.fixture(autouse=True)
def handlers_as_before() -> Iterator[None]:
    before = {number: signal.getsignal(number) for number in STOP_SIGNALS}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def send(*numbers: int) -> None:
    for number in numbers:
        os.kill(os.getpid(), number)


@pytest.mark.parametrize("number", STOP_SIGNALS)
def test_a_block_handles_signals_and_restores_the_handlers(number: int) -> None:
    before = signal.getsignal(number)
    heard: list[int] = []
    with handle_signals(heard.append):
        send(number)
    assert heard == [number]
    assert signal.getsignal(number) == before


def test_the_inner_block_comes_first() -> None:
    outer: list[int] = []
    inner: list[int] = []
    with handle_signals(outer.append):
        with handle_signals(inner.append):
            send(signal.SIGTERM)
        send(signal.SIGINT)
    assert (outer, inner) == ([signal.SIGINT], [signal.SIGTERM])


def test_other_programs_handlers_stay() -> None:
    theirs: list[int] = []
    ours: list[int] = []
    signal.signal(signal.SIGUSR2, lambda number, frame: theirs.append(number))
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with handle_signals(ours.append):
        send(signal.SIGUSR2, signal.SIGINT, signal.SIGTERM)
    assert (theirs, ours) == ([signal.SIGUSR2], [signal.SIGTERM])


def test_ending_at_once_has_the_status_of_a_shell() -> None:
    with pytest.raises(Interrupted) as caught, handle_signals(end_at_once):
        send(signal.SIGTERM)
    assert caught.value.code == 143
    assert not isinstance(caught.value, Exception)  # no handler of errors catches it
