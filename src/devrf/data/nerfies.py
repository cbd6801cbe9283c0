"""Scenes of Nerfies and HyperNeRF: a moving camera before a moving subject."""

from __future__ import annotations

from typing import Any

from devrf.data.options import takes_options_of
from devrf.data.recorded import RecordedDataModule
from devrf.scenes.formats.nerfies import NerfiesReader


class NerfiesDataModule(RecordedDataModule):
    """A scene in the layout of Nerfies and HyperNeRF."""

    @takes_options_of(NerfiesReader)
    def __init__(self, *where: Any, **options: Any) -> None:
        """Say where the scene is and how to read it; see :class:`NerfiesReader`."""
        super().__init__(NerfiesReader(*where, **options))
