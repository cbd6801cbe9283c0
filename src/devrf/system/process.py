"""Settings of the C library and the system for a process that trains."""

from __future__ import annotations

import ctypes
import gc
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

# glibc's malloc.h
M_TRIM_THRESHOLD, M_TOP_PAD, M_MMAP_THRESHOLD = -1, -2, -3


def tune_for_cpu() -> None:
    """Keep threads from spinning long and freed memory from going back to the kernel.

    Threads that wait by spinning, the default, are a hundred times slower on a busy machine;
    threads that sleep at once gain nothing over one thread; a short spin suits both. A training
    step frees and takes the same dozens of megabytes again and again: mapping and zeroing those
    pages anew would be a tenth of the run.

    Of no effect once torch is loaded, on a GPU, or where the C library is not glibc.
    """
    if "OMP_WAIT_POLICY" not in os.environ:
        os.environ.setdefault("GOMP_SPINCOUNT", "1000")
    if not sys.platform.startswith("linux"):
        return
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError):
        return
    mallopt(M_MMAP_THRESHOLD, 32 * 2**20)  # the most that glibc accepts
    mallopt(M_TRIM_THRESHOLD, 2**31 - 1)
    mallopt(M_TOP_PAD, 64 * 2**20)


@contextmanager
def importing() -> Iterator[None]:
    """Python looks for no garbage among what is imported inside, now or later: it stays.

    The program's imports take a fifth less then.
    """
    enabled, modules = gc.isenabled(), len(sys.modules)
    gc.disable()
    try:
        yield
    finally:
        if len(sys.modules) > modules:
            gc.freeze()
        if enabled:
            gc.enable()


def forget_peak_memory() -> None:
    """Restart the system's measurement of this process's peak memory (Linux only)."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")
