"""Free memory, and errors of memory that has run out."""

from __future__ import annotations

import gc
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil
import torch

from devrf.errors import DevrfError
from devrf.system.process import return_free_memory

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


def free_memory(device: torch.device) -> int:
    """Bytes that this process could still take on ``device``."""
    if device.type != "cuda":
        return free_host_memory()
    free, _ = torch.cuda.mem_get_info(device)
    # Memory that torch has reserved but does not use is free, too.
    return free + torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)


def free_host_memory(root: Path = Path("/")) -> int:
    """Bytes that this process could still take on the host.

    The least of the bytes that the system calls available and those that the process's control
    groups (containers, SLURM) leave it. ``root`` holds ``proc`` and ``sys``.
    """
    available: int = psutil.virtual_memory().available
    return min([available, *_left_by_groups(root)])


def need_memory(size: int, what: str, device: torch.device | str = "cpu") -> None:
    """Check that ``size`` bytes are free on ``device`` for ``what``.

    Raises:
        OutOfMemoryError: fewer are free.
    """
    if size > (free := free_memory(torch.device(device))):
        raise OutOfMemoryError(
            f"{what} would take {size / 1e9:.2f} GB of memory, and {free / 1e9:.2f} GB are free; "
            "free some of it, or use a larger machine"
        )


def own_memory() -> int:
    """Bytes of memory that this process holds."""
    return int(psutil.Process().memory_info().rss)


def _left_by_groups(root: Path) -> Iterator[int]:
    """Bytes that the process's control group (version 2) and the groups around it leave it."""
    try:
        lines = (root / "proc" / "self" / "cgroup").read_text().splitlines()
    except OSError:
        return
    mount = root / "sys" / "fs" / "cgroup"
    for group_path in (line.removeprefix("0::") for line in lines if line.startswith("0::")):
        # A group is held to the limits of its parents too; a container sees its own as "/".
        folder = mount / group_path.strip("/")
        for group in (folder, *folder.parents):
            if group.is_relative_to(mount):
                yield from _left_by_group(group)


def _left_by_group(folder: Path) -> Iterator[int]:
    """Bytes left of a group's limit, if it has one; cached files count as free."""
    try:
        limit, used = (int((folder / f"memory.{name}").read_text()) for name in ("max", "current"))
        stat = (folder / "memory.stat").read_text().split()
    except (OSError, ValueError):  # "max": there is no limit
        return
    cached = int(stat[stat.index("inactive_file") + 1]) if "inactive_file" in stat else 0
    yield max(limit - used + cached, 0)


def is_oom(error: BaseException) -> bool:
    """Whether an error says that memory has run out, on a GPU or on the host."""
    if isinstance(error, MemoryError | torch.OutOfMemoryError):
        return True
    return isinstance(error, RuntimeError) and any(words in str(error) for words in MESSAGES)


def free_cache(device: torch.device) -> None:
    """Free memory that torch and the C library keep without using it.

    An error's traceback keeps its tensors: call this after the ``except`` block.
    """
    gc.collect()
    if device.type == "cuda":
        torch.cuda.empty_cache()
    return_free_memory()


@contextmanager
def shortage_in_words(stage: str, device: torch.device, rays: str | None) -> Iterator[None]:
    """Raise a DevrfError where memory runs out in a stage; ``rays`` is a key that may be lowered.

    Raises:
        DevrfError: it did.
    """
    try:
        yield
    except DevrfError:
        raise
    except Exception as error:
        if not is_oom(error) and not (error.__cause__ and is_oom(error.__cause__)):
            raise
        hint = f"lower {rays}" if rays else "free some of it, or use a larger machine"
        raise DevrfError(
            f"stage={stage}: out of memory ({numbers(str(error), device)}); {hint}; files "
            "written before stay"
        ) from error


def numbers(message: str, device: torch.device) -> str:
    """Memory asked for, if the ``message`` says so, and memory free on ``device``, in words."""
    match, free = ASKED.search(message), f"{gib(free_memory(device))} GiB free on {device}"
    if not match or match.group(2).lower() not in UNITS:
        return free
    return f"{gib(float(match.group(1)) * UNITS[match.group(2).lower()])} GiB more asked, {free}"


def gib(count: float) -> str:
    """Bytes as a number of GiB with two significant digits or more: 21.3, 1.2, 0.034."""
    value = count / 2**30
    return f"{value:.1f}" if value >= 1 else f"{value:.2g}"


def peak_host_memory() -> float | None:
    """The peak memory of this process so far, GiB; None where the system does not tell."""
    if sys.platform == "win32":
        return None
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    unit = 1 if sys.platform == "darwin" else 2**10
    return round(peak * unit / 2**30, 3)
