"""A coloured mesh of a scene at rest, of a wanted size."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from devrf.apps.export.isosurface import Mesh, entries, isosurface
from devrf.apps.export.settings import ExportSettings
from devrf.apps.export.vertex_colors import vertex_colors, vertex_normals
from devrf.errors import DevrfError
from devrf.geometry.cameras import Cameras
from devrf.geometry.space import Space
from devrf.rendering.surface_field import SurfaceField


@dataclass(frozen=True)
class Surface:
    """A mesh at rest.

    Attributes:
        points: (V, 3) canonical vertices in the fields' space, on the host.
        faces: (F, 3) int64, counter-clockwise from outside as the world is seen.
        colors: (V, 3) RGB in [0, 1], encoded as the images are (sRGB).
    """

    points: Tensor
    faces: Tensor
    colors: Tensor


def canonical_surface(
    field: SurfaceField,
    space: Space,
    limits: tuple[float, float],
    cameras: Cameras,
    settings: ExportSettings,
    device: torch.device,
) -> Surface:
    """The surface of a field, decimated and coloured.

    Args:
        field: at rest.
        space: the space of the fields.
        limits: distances before and behind which nothing is sampled, in that space.
        cameras: that saw the scene, world units, on the host.
        settings: threshold, number of faces, which pieces, how it is coloured.
        device: of the field.

    Raises:
        DevrfError: there is no surface at that threshold, or none within reach.
    """
    outside = entries(cameras, space, field.box, limits)
    asked = _OnDevice(field, device)
    mesh = isosurface(asked, outside, settings.threshold, settings.side)
    mesh = _within_reach(mesh, space, cameras, settings.reach)
    mesh = _decimated(_large_pieces(mesh, settings.pieces), settings.faces)
    points, faces = torch.from_numpy(mesh[0]), torch.from_numpy(mesh[1])
    seen = faces.flip(1) if _mirrors(space, field) else faces
    normals = vertex_normals(space.to_world(points), seen)
    colors = vertex_colors(asked, points, faces, normals, averaged=settings.colors == "mean")
    return Surface(points, seen, colors)


class _OnDevice:
    """A field that is asked for points on the host, and answers there."""

    def __init__(self, field: SurfaceField, device: torch.device) -> None:
        self._field, self._device = field, device
        self.box, self.shape = field.box, field.shape

    def optical_depth(self, points: Tensor) -> Tensor:
        return self._field.optical_depth(points.to(self._device)).cpu()

    def color(self, points: Tensor, viewdirs: Tensor) -> Tensor:
        return self._field.color(points.to(self._device), viewdirs.to(self._device)).cpu()


def _within_reach(mesh: Mesh, space: Space, cameras: Cameras, reach: float) -> Mesh:
    """The faces all of whose vertices are near enough: endless spaces hold what is at infinity."""
    points, faces = mesh
    world = space.to_world(torch.from_numpy(points))
    away = (world - cameras.positions.mean(dim=0)).norm(dim=1)
    near = (away <= reach * away.median()).numpy()
    return _kept(mesh, near[faces].all(axis=1))


def _large_pieces(mesh: Mesh, share: float) -> Mesh:
    """The mesh without connected pieces that have a smaller share of the largest one's faces."""
    import trimesh

    whole = trimesh.Trimesh(*mesh, process=False)
    piece = trimesh.graph.connected_component_labels(whole.face_adjacency, len(mesh[1]))
    faces = np.bincount(piece)
    return _kept(mesh, (faces >= share * faces.max())[piece])


def _kept(mesh: Mesh, chosen: npt.NDArray[np.bool_]) -> Mesh:
    """The ``chosen`` (F,) faces, and the vertices that they have."""
    points, faces = mesh
    if not chosen.any():
        raise DevrfError(
            "export.reach: no face of the surface is within reach; give a larger number"
        )
    used, renumbered = np.unique(faces[chosen], return_inverse=True)
    return points[used], renumbered.reshape(-1, 3).astype(np.int64)


def _decimated(mesh: Mesh, faces: int) -> Mesh:
    """The mesh with at most about ``faces`` faces, by quadric edge collapse."""
    import trimesh

    if len(mesh[1]) <= faces:
        return mesh
    whole = trimesh.Trimesh(*mesh, process=False)
    fewer = whole.simplify_quadric_decimation(face_count=faces)
    return np.asarray(fewer.vertices, np.float32), np.asarray(fewer.faces, np.int64)


def _mirrors(space: Space, field: SurfaceField) -> bool:
    """Whether the way to the world turns right-handed axes into left-handed ones."""
    corner, steps = torch.tensor(field.box.middle), torch.diag(torch.tensor(field.box.size) / 100)
    way = space.to_world(corner + steps) - space.to_world(corner)
    return bool(torch.linalg.det(way / way.norm(dim=1, keepdim=True)) < 0)
