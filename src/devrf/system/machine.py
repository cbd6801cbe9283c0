"""What the machine has to give: memory, room on a disk, arithmetic."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import torch

# What a control group of version 1 says where it has no limit is larger than any machine.
UNLIMITED = 2**60


def free_memory(device: torch.device) -> int | None:
    """Bytes that this process could still take on ``device``; None where nobody says."""
    if device.type != "cuda":
        return free_host_memory()
    free, _ = torch.cuda.mem_get_info(device)
    # What torch keeps for itself but does not use is free, too.
    return free + torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)


def free_host_memory(root: Path = Path("/")) -> int | None:
    """Bytes that this process could still take on the host; None where the system does not say.

    On Linux what the kernel calls available, or what is left of the smallest limit of the
    control groups that hold the process (containers, SLURM), whichever is less. Elsewhere all
    memory that the machine has.

    Args:
        root: where ``proc`` and ``sys`` are.
    """
    rooms = list(_group_rooms(root))
    try:
        rooms.append(_fields(root / "proc" / "meminfo")["MemAvailable:"] * 1024)
    except (OSError, KeyError):
        try:
            rooms.append(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
        except (AttributeError, OSError, ValueError):
            pass
    return min(rooms, default=None)


def multiplies_bfloat16(device: torch.device) -> bool:
    """Whether ``device`` is faster with products of bfloat16: NVIDIA's GPUs are from Ampere on.

    A CPU is not, even one with instructions for them: oneDNN compiles its products anew for each
    number of samples, and no two batches have the same.
    """
    return device.type == "cuda" and torch.cuda.get_device_capability(device) >= (8, 0)


def own_memory() -> int:
    """Bytes of memory that this process holds; 0 where the system does not say."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError, AttributeError):
        return 0


def free_disk(folder: Path) -> int | None:
    """Bytes that can be written to ``folder``, which need not exist yet; None if unknown."""
    there = next((path for path in (folder, *folder.absolute().parents) if path.exists()), None)
    try:
        return None if there is None else shutil.disk_usage(there).free
    except OSError:
        return None


def _group_rooms(root: Path) -> Iterator[int]:
    """What the process's control groups leave it, of version 2 and of version 1."""
    try:
        lines = (root / "proc" / "self" / "cgroup").read_text().splitlines()
    except OSError:
        return
    mount = root / "sys" / "fs" / "cgroup"
    for line in lines:
        _, controllers, name = line.split(":", 2)
        if not controllers:
            top, words = mount, ("memory.max", "memory.current", "inactive_file")
        elif "memory" in controllers.split(","):
            top = mount / "memory"
            words = ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")
        else:
            continue
        # A group is held to the limits of those that it is in; a container sees its own as "/".
        folder = top / name.strip("/")
        for group in (folder, *folder.parents):
            room = _group_room(group, *words)
            if room is not None:
                yield room
            if group == top:
                break


def _group_room(folder: Path, limit: str, usage: str, cache: str) -> int | None:
    """Bytes left of a group's limit; files that are only cached give way."""
    try:
        most = int((folder / limit).read_text())  # "max": there is none
        used = int((folder / usage).read_text())
    except (OSError, ValueError):
        return None
    try:
        cached = _fields(folder / "memory.stat").get(cache, 0)
    except OSError:
        cached = 0
    return None if most >= UNLIMITED else max(most - used + cached, 0)


def _fields(path: Path) -> dict[str, int]:
    """Lines of a name and a number, as the kernel writes them."""
    words = (line.split() for line in path.read_text().splitlines())
    return {word[0]: int(word[1]) for word in words if len(word) > 1 and word[1].isdigit()}
