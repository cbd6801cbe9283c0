"""Signals are handled by the innermost block, unless another program handles them."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator

import pytest

from devrf.system.signals import STOP_SIGNALS, Interrupted, end_at_once, handle_signals


@pytest.fixture(autouse=True)
def as_before() -> Iterator[None]:
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


def test_signals_are_taken_back_from_a_library() -> None:
    heard: list[int] = []
    with handle_signals(heard.append) as take:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        take()
        send(signal.SIGTERM)
    assert heard == [signal.SIGTERM]


def test_outside_the_main_thread_nothing_is_taken() -> None:
    found: list[object] = []

    def work() -> None:
        with handle_signals(end_at_once):
            found.append(signal.getsignal(signal.SIGTERM))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert found == [signal.getsignal(signal.SIGTERM)]


def test_ending_at_once_has_the_status_of_a_shell() -> None:
    with pytest.raises(Interrupted) as caught, handle_signals(end_at_once):
        send(signal.SIGTERM)
    assert caught.value.code == 143
    assert not isinstance(caught.value, Exception)  # no handler of errors catches it
