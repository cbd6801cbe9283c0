"""The settings ``fetch.…``; without heavy imports, because every command reads them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class FetchSettings:
    """Settings of ``stage=fetch``.

    Attributes:
        into: the folder below which scenes are put.
        sha256: the checksum to insist on; None: the catalogue's, where it has one.
        catalogue: a TOML file of other scenes; None: devrf's own.
    """

    into: str | Path = "scenes"
    sha256: str | None = None
    catalogue: str | Path | None = None
