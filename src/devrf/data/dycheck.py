"""Scenes of DyCheck: a telephone that moves before a moving subject."""

from __future__ import annotations

from typing import Any

from devrf.data.options import takes_options_of
from devrf.data.recorded import RecordedDataModule
from devrf.scenes.formats.dycheck import DycheckReader


class DycheckDataModule(RecordedDataModule):
    """A scene in DyCheck's layout, Nerfies' with split lists."""

    @takes_options_of(DycheckReader)
    def __init__(self, *where: Any, **options: Any) -> None:
        """Say where the scene is and how to read it; see :class:`DycheckReader`."""
        super().__init__(DycheckReader(*where, **options))
