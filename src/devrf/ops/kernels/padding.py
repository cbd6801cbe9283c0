"""Programs behind those of the rays, which fill the padding of a list in the same launch."""

from __future__ import annotations

import triton
import triton.language as tl

# Places that a program fills.
PADDING = 1024


def padding_programs(places: int) -> int:
    """How many programs go over a list of ``places``."""
    return int(triton.cdiv(places, PADDING))


@triton.jit
def padding_places(number, used, places, PADDING: tl.constexpr):
    """The places of program ``number`` of those, and which of them are behind the ``used`` ones."""
    place = number.to(tl.int64) * PADDING + tl.arange(0, PADDING)
    return place, (place >= used) & (place < places)
