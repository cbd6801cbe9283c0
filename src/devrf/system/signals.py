"""Signals that ask a run to end, and who answers them."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

# Ctrl-C, the system's request to end, and what SLURM sends some time before it does.
ASKING = tuple(
    getattr(signal, name)
    for name in ("SIGINT", "SIGTERM", "SIGUSR1", "SIGUSR2")
    if hasattr(signal, name)
)

Answer = Callable[[int], None]
Setting = Callable[[int, FrameType | None], Any] | int | None  # what Python keeps for a signal


class Interrupted(SystemExit):
    """A signal has ended the run; the exit status is 128 plus its number, as in a shell.

    Attributes:
        said: what to tell the user, on one line.
    """

    def __init__(
        self, number: int, said: str = "interrupted; run the same command again to go on"
    ) -> None:
        super().__init__(128 + number)
        self.said = said


def end_at_once(number: int) -> None:
    """Answer a signal by ending the run where it stands; what is half-written vanishes.

    Raises:
        Interrupted: always.
    """
    raise Interrupted(number)


class _Handler:
    def __init__(self, answer: Answer) -> None:
        self.answer = answer

    def __call__(self, number: int, frame: FrameType | None) -> None:
        self.answer(number)


@contextmanager
def answered_by(answer: Answer) -> Iterator[Callable[[], None]]:
    """Answer signals by ``answer(number)`` within the block; what answered before returns after.

    A signal that somebody else answers, or that is ignored, stays theirs: a launcher that
    requeues its job does it by a handler of its own. Of no effect outside the main thread.

    Yields:
        A function that takes the block's signals back, should a library have taken them since.
    """
    taken: dict[int, Setting] = {}
    if threading.current_thread() is threading.main_thread():
        for number in ASKING:
            before = signal.getsignal(number)
            free = before in (signal.SIG_DFL, signal.default_int_handler)
            if free or isinstance(before, _Handler):
                taken[number] = before
    handler = _Handler(answer)

    def take() -> None:
        for number in taken:
            signal.signal(number, handler)

    take()
    try:
        yield take
    finally:
        for number, before in taken.items():
            signal.signal(number, before)
