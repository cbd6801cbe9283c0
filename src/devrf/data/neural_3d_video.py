"""Forward-facing scenes from synchronised videos, as Neural 3D Video has them."""

from __future__ import annotations

from typing import Any

from devrf.data.options import takes_options_of
from devrf.data.recorded import RecordedDataModule
from devrf.scenes.formats.neural_3d_video import Neural3DVideoReader


class Neural3DVideoDataModule(RecordedDataModule):
    """A scene that synchronised cameras have filmed from one side."""

    @takes_options_of(Neural3DVideoReader)
    def __init__(self, *where: Any, **options: Any) -> None:
        """Say where the scene is and how to read it; see :class:`Neural3DVideoReader`."""
        super().__init__(Neural3DVideoReader(*where, **options))
