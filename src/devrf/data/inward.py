"""Inward-facing scenes from disk: cameras around a scene that look at its middle."""

from __future__ import annotations

from typing import Any

from devrf.data.options import takes_options_of
from devrf.data.recorded import RecordedDataModule
from devrf.scenes.formats.blender import BlenderReader


class InwardFacingDataModule(RecordedDataModule):
    """A scene in DeVRF's published Blender layout, or D-NeRF's."""

    @takes_options_of(BlenderReader)
    def __init__(self, *where: Any, **options: Any) -> None:
        """Say where the scene is and how to read it; see :class:`BlenderReader`."""
        super().__init__(BlenderReader(*where, **options))
