"""Progress of long work, and the time that is left."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterable, Iterator
from typing import TypeVar

from rich.console import Console
from rich.progress import track

log = logging.getLogger(__name__)

Item = TypeVar("Item")


def followed(
    items: Iterable[Item], total: int, name: str, line_every_seconds: float = 15.0
) -> Iterator[Item]:
    """The items, with a bar on a terminal, else a line of the log every so often.

    ``name`` is their product's, for the bar and the lines.
    """
    console = Console()
    if console.is_terminal:
        yield from track(items, name, total, console=console)
        return
    began = logged = time.perf_counter()
    for done, item in enumerate(items, 1):
        now = time.perf_counter()
        if now - logged >= line_every_seconds and done < total:
            logged = now
            remaining = time_left((now - began) / done * (total - done))
            log.info("%s: %d of %d, %s", name, done, total, remaining)
        yield item


def time_left(seconds: float) -> str:
    """``about 40 s left``, ``about 12 min left``, ``about 3 h 20 min left``: no more digits."""
    if seconds < 60:
        return f"about {max(round(seconds), 1)} s left"
    minutes = round(seconds / 60)
    if minutes <= 60:
        return f"about {minutes} min left"
    hours, minutes = divmod(minutes, 60)
    if hours >= 10 or not minutes:
        return f"about {round(seconds / 3600)} h left"
    return f"about {hours} h {minutes} min left"
