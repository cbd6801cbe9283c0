"""Rays taken some at a time, fewer when memory runs out."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import TypeVar

from devrf.geometry.rays import Rays
from devrf.system.out_of_memory import free_cache, is_oom

log = logging.getLogger(__name__)

Part = TypeVar("Part")

# Fewer rays at once save nothing worth having.
FEWEST = 256


def in_chunks(see: Callable[[Rays], Part], rays: Rays, chunk: int) -> list[Part]:
    """``see(rays[k:l])`` for consecutive stretches of rays, in order; at least one.

    When memory runs out, the stretch is halved and tried again, down to ``FEWEST`` rays; those
    after it stay as short.

    Args:
        see: what is wanted of some rays.
        rays: R rays.
        chunk: rays at once.
    """
    parts: list[Part] = []
    first, chunk = 0, min(chunk, max(len(rays), 1))
    while first < len(rays) or not parts:
        part = _see(see, rays[first : first + chunk], chunk)
        if part is None:
            free_cache(rays.origins.device)
            chunk //= 2
            log.warning("out of memory: pictures are rendered %d rays at a time", chunk)
        else:
            parts.append(part)
            first += chunk
    return parts


def _see(see: Callable[[Rays], Part], rays: Rays, chunk: int) -> Part | None:
    """``see(rays)``; None when memory ran out and fewer rays are worth trying."""
    try:
        return see(rays)
    except (RuntimeError, MemoryError) as error:
        if chunk // 2 < FEWEST or not is_oom(error):
            raise
    return None
