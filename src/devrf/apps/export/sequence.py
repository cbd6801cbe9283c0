"""One file a time, PLY or OBJ, and an index that says which time each shows."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from torch import Tensor

from devrf.apps.export.geometry import MovingMesh, PointCloud
from devrf.system.files import atomic_write, write_json

INDEX = "index.json"
FRAME = "world: the axes and the unit of the capture"

# What a moment's file holds: as trimesh writes it.
Drawn = Any


def mesh_files(mesh: MovingMesh) -> Iterable[Drawn]:
    """The mesh at each of its times."""
    import trimesh  # an extra

    colors, faces = _bytes(mesh.colors), mesh.faces.numpy()
    for vertices in mesh.vertices:
        yield trimesh.Trimesh(vertices.numpy(), faces, vertex_colors=colors, process=False)


def point_files(clouds: Iterable[PointCloud]) -> Iterable[Drawn]:
    """The points of each time."""
    import trimesh

    for cloud in clouds:
        yield trimesh.PointCloud(cloud.points.numpy(), colors=_bytes(cloud.colors))


def write_sequence(
    folder: Path,
    format: Literal["ply", "obj"],
    times: tuple[float, ...],
    drawn: Iterable[Drawn],
    content: str,
    seconds: float,
) -> None:
    """Write ``frame_0000.ply`` and so on, and ``index.json`` last.

    Files of an earlier, longer sequence there are removed.

    Args:
        folder: for the files.
        format: of the files, in the capture's world; colours are sRGB.
        times: in [0, 1], one for each file.
        drawn: what each file holds.
        content: ``surface`` or ``points``, for the index.
        seconds: how long time 0 to 1 takes, for the index.
    """
    names = [f"frame_{number:04d}.{format}" for number in range(len(times))]
    for name, geometry in zip(names, drawn, strict=True):
        with atomic_write(folder / name) as partial:
            geometry.export(str(partial), file_type=format)
    frames = [
        {"file": name, "time": time, "seconds": time * seconds}
        for name, time in zip(names, times, strict=True)
    ]
    write_json(folder / INDEX, {"content": content, "frame": FRAME, "frames": frames})
    for path in folder.glob(f"frame_[0-9]*.{format}"):
        if path.name not in names:
            path.unlink()


def _bytes(colors: Tensor) -> npt.NDArray[np.uint8]:
    return (colors * 255).round().numpy().astype(np.uint8)
