"""Recognises errors of memory, and frees what is cached."""

from __future__ import annotations

import gc
import re

import torch

from devrf.errors import DevrfError
from devrf.system.machine import free_memory

# Messages of torch's allocators and libraries (oneDNN's do not mention memory); on a GPU the error
# has a class of its own.
MESSAGES = (
    "out of memory",
    "can't allocate memory",
    "bad_alloc",
    "STATUS_ALLOC_FAILED",
    "could not create a primitive",
    "could not create a memory",
)
ASKED = re.compile(r"tried to allocate (\d[\d.]*) ?(\w+)", re.IGNORECASE)
UNITS = {"b": 1, "bytes": 1, "kib": 2**10, "mib": 2**20, "gib": 2**30, "tib": 2**40}


class OutOfMemoryError(DevrfError):
    """Memory has run out, and smaller batches did not help."""


def is_oom(error: BaseException) -> bool:
    """Whether an error says that memory has run out, on a GPU or on the host."""
    if isinstance(error, MemoryError | torch.OutOfMemoryError):
        return True
    return isinstance(error, RuntimeError) and any(words in str(error) for words in MESSAGES)


def free_cache(device: torch.device) -> None:
    """Free what torch keeps without using it.

    What an error's traceback holds stays: call this after the ``except`` block.
    """
    gc.collect()
    if device.type == "cuda":
        torch.cuda.empty_cache()


def numbers(said: str, device: torch.device) -> str:
    """In words, what was asked for, if the message ``said`` so, and what is free on ``device``."""
    asked, free = ASKED.search(said), f"{gib(free_memory(device))} GiB free on {device}"
    if not asked or asked.group(2).lower() not in UNITS:
        return free
    return f"{gib(float(asked.group(1)) * UNITS[asked.group(2).lower()])} GiB more asked, {free}"


def gib(count: float) -> str:
    """Bytes as a number of GiB with two significant digits or more: 21.3, 1.2, 0.034."""
    value = count / 2**30
    return f"{value:.1f}" if value >= 1 else f"{value:.2g}"
