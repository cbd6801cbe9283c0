"""Handlers of the signals that ask a run to end."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import NoReturn

# Ctrl-C, the system's request to end, and what SLURM sends some time before that.
NAMES = ("SIGINT", "SIGTERM", "SIGUSR1", "SIGUSR2")
STOP_SIGNALS = tuple(getattr(signal, name) for name in NAMES if hasattr(signal, name))

Answer = Callable[[int], None]


class Interrupted(SystemExit):
    """A signal has ended the run; the exit status is 128 plus its number, as in a shell.

    Attributes:
        said: the line for the user.
    """

    def __init__(
        self, number: int, said: str = "interrupted; run the same command again to go on"
    ) -> None:
        super().__init__(128 + number)
        self.said = said


def end_at_once(number: int) -> NoReturn:
    """End the run at once, by raising Interrupted; half-written files are removed."""
    raise Interrupted(number)


class _Handler:
    """A handler that an inner block recognises and may replace."""

    def __init__(self, answer: Answer) -> None:
        self.answer = answer

    def __call__(self, number: int, frame: FrameType | None) -> None:
        self.answer(number)


@contextmanager
def handle_signals(answer: Answer) -> Iterator[Callable[[], None]]:
    """Handle signals by ``answer(number)`` within the block; earlier handlers return after it.

    A signal that is ignored or has another program's handler keeps it: launchers requeue their
    jobs by handlers of their own. Of no effect outside the main thread.

    Yields:
        A function that takes the signals back from a library that has replaced the handler.
    """
    handler = _Handler(answer)
    before = {number: signal.getsignal(number) for number in STOP_SIGNALS}
    if threading.current_thread() is not threading.main_thread():
        before = {}
    defaults = (signal.SIG_DFL, signal.default_int_handler)
    taken = {n: was for n, was in before.items() if was in defaults or isinstance(was, _Handler)}

    def take() -> None:
        for number in taken:
            signal.signal(number, handler)

    take()
    try:
        yield take
    finally:
        for number, was in taken.items():
            signal.signal(number, was)
