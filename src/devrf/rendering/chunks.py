"""Rendering many rays in chunks, smaller ones when memory runs out."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import TypeVar

from devrf.geometry.rays import Rays
from devrf.system.out_of_memory import free_cache, is_oom

log = logging.getLogger(__name__)

Part = TypeVar("Part")

# Smaller chunks would hardly need less memory.
FEWEST = 256


def in_chunks(render: Callable[[Rays], Part], rays: Rays, chunk: int) -> list[Part]:
    """``render(rays[k:l])`` for consecutive chunks of R ``rays``, in order; at least one.

    When memory runs out, ``chunk`` is halved, down to ``FEWEST`` rays, for this and later chunks.
    """
    parts: list[Part] = []
    first, chunk = 0, min(chunk, max(len(rays), 1))
    while first < len(rays) or not parts:
        try:
            parts.append(render(rays[first : first + chunk]))
            first += chunk
            continue
        except (RuntimeError, MemoryError) as error:
            if chunk // 2 < FEWEST or not is_oom(error):
                raise
        # Outside the handler, where the error's traceback no longer holds tensors.
        free_cache(rays.origins.device)
        chunk //= 2
        log.warning("out of memory: pictures are rendered %d rays at a time", chunk)
    return parts
