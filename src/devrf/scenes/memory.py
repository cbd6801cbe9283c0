"""The machine's memory, and whether what a scene asks for can fit into it at all."""

from __future__ import annotations

import os

from devrf.scenes.validation import scene_error


def check_memory(needed: int, where: object, what: str) -> None:
    """DevrfError when ``what`` takes more bytes than the machine has.

    Args:
        needed: bytes.
        where: the file or folder that asks for them.
        what: what they are for, in words.
    """
    there = _machine_memory()
    if there is not None and needed > there:
        raise scene_error(
            where,
            f"{what} take {needed / 2**30:.1f} GiB, but this machine has "
            f"{there / 2**30:.1f} GiB of memory; set data.downscale higher, or data.frames",
        )


def _machine_memory() -> int | None:
    """Bytes of memory, or None where the system does not say."""
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, OSError, ValueError):
        return None
