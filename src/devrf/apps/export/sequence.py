"""One file a time, PLY or OBJ, and an index that says which time each shows."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from torch import Tensor

from devrf.apps.export.geometry import MovingMesh
from devrf.apps.images import to_bytes
from devrf.system.files import atomic_write, write_json

FRAME = "world: the axes and the unit of the capture"

# What the file of one time holds: a mesh or points of trimesh.
Drawn = Any


def mesh_files(mesh: MovingMesh) -> Iterable[Drawn]:
    """The mesh at each of its times."""
    import trimesh  # an extra

    colors = to_bytes(mesh.colors).numpy()
    faces = mesh.faces.numpy()
    for vertices in mesh.vertices:
        yield trimesh.Trimesh(vertices.numpy(), faces, vertex_colors=colors, process=False)


def point_file(points: Tensor, colors: Tensor) -> Drawn:
    """The points (N, 3) of a time, with their colours (N, 3) in [0, 1]."""
    import trimesh

    return trimesh.PointCloud(points.numpy(), colors=to_bytes(colors).numpy())


def write_sequence(
    folder: Path,
    format: str,
    times: tuple[float, ...],
    drawn: Iterable[Drawn],
    content: str,
    seconds: float,
) -> None:
    """Write ``frame_0000.ply`` and so on, and ``index.json`` last.

    Files of an earlier, longer sequence there are removed. They are in the capture's world, and
    colours are sRGB. The index says that ``content`` is a surface or points, and how many
    ``seconds`` time 0 to 1 takes.
    """
    frames = []
    for number, (time, geometry) in enumerate(zip(times, drawn, strict=True)):
        name = f"frame_{number:04d}.{format}"
        with atomic_write(folder / name) as partial:
            geometry.export(str(partial), file_type=format)
        frames.append({"file": name, "time": time, "seconds": time * seconds})
    write_json(folder / "index.json", {"content": content, "frame": FRAME, "frames": frames})
    for path in folder.glob(f"frame_[0-9]*.{format}"):
        if path.name not in {frame["file"] for frame in frames}:
            path.unlink()
