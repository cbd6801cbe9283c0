"""Programs behind those of the rays, which fill the padding of a list in the same launch."""

from __future__ import annotations

import triton

# Places that a program fills.
PADDING = 1024


def padding_programs(places: int) -> int:
    """How many programs go over a list of ``places``."""
    return int(triton.cdiv(places, PADDING))
