"""Signals are answered by a block of ours, unless another program's handler does."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from typing import Any

import pytest

from devrf.system.signals import STOP_SIGNALS, Interrupted, answered_by, end_at_once


@pytest.fixture(autouse=True)
def as_before() -> Iterator[None]:
    before = {number: signal.getsignal(number) for number in STOP_SIGNALS}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def send(number: int) -> None:
    os.kill(os.getpid(), number)


@pytest.mark.parametrize("number", STOP_SIGNALS)
def test_the_block_answers_and_gives_back(number: int) -> None:
    before, heard = signal.getsignal(number), []
    with answered_by(heard.append):
        send(number)
    assert heard == [number]
    assert signal.getsignal(number) == before


def test_a_block_within_answers_first() -> None:
    outer: list[int] = []
    inner: list[int] = []
    with answered_by(outer.append):
        with answered_by(inner.append):
            send(signal.SIGTERM)
        send(signal.SIGINT)
    assert (outer, inner) == ([signal.SIGINT], [signal.SIGTERM])


def test_what_others_answer_or_ignore_stays_theirs() -> None:
    theirs: list[int] = []
    ours: list[int] = []
    signal.signal(signal.SIGUSR2, lambda number, frame: theirs.append(number))
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with answered_by(ours.append):
        send(signal.SIGUSR2)
        send(signal.SIGINT)
        send(signal.SIGTERM)
    assert (theirs, ours) == ([signal.SIGUSR2], [signal.SIGTERM])


def test_signals_are_taken_back_from_a_library_that_took_them() -> None:
    heard: list[int] = []
    with answered_by(heard.append) as take:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        take()
        send(signal.SIGTERM)
    assert heard == [signal.SIGTERM]


def test_outside_the_main_thread_nothing_is_taken() -> None:
    found: list[Any] = []

    def work() -> None:
        with answered_by(end_at_once):
            found.append(signal.getsignal(signal.SIGTERM))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert found == [signal.getsignal(signal.SIGTERM)]


def test_ending_at_once_has_the_status_of_a_shell() -> None:
    with pytest.raises(Interrupted) as caught, answered_by(end_at_once):
        send(signal.SIGTERM)
    assert caught.value.code == 143
    assert not isinstance(caught.value, Exception)  # so no handler of faults or mistakes catches it
