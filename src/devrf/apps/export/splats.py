"""A moving surface as 3D Gaussians, for viewers of splats: a PLY file a time, or USD."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from devrf.apps.export.geometry import MovingMesh, UpFrame, halfway, vertex_normals
from devrf.apps.export.usd import SceneFile
from devrf.geometry.cameras import Cameras
from devrf.system.files import atomic_write, write_json

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


@dataclass(frozen=True)
class Gaussians:
    """N Gaussians at one time.

    Attributes:
        points: (N, 3) means.
        normals: (N, 3) unit vectors; zero where there is no surface.
        factors: (N, 3) of the spherical harmonic of degree 0, for RGB.
        opacity: (N,) in (0, 1).
        scales: (N, 3) standard deviations along their axes, in the unit of the points.
        turns: (N, 4) unit quaternions w, x, y, z, which turn the axes of the points to theirs.
    """

    points: Tensor
    normals: Tensor
    factors: Tensor
    opacity: Tensor
    scales: Tensor
    turns: Tensor

    def ply(self) -> bytes:
        """A PLY file of 3D Gaussian Splatting, binary, little endian."""
        lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(self.points)}"]
        lines += [f"property float {name}" for name in PROPERTIES]
        opacity = self.opacity.logit()[:, None]
        columns = (self.points, self.normals, self.factors, opacity, self.scales.log(), self.turns)
        values: npt.NDArray[np.float32] = torch.cat(columns, dim=1).numpy().astype("<f4")
        return "\n".join([*lines, "end_header", ""]).encode() + values.tobytes()


def discs(vertices: Tensor, faces: Tensor, colors: Tensor) -> Gaussians:
    """A flat Gaussian on each vertex, as wide as its share of the surface.

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
    return Gaussians(
        points=vertices,
        normals=normals,
        factors=(colors - 0.5) / HARMONIC,
        opacity=torch.full_like(across, OPACITY),
        scales=torch.stack([across, across, THICKNESS * across], dim=1),
        turns=torch.nn.functional.pad(halfway(normals), (1, 0)),  # half turns
    )


def _moving(mesh: MovingMesh, frame: UpFrame, axes: tuple[float, ...]) -> Iterator[Gaussians]:
    """The discs of a mesh at each of its times; ``axes`` of the frame may be turned round."""
    for vertices in mesh.vertices:
        points = frame.points(vertices) * vertices.new_tensor(axes)
        yield discs(points, mesh.faces, mesh.colors)


def write_splats(
    folder: Path, mesh: MovingMesh, cameras: Mapping[str, Cameras], frame: UpFrame, seconds: float
) -> None:
    """Write ``frame0001.ply`` and so on, as viewers import a sequence, and ``index.json`` last.

    Positions far from the origin are relative to the ``origin`` that the index states, since they
    are of float32. Files of splats hold no ``cameras``. Other arguments are as for
    :func:`~devrf.apps.export.gltf.write_gltf`, but y points down. Files of an earlier, longer
    sequence there are removed.
    """
    frames = []
    for number, splats in enumerate(_moving(mesh, frame, DOWN), start=1):
        name = f"frame{number:04d}.ply"
        time = mesh.times[number - 1]
        with atomic_write(folder / name) as partial:
            partial.write_bytes(splats.ply())
        frames.append({"file": name, "time": time, "seconds": time * seconds})
    index: dict[str, Any] = {"content": "splats", "frame": "y down, metres", "frames": frames}
    if any(frame.offset):
        index["origin"] = [sign * v for sign, v in zip(DOWN, frame.origin, strict=True)]
    write_json(folder / "index.json", index)
    for path in folder.glob("frame[0-9]*.ply"):
        if path.name not in {entry["file"] for entry in frames}:
            path.unlink()


def write_usd_splats(
    path: Path, mesh: MovingMesh, cameras: Mapping[str, Cameras], frame: UpFrame, seconds: float
) -> None:
    """Write one .usdc file: a ``ParticleField3DGaussianSplat`` with time samples, and the cameras.

    Arguments are as for :func:`~devrf.apps.export.gltf.write_gltf`.
    """
    from pxr import UsdVol, Vt  # an extra

    file = SceneFile(mesh.times, frame, seconds)
    field = UsdVol.ParticleField3DGaussianSplat.Define(file.stage, "/scene/splats")
    file.move_to_origin(field)
    field.CreateRadianceSphericalHarmonicsDegreeAttr(0)
    for code, splats in zip(file.codes, _moving(mesh, frame, (1.0, 1.0, 1.0)), strict=True):
        turns = splats.turns[:, [1, 2, 3, 0]]  # as they lie in a quaternion's memory
        extent = torch.stack([splats.points.amin(dim=0), splats.points.amax(dim=0)])
        for attribute, kind, values in (
            (field.CreatePositionsAttr(), Vt.Vec3fArray, splats.points),
            (field.CreateScalesAttr(), Vt.Vec3fArray, splats.scales),
            (field.CreateOrientationsAttr(), Vt.QuatfArray, turns),
            (field.CreateExtentAttr(), Vt.Vec3fArray, extent),
        ):
            attribute.Set(kind.FromNumpy(values.contiguous().numpy()), code)
    factors = Vt.Vec3fArray.FromNumpy(splats.factors.contiguous().numpy())
    field.CreateRadianceSphericalHarmonicsCoefficientsAttr(factors)
    field.CreateOpacitiesAttr(Vt.FloatArray.FromNumpy(splats.opacity.numpy()))
    file.write(path, cameras)
