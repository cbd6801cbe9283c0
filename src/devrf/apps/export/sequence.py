"""One file a time, PLY or OBJ, and an index that says which time each shows."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from devrf.apps.export.geometry import MovingMesh
from devrf.geometry.offset import NO_OFFSET, Offset
from devrf.pictures.images import to_bytes
from devrf.system.files import atomic_write, write_json

# What index.json says of positions.
FRAME = "world: the axes and the unit of the capture"


def mesh_files(mesh: MovingMesh, format: str, offset: Offset = NO_OFFSET) -> Iterator[bytes]:
    """Files of the mesh at each of its times, moved by ``offset`` to the capture's world."""
    import trimesh  # an extra

    colors = to_bytes(mesh.colors).numpy()
    faces = mesh.faces.numpy()
    for vertices in mesh.vertices:
        placed = vertices.double().numpy() + offset
        drawn = trimesh.Trimesh(placed, faces, vertex_colors=colors, process=False)
        yield _content(drawn, format)


def point_file(points: Tensor, colors: Tensor, offset: Offset = NO_OFFSET) -> bytes:
    """A PLY of points (N, 3), moved by ``offset``, with their colours (N, 3) in [0, 1]."""
    import trimesh

    placed = points.double().numpy() + offset
    return _content(trimesh.PointCloud(placed, colors=to_bytes(colors).numpy()), "ply")


def write_files(
    folder: Path,
    pattern: str,
    files: Iterable[bytes],
    times: tuple[float, ...],
    seconds: float,
    index: Mapping[str, Any],
    first: int = 0,
) -> None:
    """Write a file for each time, and ``index.json`` last; those of a longer sequence go.

    Args:
        folder: of the files.
        pattern: the names of files, ``frame_{:04d}.ply``, numbered from ``first`` on.
        files: the content of each.
        times: of the files, in [0, 1].
        seconds: of the way from time 0 to 1.
        index: what ``index.json`` says beside the files, their times and seconds.
        first: the number of the first file.
    """
    frames = []
    for number, (time, content) in enumerate(zip(times, files, strict=True), start=first):
        name = pattern.format(number)
        with atomic_write(folder / name) as partial:
            partial.write_bytes(content)
        frames.append({"file": name, "time": time, "seconds": time * seconds})
    write_json(folder / "index.json", {**index, "frames": frames})
    for path in folder.glob(pattern.replace("{:04d}", "[0-9]*")):
        if path.name not in {frame["file"] for frame in frames}:
            path.unlink()


def _content(geometry: Any, format: str) -> bytes:
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
