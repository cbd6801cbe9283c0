"""Scenes at rest from COLMAP's sparse models."""

from __future__ import annotations

from typing import Any

from devrf.data.options import takes_options_of
from devrf.data.recorded import RecordedDataModule
from devrf.scenes.formats.colmap import ColmapReader


class ColmapDataModule(RecordedDataModule):
    """A scene that COLMAP has posed: ``sparse/0`` and ``images/``."""

    @takes_options_of(ColmapReader)
    def __init__(self, *where: Any, **options: Any) -> None:
        """Say where the scene is and how to read it; see :class:`ColmapReader`."""
        super().__init__(ColmapReader(*where, **options))
