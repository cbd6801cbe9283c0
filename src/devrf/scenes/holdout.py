"""Which images of a capture are held out where no list says so."""

from __future__ import annotations


def every_nth(count: int, holdout: int) -> tuple[list[int], list[int]]:
    """The positions to learn from and those to hold out, of ``count`` ≥ 2 images.

    Every ``holdout``-th (≥ 2) is held out: the last of each such run, since the first image of a
    sequence shows the scene at rest. Of fewer images the last one is held out.
    """
    held_out = list(range(holdout - 1, count, holdout)) or [count - 1]
    return sorted(set(range(count)) - set(held_out)), held_out


def first_of_every(count: int, holdout: int) -> tuple[list[int], list[int]]:
    """The positions to learn from and those to hold out, of ``count`` ≥ 2 images at rest.

    Every ``holdout``-th (≥ 2) is held out, the first included: so are LLFF's scenes scored, and
    those of mip-NeRF 360.
    """
    held_out = list(range(0, count, holdout))
    return sorted(set(range(count)) - set(held_out)), held_out
