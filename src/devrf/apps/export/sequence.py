"""One file a time, PLY or OBJ, and an index that says which time each shows."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from devrf.apps.export.geometry import MovingMesh
from devrf.geometry.offset import NO_OFFSET, Offset
from devrf.pictures.images import to_bytes
from devrf.system.files import atomic_write, write_json

FRAME = "world: the axes and the unit of the capture"

# The content of one time's file: a mesh or points of trimesh.
Drawn = Any


def mesh_files(mesh: MovingMesh, offset: Offset = NO_OFFSET) -> Iterable[Drawn]:
    """The mesh at each of its times, moved by ``offset`` to the capture's world."""
    import trimesh  # an extra

    colors = to_bytes(mesh.colors).numpy()
    faces = mesh.faces.numpy()
    for vertices in mesh.vertices:
        placed = vertices.double().numpy() + offset
        yield trimesh.Trimesh(placed, faces, vertex_colors=colors, process=False)


def point_file(points: Tensor, colors: Tensor, offset: Offset = NO_OFFSET) -> Drawn:
    """The points (N, 3) of a time, moved by ``offset``, with their colours (N, 3) in [0, 1]."""
    import trimesh

    return trimesh.PointCloud(points.double().numpy() + offset, colors=to_bytes(colors).numpy())


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
    files = ((f"frame_{k:04d}.{format}", _content(g, format)) for k, g in enumerate(drawn))
    write_files(folder, files, times, seconds, {"content": content, "frame": FRAME})


def write_files(
    folder: Path,
    files: Iterable[tuple[str, bytes]],
    times: tuple[float, ...],
    seconds: float,
    index: dict[str, Any],
) -> None:
    """Write a numbered file for each time, its name and content, and the index last.

    Files of an earlier, longer sequence are removed.
    """
    frames = []
    for time, (name, content) in zip(times, files, strict=True):
        with atomic_write(folder / name) as partial:
            partial.write_bytes(content)
        frames.append({"file": name, "time": time, "seconds": time * seconds})
    write_json(folder / "index.json", index | {"frames": frames})
    for path in folder.glob(re.sub(r"\d+", "[0-9]*", name)):
        if path.name not in {frame["file"] for frame in frames}:
            path.unlink()


def _content(geometry: Drawn, format: str) -> bytes:
    """A file; positions in a PLY are doubles where float32, which trimesh writes, rounds them."""
    written = geometry.export(file_type=format)
    content: bytes = written.encode() if isinstance(written, str) else written
    places = np.asarray(geometry.vertices)
    if format != "ply" or (places.astype(np.float32) == places).all():
        return content
    header, end, body = content.partition(b"end_header\n")
    wide = np.empty(len(places), [("place", "<f8", 3), ("rgba", "u1", 4)])
    single = np.frombuffer(body, [("place", "<f4", 3), ("rgba", "u1", 4)], count=len(places))
    wide["place"] = places
    wide["rgba"] = single["rgba"]
    header = header.replace(b"property float", b"property double")
    return header + end + wide.tobytes() + body[single.nbytes :]
