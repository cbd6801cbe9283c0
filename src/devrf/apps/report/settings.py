"""The settings ``report.…``; without heavy imports, because every command reads them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

PublishedScenes = Literal["matching", "all", "none"]


@dataclass(frozen=True)
class ReportSettings:
    """Settings of ``stage=report``.

    Attributes:
        runs: the folder below which finished runs are collected.
        into: the folder that the report is written to; None: ``report`` in ``runs``.
        published: which of the paper's rows to show: of the scenes that were run, all, or none.
    """

    runs: str | Path = "outputs"
    into: str | Path | None = None
    published: PublishedScenes = "matching"

    @property
    def folder(self) -> Path:
        """Where the report is written."""
        return Path(self.runs) / "report" if self.into is None else Path(self.into)
