"""When memory runs out: how it shows, and what can be given back."""

from __future__ import annotations

import gc
import re

import torch

from devrf.errors import DevrfError
from devrf.system.machine import free_memory

# What torch's allocators and its libraries say, oneDNN without a word of memory; on a GPU the
# error has a class of its own.
SAID = (
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
    """Memory has run out, and whatever could be done about it has been done."""


def is_oom(error: BaseException) -> bool:
    """Whether an error says that memory has run out, on a GPU or on the host."""
    if isinstance(error, MemoryError | torch.OutOfMemoryError):
        return True
    return isinstance(error, RuntimeError) and any(words in str(error) for words in SAID)


def free_cache(device: torch.device) -> None:
    """Give back what is held without being used.

    What an error's traceback holds is not: call this after the ``except`` block.
    """
    gc.collect()
    if device.type == "cuda":
        torch.cuda.empty_cache()


def numbers(said: str, device: torch.device) -> str:
    """What was asked for and what there is, in words.

    Args:
        said: what the error said.
        device: where memory ran out.
    """
    asked, free = ASKED.search(said), free_memory(device)
    parts = []
    if asked and asked.group(2).lower() in UNITS:
        parts.append(f"{gib(float(asked.group(1)) * UNITS[asked.group(2).lower()])} GiB more asked")
    if free is not None:
        parts.append(f"{gib(free)} GiB free")
    return f"{', '.join(parts)} on {device}" if parts else str(device)


def gib(count: float) -> str:
    """Bytes as a number of GiB with two digits that tell: 21.3, 1.2, 0.034."""
    value = count / 2**30
    return f"{value:.1f}" if value >= 1 else f"{value:.2g}"
