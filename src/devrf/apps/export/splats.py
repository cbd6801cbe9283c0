"""A moving surface as 3D Gaussians, a PLY file a time in one zip, for viewers of splats."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from zipfile import ZIP_DEFLATED, ZipFile, ZipInfo

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from devrf.apps.export.geometry import MovingMesh, UpFrame, halfway, vertex_normals
from devrf.geometry.cameras import Cameras
from devrf.system.files import atomic_write

# The properties of a Gaussian, in the order of 3D Gaussian Splatting's files.
PROPERTIES = (
    *("x", "y", "z", "nx", "ny", "nz"),
    *("f_dc_0", "f_dc_1", "f_dc_2", "opacity"),
    *("scale_0", "scale_1", "scale_2"),
    *("rot_0", "rot_1", "rot_2", "rot_3"),
)
# The spherical harmonic of degree 0, whose factors f_dc are: c = 1/2 + Y_0 f_dc.
HARMONIC = 0.28209479177387814
OPACITY = 0.95
# Standard deviations of a Gaussian: across the surface, in edges of a square as large as its share
# of the surface; through the surface, in those across.
WIDTH = 0.65
THICKNESS = 0.1
# Files of splats have y down and z ahead.
DOWN = (1.0, -1.0, -1.0)


def write_splats(
    path: Path, mesh: MovingMesh, cameras: Mapping[str, Cameras], frame: UpFrame, seconds: float
) -> None:
    """Write ``frame_0000.ply`` and so on, and ``index.json``, in a zip.

    A flat Gaussian lies on each vertex. Positions far from the origin are relative to the
    ``origin`` that the index states, since they are of float32. Files of splats hold no
    ``cameras``. Other arguments are as for :func:`~devrf.apps.export.gltf.write_gltf`, but y points
    down.
    """
    frames = []
    with atomic_write(path) as partial, ZipFile(partial, "w", ZIP_DEFLATED) as archive:
        for number, (time, vertices) in enumerate(zip(mesh.times, mesh.vertices, strict=True)):
            name = f"frame_{number:04d}.ply"
            points = frame.points(vertices) * vertices.new_tensor(DOWN)
            content = ply(gaussians(points, mesh.faces, mesh.colors))
            # An entry without a date: the same splats are the same file.
            archive.writestr(ZipInfo(name), content, ZIP_DEFLATED)
            frames.append({"file": name, "time": time, "seconds": time * seconds})
        index: dict[str, Any] = {"content": "splats", "frame": "y down, metres", "frames": frames}
        if any(frame.offset):
            index["origin"] = [sign * v for sign, v in zip(DOWN, frame.origin, strict=True)]
        archive.writestr(ZipInfo("index.json"), json.dumps(index, indent=2), ZIP_DEFLATED)


def gaussians(vertices: Tensor, faces: Tensor, colors: Tensor) -> Tensor:
    """The ``PROPERTIES`` (V, 17) of a disc on each vertex.

    Args:
        vertices: (V, 3).
        faces: (F, 3) int64, counter-clockwise from outside.
        colors: (V, 3) RGB in [0, 1], sRGB.
    """
    normals = vertex_normals(vertices, faces)
    a, b, c = vertices[faces].unbind(dim=1)
    third = torch.linalg.cross(b - a, c - a).norm(dim=1) / 6
    share = torch.zeros(len(vertices)).index_add_(0, faces.flatten(), third.repeat_interleave(3))
    across = WIDTH * share.clamp(min=1e-12).sqrt()
    scales = torch.stack([across, across, THICKNESS * across], dim=1)
    opacity = torch.full_like(across, math.log(OPACITY / (1 - OPACITY)))[:, None]
    factors = (colors - 0.5) / HARMONIC
    # As unit quaternions, w first: half turns.
    turns = torch.nn.functional.pad(halfway(normals), (1, 0))
    return torch.cat([vertices, normals, factors, opacity, scales.log(), turns], dim=1)


def ply(rows: Tensor) -> bytes:
    """A PLY file of Gaussians (V, 17), binary, little endian."""
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    lines += [f"property float {name}" for name in PROPERTIES]
    values: npt.NDArray[np.float32] = rows.numpy().astype("<f4")
    return "\n".join([*lines, "end_header", ""]).encode() + values.tobytes()
