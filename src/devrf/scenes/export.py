"""A scene written to disk in the published layout of its kind."""

from __future__ import annotations

from pathlib import Path

from devrf.scenes.export_blender import export_blender
from devrf.scenes.export_llff import export_llff
from devrf.scenes.scene import Scene

__all__ = ["export", "export_blender", "export_llff"]


def export(scene: Scene, folder: Path) -> None:
    """Write ``scene`` for ``data=inward`` or ``data=forward`` to read, as its kind says.

    Args:
        scene: any scene.
        folder: a new or an empty folder.

    Raises:
        DevrfError: what :func:`export_blender` or :func:`export_llff` raises.
    """
    write = export_blender if scene.kind == "inward" else export_llff
    write(scene, folder)
