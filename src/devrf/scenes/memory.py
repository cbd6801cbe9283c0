"""Whether what a scene asks for can fit into the machine's memory at all."""

from __future__ import annotations

import psutil

from devrf.scenes.validation import scene_error


def check_memory(needed: int, where: object, what: str) -> None:
    """DevrfError when ``what`` takes more bytes than the machine has.

    Args:
        needed: bytes.
        where: the file or folder that asks for them.
        what: what they are for, in words.
    """
    there = psutil.virtual_memory().total
    if needed > there:
        raise scene_error(
            where,
            f"{what} take {needed / 2**30:.1f} GiB, but this machine has "
            f"{there / 2**30:.1f} GiB of memory; set data.downscale higher, or data.frames",
        )
