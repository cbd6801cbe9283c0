"""3D Gaussians for viewers of splats, a method's own or on a moving surface: PLY files, or USD."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from kornia.geometry.conversions import rotation_matrix_to_quaternion
from torch import Tensor
from torch.nn.functional import pad

from devrf.apps.export.geometry import MovingMesh, UpFrame, halfway, vertex_normals
from devrf.apps.export.sequence import write_files
from devrf.apps.export.usd import SceneFile
from devrf.geometry.cameras import Cameras
from devrf.ops.splatting import Gaussians, rotations
from devrf.rendering.renderable import Renderable

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
# Opacities and scales are not nearer to 0 or 1 in a file.
LEAST = 1e-6
# Files of splats have y down and z ahead.
DOWN = (1.0, -1.0, -1.0)


@dataclass(frozen=True)
class MovingGaussians:
    """Gaussians at T times, in the scene's world.

    Attributes:
        times: ascending, in [0, 1].
        of_time: (T,) as many at each time, the same one in each place; on the host.
    """

    times: tuple[float, ...]
    of_time: tuple[Gaussians, ...]

    @classmethod
    def of_model(cls, model: Renderable, times: Sequence[float]) -> MovingGaussians | None:
        """Those of a method of Gaussians; None for another."""
        found = [model.gaussians_at(time) for time in times]
        known = [vars(gaussians).items() for gaussians in found if gaussians is not None]
        on_host = [Gaussians(**{name: v.float().cpu() for name, v in part}) for part in known]
        return cls(tuple(times), tuple(on_host)) if known else None

    @classmethod
    def on_surface(cls, mesh: MovingMesh) -> MovingGaussians:
        """A flat one on each vertex, as wide as its share of the surface."""
        return cls(mesh.times, tuple(discs(v, mesh.faces, mesh.colors) for v in mesh.vertices))

    def placed(self, frame: UpFrame, axes: tuple[float, ...]) -> Iterator[Gaussians]:
        """The Gaussians of each time in a frame, whose ``axes`` are turned round where −1."""
        turn = torch.diag(torch.tensor(axes)) @ frame.rotation
        for gaussians in self.of_time:
            yield Gaussians(
                means=frame.points(gaussians.means) * torch.tensor(axes),
                scales=frame.metres * gaussians.scales,
                quaternions=rotation_matrix_to_quaternion(turn @ rotations(gaussians.quaternions)),
                opacity=gaussians.opacity,
                color=gaussians.color,
            )


def discs(vertices: Tensor, faces: Tensor, colors: Tensor) -> Gaussians:
    """A flat Gaussian on each vertex, as wide as its share of the surface.

    Args:
        vertices: (V, 3).
        faces: (F, 3) int64, counter-clockwise from outside.
        colors: (V, 3) RGB in [0, 1], sRGB.
    """
    a, b, c = vertices[faces].unbind(dim=1)
    third = torch.linalg.cross(b - a, c - a).norm(dim=1) / 6
    share = torch.zeros(len(vertices)).index_add_(0, faces.flatten(), third.repeat_interleave(3))
    across = WIDTH * share.clamp(min=1e-12).sqrt()
    return Gaussians(
        means=vertices,
        scales=torch.stack([across, across, THICKNESS * across], dim=1),
        quaternions=pad(halfway(vertex_normals(vertices, faces)), (1, 0)),  # half turns
        opacity=torch.full_like(across, OPACITY),
        color=colors,
    )


def ply(gaussians: Gaussians) -> bytes:
    """A PLY file of 3D Gaussian Splatting, binary, little endian."""
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(gaussians.means)}"]
    lines += [f"property float {name}" for name in PROPERTIES]
    columns = (
        gaussians.means,
        torch.zeros_like(gaussians.means),  # the format's normals, which nothing reads
        _factors(gaussians),
        gaussians.opacity.clamp(LEAST, 1 - LEAST).logit()[:, None],
        gaussians.scales.clamp(min=LEAST).log(),
        gaussians.quaternions,
    )
    values: npt.NDArray[np.float32] = torch.cat(columns, dim=1).numpy().astype("<f4")
    return "\n".join([*lines, "end_header", ""]).encode() + values.tobytes()


def _factors(gaussians: Gaussians) -> Tensor:
    """(N, 3) factors of the harmonic of degree 0."""
    return (gaussians.color - 0.5) / HARMONIC


def write_splats(
    folder: Path,
    moving: MovingGaussians,
    cameras: Mapping[str, Cameras],
    frame: UpFrame,
    seconds: float,
) -> None:
    """Write ``frame0001.ply`` and so on, as viewers import a sequence, and ``index.json`` last.

    Positions far from the origin are relative to the ``origin`` that the index states, since they
    are of float32. Files of splats hold no ``cameras``. Other arguments are as for
    :func:`~devrf.apps.export.gltf.write_gltf`, but y points down. Files of an earlier, longer
    sequence there are removed.
    """
    files = map(ply, moving.placed(frame, DOWN))
    index: dict[str, Any] = {"content": "splats", "frame": "y down, metres"}
    if any(frame.offset):
        index["origin"] = [sign * v for sign, v in zip(DOWN, frame.origin, strict=True)]
    write_files(folder, "frame{:04d}.ply", files, moving.times, seconds, index, first=1)


def write_usd_splats(
    path: Path,
    moving: MovingGaussians,
    cameras: Mapping[str, Cameras],
    frame: UpFrame,
    seconds: float,
) -> None:
    """Write one .usdc file: a ``ParticleField3DGaussianSplat`` with time samples, and the cameras.

    Arguments are as for :func:`~devrf.apps.export.gltf.write_gltf`.
    """
    from pxr import UsdVol, Vt  # an extra

    file = SceneFile(moving.times, frame, seconds)
    field = UsdVol.ParticleField3DGaussianSplat.Define(file.stage, "/scene/splats")
    file.move_to_origin(field)
    field.CreateRadianceSphericalHarmonicsDegreeAttr(0)
    for code, splats in zip(file.codes, moving.placed(frame, (1.0, 1.0, 1.0)), strict=True):
        turns = splats.quaternions[:, [1, 2, 3, 0]]  # as they lie in a quaternion's memory
        extent = torch.stack([splats.means.amin(dim=0), splats.means.amax(dim=0)])
        for attribute, kind, values in (
            (field.CreatePositionsAttr(), Vt.Vec3fArray, splats.means),
            (field.CreateScalesAttr(), Vt.Vec3fArray, splats.scales),
            (field.CreateOrientationsAttr(), Vt.QuatfArray, turns),
            (field.CreateExtentAttr(), Vt.Vec3fArray, extent),
        ):
            attribute.Set(kind.FromNumpy(values.contiguous().numpy()), code)
    factors = Vt.Vec3fArray.FromNumpy(_factors(splats).contiguous().numpy())
    field.CreateRadianceSphericalHarmonicsCoefficientsAttr(factors)
    field.CreateOpacitiesAttr(Vt.FloatArray.FromNumpy(splats.opacity.numpy()))
    means = torch.stack([gaussians.means for gaussians in moving.of_time])
    file.write(path, cameras, frame.points(means))
