"""What the machine offers: memory, disk space, arithmetic."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import psutil
import torch

# A control group of version 1 without a limit states more than any machine has.
UNLIMITED = 2**60


def free_memory(device: torch.device) -> int:
    """Bytes that this process could still take on ``device``."""
    if device.type != "cuda":
        return free_host_memory()
    free, _ = torch.cuda.mem_get_info(device)
    # What torch has reserved but does not use is free, too.
    return free + torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)


def free_host_memory(root: Path = Path("/")) -> int:
    """Bytes that this process could still take on the host.

    The least of what the system calls available and what the process's control groups (containers,
    SLURM) leave it. ``root`` holds ``proc`` and ``sys``.
    """
    available: int = psutil.virtual_memory().available
    return min([available, *_left_by_groups(root)])


def own_memory() -> int:
    """Bytes of memory that this process holds."""
    return int(psutil.Process().memory_info().rss)


def free_disk(folder: Path) -> int:
    """Bytes that can be written to ``folder``, which need not exist yet."""
    there = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    return shutil.disk_usage(there).free


def multiplies_bfloat16(device: torch.device) -> bool:
    """Whether ``device`` multiplies bfloat16 faster: NVIDIA's GPUs from Ampere on.

    A CPU does not: oneDNN compiles its products anew for each number of samples.
    """
    return device.type == "cuda" and torch.cuda.get_device_capability(device) >= (8, 0)


def _left_by_groups(root: Path) -> Iterator[int]:
    """Bytes that the process's control groups, of version 2 and of version 1, leave it."""
    try:
        lines = (root / "proc" / "self" / "cgroup").read_text().splitlines()
    except OSError:
        return
    mount = root / "sys" / "fs" / "cgroup"
    for line in lines:
        _, controllers, name = line.split(":", 2)
        if not controllers:
            top, names = mount, ("memory.max", "memory.current", "inactive_file")
        elif "memory" in controllers.split(","):
            top = mount / "memory"
            names = ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")
        else:
            continue
        # A group is held to the limits of its parents too; a container sees its own as "/".
        folder = top / name.strip("/")
        for group in (folder, *folder.parents):
            if group.is_relative_to(top):
                yield from _left_by_group(group, *names)


def _left_by_group(folder: Path, limit: str, usage: str, cache: str) -> Iterator[int]:
    """Bytes left of a group's limit, if it has one; cached files count as free."""
    try:
        most, used = (int((folder / name).read_text()) for name in (limit, usage))
        stat = (folder / "memory.stat").read_text().split()
    except (OSError, ValueError):  # "max": there is no limit
        return
    cached = int(stat[stat.index(cache) + 1]) if cache in stat else 0
    if most < UNLIMITED:
        yield max(most - used + cached, 0)
