"""Scenes from disk whose layout is recognised by their files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from devrf.data.colmap import ColmapDataModule
from devrf.data.dycheck import DycheckDataModule
from devrf.data.forward import ForwardFacingDataModule
from devrf.data.inward import InwardFacingDataModule
from devrf.data.nerfies import NerfiesDataModule
from devrf.data.nerfstudio import NerfstudioDataModule
from devrf.data.neural_3d_video import Neural3DVideoDataModule
from devrf.data.recorded import RecordedDataModule
from devrf.scenes.formats import recognise

DATAMODULES: dict[str, Any] = {
    "inward": InwardFacingDataModule,
    "forward": ForwardFacingDataModule,
    "nerfies": NerfiesDataModule,
    "nerfstudio": NerfstudioDataModule,
    "colmap": ColmapDataModule,
    "neural_3d_video": Neural3DVideoDataModule,
    "dycheck": DycheckDataModule,
}


def recognised_datamodule(root: str | Path, **options: Any) -> RecordedDataModule:
    """The datamodule that reads the scene in the folder ``root``.

    Args:
        root: the scene's folder.
        options: of its reader; those that are None have the reader's own defaults.

    Raises:
        DevrfError: the layout is unknown, or its reader has no such option.
    """
    chosen = DATAMODULES[recognise(root).choice]
    given = {name: value for name, value in options.items() if value is not None}
    module: RecordedDataModule = chosen(root, **given)
    return module
