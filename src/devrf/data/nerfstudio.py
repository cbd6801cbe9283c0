"""Inward-facing scenes from nerfstudio's ``transforms.json``, with a time on each image."""

from __future__ import annotations

from typing import Any

from devrf.data.options import takes_options_of
from devrf.data.recorded import RecordedDataModule
from devrf.scenes.formats.nerfstudio import NerfstudioReader


class NerfstudioDataModule(RecordedDataModule):
    """A scene in nerfstudio's layout, one file or ``static/`` and ``dynamic/``."""

    @takes_options_of(NerfstudioReader)
    def __init__(self, *where: Any, **options: Any) -> None:
        """Say where the scene is and how to read it; see :class:`NerfstudioReader`."""
        super().__init__(NerfstudioReader(*where, **options))
