"""Trackers: loggers that take pictures, videos and tables beside curves.

Only this folder knows trackers by name; other code asks :func:`trackers`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from lightning.pytorch.loggers import Logger
from torch import Tensor

Row = Mapping[str, str | float | None]


@runtime_checkable
class Tracker(Protocol):
    """A logger that also shows pictures, videos and tables, of one run across its stages."""

    def log_hyperparams(self, params: dict[str, Any]) -> None:
        """Keep the run's composed config."""

    def show_image(self, name: str, image: Tensor, step: int | None = None) -> None:
        """Show an image (H, W, 3) in [0, 1], as of a stage's iteration ``step``."""

    def show_video(self, name: str, path: Path) -> None:
        """Show a video file, where that is possible."""

    def show_table(self, name: str, rows: Sequence[Row]) -> None:
        """Show a table whose columns are the rows' keys, of which there is at least one."""

    def conclude(self, values: Mapping[str, float]) -> None:
        """Record the run's final numbers."""

    def close(self, *, failed: bool) -> None:
        """End the tracking, if it began."""


def trackers(loggers: Iterable[Logger]) -> list[Tracker]:
    """Those of the loggers that are trackers."""
    return [logger for logger in loggers if isinstance(logger, Tracker)]


def columns(rows: Sequence[Row]) -> list[str]:
    """The keys of the rows, in order of appearance."""
    return list(dict.fromkeys(key for row in rows for key in row))
