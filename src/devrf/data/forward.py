"""Forward-facing scenes from disk: cameras that face a scene from one side."""

from __future__ import annotations

from typing import Any

from devrf.data.options import takes_options_of
from devrf.data.recorded import RecordedDataModule
from devrf.scenes.formats.llff import LlffReader


class ForwardFacingDataModule(RecordedDataModule):
    """A scene in DeVRF's published forward-facing layout, LLFF's with fixed views."""

    @takes_options_of(LlffReader)
    def __init__(self, *where: Any, **options: Any) -> None:
        """Say where the scene is and how to read it; see :class:`LlffReader`."""
        super().__init__(LlffReader(*where, **options))
