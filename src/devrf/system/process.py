"""A process that trains: settings of the C library and the system, and signals that end it."""

from __future__ import annotations

import ctypes
import gc
import logging
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from types import FrameType
from typing import NoReturn

from devrf.errors import DevrfError

# glibc's malloc.h
M_TRIM_THRESHOLD, M_TOP_PAD, M_MMAP_THRESHOLD, M_ARENA_MAX = -1, -2, -3, -8
# Ctrl-C, the system's request to end, and SLURM's signals some time before that.
NAMES = ("SIGINT", "SIGTERM", "SIGUSR1", "SIGUSR2")
STOP_SIGNALS = tuple(getattr(signal, name) for name in NAMES if hasattr(signal, name))

Answer = Callable[[int], None]


def tune_for_cpu() -> None:
    """Keep threads from spinning long, freed memory from going back, and heaps from being many.

    Threads that wait by spinning, the default, are a hundred times slower on a busy machine;
    threads that sleep at once gain nothing over one thread; a short spin suits both. A training
    step frees and takes the same dozens of megabytes again and again: mapping and zeroing those
    pages anew would be a tenth of the run. Threads share two heaps, unless
    ``MALLOC_ARENA_MAX`` says otherwise: heaps of their own kept 0.06 to 0.14 GB of the
    quickstart's 1.2.

    The threads' waiting is fixed once torch is loaded; the rest has no effect unless the C library
    is glibc.
    """
    if "OMP_WAIT_POLICY" not in os.environ:
        os.environ.setdefault("GOMP_SPINCOUNT", "1000")
    mallopt = _of_glibc("mallopt")
    if mallopt is None:
        return
    mallopt(M_MMAP_THRESHOLD, 32 * 2**20)  # the most that glibc accepts
    mallopt(M_TRIM_THRESHOLD, 2**31 - 1)
    mallopt(M_TOP_PAD, 64 * 2**20)
    if "MALLOC_ARENA_MAX" not in os.environ:
        mallopt(M_ARENA_MAX, 2)


def return_free_memory() -> None:
    """Return free memory of the C library to the system; no effect unless it is glibc."""
    trim = _of_glibc("malloc_trim")
    if trim is not None:
        trim(0)


def _of_glibc(name: str) -> Callable[..., int] | None:
    """A function of the C library; None where that is not glibc."""
    if not sys.platform.startswith("linux"):
        return None
    try:
        function: Callable[..., int] = getattr(ctypes.CDLL(None), name)
    except (AttributeError, OSError):
        return None
    return function


@contextmanager
def importing() -> Iterator[None]:
    """Imports torch, or Lightning, inside.

    Python looks for no garbage among what is imported, now or later: it stays. The program's
    imports take a fifth less then.

    Raises:
        DevrfError: an installed torchvision cannot be imported; Lightning would import it.
    """
    enabled, modules = gc.isenabled(), len(sys.modules)
    gc.disable()
    try:
        _check_torchvision()
        yield
    finally:
        if len(sys.modules) > modules:
            gc.freeze()
        if enabled:
            gc.enable()


def _check_torchvision() -> None:
    if find_spec("torchvision") is None:
        return
    try:
        import_module("torchvision")
    except Exception as error:  # a RuntimeError where it was built for another torch
        raise DevrfError(
            f"torchvision cannot be imported ({error}); run pip uninstall torchvision, or install "
            "the build that fits torch, as pytorch.org says"
        ) from None


@contextmanager
def quiet_if_unread() -> Iterator[None]:
    """When nobody reads the output any more (``| head -1``), end as SIGPIPE ends a program.

    Python ignores that signal, for sockets that are closed send it, too. A stage whose log nobody
    reads goes on.
    """
    logging.raiseExceptions = False  # the log says nothing of that, either
    try:
        try:
            yield
        except SystemExit as end:  # Hydra ends --help with one, of status 0
            if end.code:
                raise
        sys.stdout.flush()
    except BrokenPipeError:
        if _is_read():  # it was another pipe: a fault
            raise
        # Or Python complains when it flushes at the end.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(128 + signal.SIGPIPE)


def _is_read() -> bool:
    try:
        print(flush=True)
    except BrokenPipeError:
        return False
    return True


def forget_peak_memory() -> None:
    """Restart the system's measurement of this process's peak memory (Linux only)."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


class Interrupted(SystemExit):
    """A signal has ended the run; the exit status is 128 plus its number, as in a shell.

    Attributes:
        message: the line for the user.
    """

    def __init__(
        self, number: int, message: str = "interrupted; run the same command again to go on"
    ) -> None:
        super().__init__(128 + number)
        self.message = message


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
    jobs by handlers of their own. It has no effect outside the main thread.

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
